"""Learning the temperature-dependent model from flights: recursive least squares with an intercept.

Each exposure's stitching adds to normal equations. The result is a proposal that a person accepts;
it never changes a product automatically.

Source: docs/explanation/mathematics/drift.md#learning and #what-is-observable.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.geometry.topology import mosaic_cones
from processing.mosaic.stitch_record import LAYER_SCALE, SENSOR_UNITS, StitchRecord
from processing.rig import Cone, Rig

Array = NDArray[np.float64]

MIN_DC_SPREAD_K = 5.0
PROBE_SIGMA_K = 0.1
MOTION_PPM = 1.0
"""Vertical motion between the exposures of two cones: 1 m/s over 3 ms at 3000 m."""
_QUANTITIES = tuple(SENSOR_UNITS)


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of k offsets and k rates: y = offset + rate * dC.

    `information` (2 k, 2 k), `vector` (2 k,), `squares` the weighted sum of squares of y.
    """

    information: Array
    vector: Array
    squares: float = 0.0
    exposures: int = 0
    lowest_dc_k: float = math.inf
    highest_dc_k: float = -math.inf

    @property
    def size(self) -> int:
        """Number of offsets, which is that of rates."""
        return len(self.vector) // 2

    @property
    def spread_k(self) -> float:
        """Range of dC that was flown, K; zero without exposures."""
        return self.highest_dc_k - self.lowest_dc_k if self.exposures else 0.0


@dataclass(frozen=True)
class ThermalState:
    """Normal equations so far, by cone: `places` of its sensors to each other, `scales` of its
    layer to the master's. It belongs to one calibration of one rig."""

    rig: str
    calibration_id: str
    places: Mapping[str, NormalEquations] = field(default_factory=dict)
    scales: Mapping[str, NormalEquations] = field(default_factory=dict)


@dataclass(frozen=True)
class LearnedSensor:
    """Corrections to a sensor's calibration, and their standard deviations, by quantity.

    `rates` per kelvin: um, um, urad, ppm; `offsets` the same at the calibration temperature.
    `effect_px` is what the rates' correction moves the sensor's farthest pixel at `largest_dc_k`,
    the largest dC flown.
    """

    cone: str
    sensor: str
    offsets: Mapping[str, float]
    offset_sigmas: Mapping[str, float]
    rates: Mapping[str, float]
    rate_sigmas: Mapping[str, float]
    largest_dc_k: float
    effect_px: float


@dataclass(frozen=True)
class LearnedScale:
    """Correction to `f_ppm_per_k` of a cone, the master cone's held; `offset_ppm` of its scale."""

    cone: str
    f_ppm_per_k: float
    sigma_ppm_per_k: float
    offset_ppm: float
    effect_px: float


@dataclass(frozen=True)
class LearnedDrift:
    """Learned corrections. `reasons` states by cone why nothing was learned there."""

    sensors: tuple[LearnedSensor, ...]
    scales: tuple[LearnedScale, ...]
    variance_factors: Mapping[str, float]
    reasons: Mapping[str, str]
    spread_k: Mapping[str, float]


@dataclass(frozen=True)
class Observability:
    """One quantity, whether stitching can see it, and why (not)."""

    what: str
    observable: bool
    why: str


def empty_state(rig: Rig) -> ThermalState:
    """The state before the first exposure.

    Args:
        rig: the camera.

    Returns:
        Normal equations of zero for the cones that can be learned.
    """
    places, scales = {}, {}
    for cone in mosaic_cones(rig):
        if cone.role == "pan" and len(cone.sensors) >= 2:
            places[cone.name] = _empty(4 * (len(cone.sensors) - 1))
        if rig.master_cone is not None and cone.name != rig.master_cone:
            scales[cone.name] = _empty(1)
    return ThermalState(rig.name, rig.calibration_id, places, scales)


def add_exposure(rig: Rig, state: ThermalState, record: StitchRecord) -> ThermalState:
    """The state after one more exposure; the order of exposures does not matter.

    A cone is skipped where a sensor of it is missing or its temperature was not measured.

    Args:
        rig: the camera.
        state: so far; it is not changed.
        record: of the exposure.

    Returns:
        The new state.

    Raises:
        ValueError: the record is of another rig or calibration.
    """
    if (record.rig, record.calibration_id) != (state.rig, state.calibration_id):
        raise ValueError(
            f"a record of {record.rig} {record.calibration_id!r} does not belong to what was "
            f"gathered for {state.rig} {state.calibration_id!r}"
        )
    places, scales = dict(state.places), dict(state.scales)
    for name, normal in places.items():
        cone = rig.cone(name)
        if _complete(cone, record):
            places[name] = _add_places(normal, cone, record)
    for name, normal in scales.items():
        master = rig.cone(rig.master_cone)
        cone = rig.cone(name)
        names = set(record.names)
        recorded_names = {s.name for s in (*cone.sensors, *master.sensors)} <= set(record.measured)
        # A single master sensor is fixed: it is the scale.
        fixed = len(master.sensors) == 1 or _is_recorded(master, names)
        if f"{name}.{LAYER_SCALE}" in names and recorded_names and fixed:
            scales[name] = _add_scale(normal, master, cone, record)
    return ThermalState(state.rig, state.calibration_id, places, scales)


def solve_drift(rig: Rig, state: ThermalState) -> LearnedDrift:
    """Solve the normal equations.

    Cones with less than `MIN_DC_SPREAD_K` of spread in dC are skipped. Standard deviations hold
    the scatter about the straight line where it exceeds what the covariances of the stitching
    predict.

    Args:
        rig: the camera.
        state: of all exposures.

    Returns:
        Corrections to offsets and rates, and why some cones have none.

    Source: docs/explanation/mathematics/drift.md#learning.
    """
    sensors: list[LearnedSensor] = []
    scales: list[LearnedScale] = []
    factors: dict[str, float] = {}
    reasons: dict[str, str] = {}
    spread = {n: v.spread_k for n, v in {**state.scales, **state.places}.items()}
    for kind, normals in (("places", state.places), ("scale", state.scales)):
        for name, normal in normals.items():
            key = f"{name} {kind}"
            if normal.spread_k < MIN_DC_SPREAD_K:
                reasons[key] = (
                    f"dC spread over {normal.spread_k:.1f} K in {normal.exposures} exposures; "
                    f"{MIN_DC_SPREAD_K:g} K are needed"
                )
                continue
            solution, covariance, factors[key] = _solve(normal)
            cone = rig.cone(name)
            if kind == "places":
                sensors += _sensors(cone, normal, solution, covariance)
            else:
                far_px = _field_radius_px(rig, cone)
                largest = max(abs(normal.lowest_dc_k), abs(normal.highest_dc_k))
                scales.append(
                    LearnedScale(
                        cone=name,
                        f_ppm_per_k=-float(solution[1]),
                        sigma_ppm_per_k=math.sqrt(float(covariance[1, 1])),
                        offset_ppm=float(solution[0]),
                        effect_px=abs(float(solution[1])) * 1e-6 * largest * far_px,
                    )
                )
    return LearnedDrift(tuple(sensors), tuple(scales), factors, reasons, spread)


def observability(rig: Rig) -> tuple[Observability, ...]:
    """What stitching can and cannot determine of the drift of this rig.

    Args:
        rig: the camera.

    Returns:
        One entry per quantity: PAN cones, then scales of layers, then the common scale.

    Source: docs/explanation/mathematics/drift.md#what-is-observable.
    """
    result = []
    for cone in rig.pan_cones:
        m = len(cone.sensors)
        if m >= 2:
            result += [
                Observability(
                    f"cone {cone.name}: expansion of the mount relative to silicon, differential "
                    f"shifts, rotations and scales ({4 * m - 4} rates)",
                    observable=True,
                    why="the sensors' places to each other, by tie points with the other cones",
                ),
                Observability(
                    f"cone {cone.name}: common shift, rotation and scale of its sensors",
                    observable=False,
                    why="the master cone's are the datum; they come from the laboratory or a "
                    "bundle adjustment"
                    if cone.name == rig.master_cone
                    else "the layer transformation absorbs them, with the aircraft's motion",
                ),
            ]
        else:
            result.append(
                Observability(
                    f"cone {cone.name}: shift and rotation of its sensor",
                    observable=False,
                    why="one sensor: the layer transformation absorbs them",
                )
            )
    result += [
        Observability(
            f"cone {cone.name} against cone {rig.master_cone}: principal distance",
            observable=True,
            why="the scale of its layer; the master's is held",
        )
        for cone in mosaic_cones(rig)
        if rig.master_cone is not None and cone.name != rig.master_cone
    ]
    result.append(
        Observability(
            "a change of the principal distance common to all cones",
            observable=False,
            why="it is a scale of the whole image; laboratory or bundle adjustment",
        )
    )
    return tuple(result)


def _empty(size: int) -> NormalEquations:
    return NormalEquations(np.zeros((2 * size, 2 * size)), np.zeros(2 * size))


def _is_recorded(cone: Cone, names: set[str]) -> bool:
    return all(f"{s.name}.{what}" in names for s in cone.sensors for what in _QUANTITIES)


def _complete(cone: Cone, record: StitchRecord) -> bool:
    measured = {s.name for s in cone.sensors} <= set(record.measured)
    return measured and _is_recorded(cone, set(record.names))


def _inner_from_values(cone: Cone) -> tuple[Array, Array]:
    """What of a cone's corrections (4 m,) is inner geometry, and the way back.

    Returns:
        T (4 m - 4, 4 m) takes corrections in any gauge to inner coordinates; B (4 m, 4 m - 4) takes
        these to corrections whose sums over the sensors vanish (as Ladstädter et al. (2010), eq.
            6a, 7a, 7b).
    """
    m = len(cone.sensors)
    differences = np.linalg.svd(np.ones((1, m)))[2][1:].T
    back = np.kron(differences, np.eye(4))
    gauge = np.zeros((4 * m, 4))
    for j, s in enumerate(cone.sensors):
        # um per um, um, urad and ppm: a urad at one mm is 1e-3 um.
        gauge[4 * j] = (1.0, 0.0, -s.y_mm * 1e-3, s.x_mm * 1e-3)
        gauge[4 * j + 1] = (0.0, 1.0, s.x_mm * 1e-3, s.y_mm * 1e-3)
        gauge[4 * j + 2] = (0.0, 0.0, 1.0, 0.0)
        gauge[4 * j + 3] = (0.0, 0.0, 0.0, 1.0)
    there = np.linalg.inv(np.hstack([back, gauge]))
    return there[: 4 * (m - 1)], back


def _add_places(normal: NormalEquations, cone: Cone, record: StitchRecord) -> NormalEquations:
    inner, back = _inner_from_values(cone)
    rows = [record.names.index(f"{s.name}.{what}") for s in cone.sensors for what in _QUANTITIES]
    dc = np.array([record.dc_k[s.name] for s in cone.sensors])
    covariance = inner @ record.covariance[np.ix_(rows, rows)] @ inner.T
    for probe in {s.probe for s in cone.sensors}:
        moved = inner @ np.concatenate([_rates(s.drift) * (s.probe == probe) for s in cone.sensors])
        covariance += np.outer(moved, moved) * PROBE_SIGMA_K**2
    by_dc = inner @ (np.repeat(dc, 4)[:, None] * back)
    return _added(normal, inner @ record.values[rows], covariance, by_dc, dc)


def _rates(drift: Any) -> Array:
    return np.array(
        [drift.x_um_per_k, drift.y_um_per_k, drift.rotation_urad_per_k, drift.scale_ppm_per_k]
    )


def _add_scale(
    normal: NormalEquations, master: Cone, cone: Cone, record: StitchRecord
) -> NormalEquations:
    """Scale of a cone's sensors in the image against the master's; larger is a shorter f."""
    row = np.zeros(len(record.names))
    row[record.names.index(f"{cone.name}.{LAYER_SCALE}")] = 1.0
    for part, sign in ((cone, 1.0), (master, -1.0)):
        for s in part.sensors:
            if f"{s.name}.scale_ppm" in record.names:
                row[record.names.index(f"{s.name}.scale_ppm")] += sign / len(part.sensors)
    variance = float(row @ record.covariance @ row) + MOTION_PPM**2
    for part in (cone, master):
        rate = part.sensors[0].drift.scale_ppm_per_k - part.lens.f_ppm_per_k
        variance += (rate * PROBE_SIGMA_K) ** 2
    dc = np.array([np.mean([record.dc_k[s.name] for s in cone.sensors])])
    value = np.array([row @ record.values])
    return _added(normal, value, np.array([[variance]]), dc[:, None], dc)


def _added(
    normal: NormalEquations, y: Array, covariance: Array, by_dc: Array, dc: Array
) -> NormalEquations:
    design = np.hstack([np.eye(len(y)), by_dc])
    weighted = np.linalg.solve(covariance, np.column_stack([design, y]))
    return NormalEquations(
        normal.information + design.T @ weighted[:, :-1],
        normal.vector + design.T @ weighted[:, -1],
        normal.squares + float(y @ weighted[:, -1]),
        normal.exposures + 1,
        min(normal.lowest_dc_k, float(dc.min())),
        max(normal.highest_dc_k, float(dc.max())),
    )


def _solve(normal: NormalEquations) -> tuple[Array, Array, float]:
    """Offsets and rates, their covariance, and the variance factor it was multiplied with."""
    inverse: Array = np.linalg.inv(normal.information).astype(np.float64)
    solution = inverse @ normal.vector
    freedom = normal.size * (normal.exposures - 2)
    factor = 1.0
    if freedom > 0:
        factor = max(1.0, (normal.squares - float(solution @ normal.vector)) / freedom)
    return solution, inverse * factor, factor


def _sensors(
    cone: Cone, normal: NormalEquations, solution: Array, covariance: Array
) -> list[LearnedSensor]:
    _, back = _inner_from_values(cone)
    k = normal.size
    offsets, rates = back @ solution[:k], back @ solution[k:]
    offset_sigmas = np.sqrt(np.diag(back @ covariance[:k, :k] @ back.T))
    rate_sigmas = np.sqrt(np.diag(back @ covariance[k:, k:] @ back.T))
    largest = max(abs(normal.lowest_dc_k), abs(normal.highest_dc_k))
    result = []
    for j, s in enumerate(cone.sensors):
        part = slice(4 * j, 4 * j + 4)
        half_mm = math.hypot(s.width_px, s.height_px) / 2.0 * s.pitch_mm
        x, y, rotation, scale = np.abs(rates[part])
        moved_um = math.hypot(x, y) + (rotation + scale) * half_mm * 1e-3
        result.append(
            LearnedSensor(
                cone=cone.name,
                sensor=s.name,
                offsets=_by_quantity(offsets[part]),
                offset_sigmas=_by_quantity(offset_sigmas[part]),
                rates=_by_quantity(rates[part]),
                rate_sigmas=_by_quantity(rate_sigmas[part]),
                largest_dc_k=largest,
                effect_px=moved_um * largest / s.pitch_um,
            )
        )
    return result


def _by_quantity(values: Array) -> dict[str, float]:
    return dict(zip(_QUANTITIES, (float(v) for v in values), strict=True))


def _field_radius_px(rig: Rig, cone: Cone) -> float:
    """From the middle of a cone to its farthest pixel, px of the virtual image."""
    reach = max(
        math.hypot(
            abs(s.x_mm) + s.width_px * s.pitch_mm / 2, abs(s.y_mm) + s.height_px * s.pitch_mm / 2
        )
        for s in cone.sensors
    )
    image = rig.virtual_image
    assert image is not None
    return reach / cone.lens.f_mm * image.f_mm / image.pitch_mm
