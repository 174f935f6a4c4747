"""Does the calibration still hold? Sensors as the stitching finds them against calibration + TDM.

Only the judgement and the datum that follows from it live here; the adjustment is in
`processing.mosaic.free`. Displacements are (x right, y up), found minus expected, in PAN px.

Source: seeds/ultracam-calibration.txt, "Optimal IO reconstruction", fig. 5 and 6; DESIGN 5.4.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from processing.geometry.drift import sensor_dc
from processing.geometry.placement import SensorPlacement
from processing.matching.tie_points import TiePoints
from processing.mosaic.free import Mosaic, MosaicSettings, datum_constraints, free_mosaic
from processing.rig import Rig, Sensor

Array = NDArray[np.float64]

LEAST_PAN_POINTS = 24
"""P/P points used below which a sensor's place is not the stitching's to tell."""

Observability = Literal["named", "relative", "unobservable"]


@dataclass(frozen=True)
class ValiditySettings:
    """What the tests assume and demand.

    `probe_sigma_k` is common to all sensors of a probe; a probe without a temperature has
    `unknown_sigma_k`. `family_alpha` is the probability of naming any sensor of a healthy rig.
    A sensor is an alternative to the named one unless it is `odds` times less likely.
    """

    probe_sigma_k: float = 0.1
    unknown_sigma_k: float = 10.0
    family_alpha: float = 0.001
    odds: float = 19.0


@dataclass(frozen=True)
class Residual:
    """Where the stitching puts a master sensor against calibration + TDM (fig. 5d)."""

    sensor: str
    dx_px: float
    dy_px: float
    sigma_x_px: float
    sigma_y_px: float


@dataclass(frozen=True)
class Displacement:
    """One master sensor's displacement against the others, if it alone had moved.

    `statistic` is chi-square with two degrees of freedom on a healthy rig.
    """

    sensor: str
    dx_px: float
    dy_px: float
    sigma_x_px: float
    sigma_y_px: float
    statistic: float

    @property
    def length_px(self) -> float:
        return math.hypot(self.dx_px, self.dy_px)


@dataclass(frozen=True)
class RelativeDisplacement:
    """Two sensors of one cone against each other (a minus b); which of them moved is not known."""

    cone: str
    sensor_a: str
    sensor_b: str
    dx_px: float
    dy_px: float
    sigma_x_px: float
    sigma_y_px: float
    statistic: float
    limit: float

    @property
    def significant(self) -> bool:
        return self.statistic > self.limit


@dataclass(frozen=True)
class Validity:
    """The judgement on one exposure.

    `observability` says per cone what can be known: a single displaced sensor is named, only a
    relative displacement is seen, or nothing (one sensor: the layer transformation absorbs it).
    `consistent` is the global test of the master sensors. `displaced` is the named sensor, with
    `alternatives` that fit nearly as well; `several` says that one sensor does not explain it all.
    `unproven` is a sensor that would be named if more than P/C points and a few P/P said so.
    """

    observability: Mapping[str, Observability]
    residuals: tuple[Residual, ...]
    global_statistic: float
    global_freedom: int
    global_limit: float
    hypotheses: tuple[Displacement, ...]
    limit: float
    displaced: Displacement | None
    alternatives: tuple[str, ...]
    several: bool
    relative: tuple[RelativeDisplacement, ...]
    unproven: Displacement | None = None

    @property
    def consistent(self) -> bool:
        return self.global_statistic <= self.global_limit


def judge_master(
    rig: Rig,
    mosaic: Mosaic,
    temperatures_c: Mapping[str, float],
    *,
    settings: ValiditySettings | None = None,
) -> Validity:
    """Test the master cone's sensors, and the relative places in cones of two or more.

    The covariance of the residuals is that of stitching + calibration (`position_sigma_um`) + TDM
    (coefficient sigma times dC, and the probe's sigma common to its sensors). The datum does not
    matter: shift, rotation and scale common to the master sensors are taken out.

    Args:
        rig: the camera.
        mosaic: a free mosaic, in any datum.
        temperatures_c: temperature by probe name, as the mosaic's start was made with.
        settings: None takes the defaults.
    """
    settings = settings or ValiditySettings()
    master = [
        s.name
        for s in rig.master_sensors
        if s.name in mosaic.model.sensors and _is_found(mosaic, s.name)
    ]
    hypotheses: list[Displacement] = []
    global_statistic, freedom, remainder = 0.0, 0, 0.0
    limit = math.inf
    if len(master) >= 3:
        found, stitching = _positions(mosaic, master)
        prior = _prior(rig, mosaic, master, temperatures_c, settings)
        contrasts = _contrasts(_similarity_directions(mosaic, master))
        y = contrasts @ found
        weight = np.linalg.inv(contrasts @ (stitching + prior) @ contrasts.T)
        global_statistic, freedom = float(y @ weight @ y), len(y)
        limit = float(chi2.ppf(1.0 - settings.family_alpha / len(master), 2))
        for i, name in enumerate(master):
            design = contrasts[:, 2 * i : 2 * i + 2]
            cofactor = np.linalg.inv(design.T @ weight @ design)
            delta = cofactor @ design.T @ weight @ y
            hypotheses.append(
                Displacement(
                    sensor=name,
                    dx_px=float(delta[0]),
                    dy_px=float(delta[1]),
                    sigma_x_px=math.sqrt(float(cofactor[0, 0])),
                    sigma_y_px=math.sqrt(float(cofactor[1, 1])),
                    statistic=float(delta @ design.T @ weight @ y),
                )
            )
        hypotheses.sort(key=lambda h: -h.statistic)
        remainder = global_statistic - hypotheses[0].statistic
    displaced = hypotheses[0] if hypotheses and hypotheses[0].statistic > limit else None
    unproven = None
    if displaced and pan_points(rig, mosaic)[displaced.sensor] < LEAST_PAN_POINTS:
        displaced, unproven = None, displaced
    fits = [
        h.sensor
        for h in hypotheses[1:]
        if hypotheses[0].statistic - h.statistic < 2.0 * math.log(settings.odds)
    ]
    several = bool(
        (displaced or unproven)
        and freedom > 2
        and remainder > chi2.ppf(1.0 - settings.family_alpha, freedom - 2)
    )
    return Validity(
        observability=_observability(rig, mosaic),
        residuals=_residuals(rig, mosaic, master, temperatures_c, settings),
        global_statistic=global_statistic,
        global_freedom=freedom,
        global_limit=float(chi2.ppf(1.0 - settings.family_alpha, freedom)) if freedom else 0.0,
        hypotheses=tuple(hypotheses),
        limit=limit,
        displaced=displaced,
        alternatives=tuple(fits) if displaced or unproven else (),
        several=several,
        relative=_relative(rig, mosaic, temperatures_c, settings),
        unproven=unproven,
    )


def pan_points(rig: Rig, mosaic: Mosaic) -> dict[str, int]:
    """P/P points in use, by PAN sensor."""
    counts = {s.name: 0 for cone in rig.pan_cones for s in cone.sensors}
    for (a, b), used in mosaic.used.items():
        if a in counts and b in counts:
            counts[a] += used
            counts[b] += used
    return counts


def robust_datum(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    tie_points: TiePoints,
    mosaic: Mosaic,
    validity: Validity,
    *,
    settings: MosaicSettings | None = None,
) -> Mosaic:
    """The mosaic in the datum of the master sensors that are still in place.

    Without a displaced sensor this is `mosaic` itself. The inner geometry is the same; what changes
    is the datum, which a displaced sensor pulls by a quarter of its displacement. Where another
    sensor may be the one that moved, the datum rests on neither, if two are left to carry it.
    """
    if validity.displaced is None:
        return mosaic
    suspects = (validity.displaced.sensor, *validity.alternatives)
    if len(set(mosaic.datum_sensors) - set(suspects)) < 2:
        suspects = suspects[:1]
    return free_mosaic(
        rig,
        placements,
        tie_points,
        settings=settings,
        excluded_datum_sensors=suspects,
        begin=mosaic,
    )


def _is_found(mosaic: Mosaic, sensor: str) -> bool:
    return f"{sensor}.x" not in mosaic.undetermined and f"{sensor}.y" not in mosaic.undetermined


def _observability(rig: Rig, mosaic: Mosaic) -> dict[str, Observability]:
    result: dict[str, Observability] = {}
    for cone in rig.pan_cones:
        names = [s.name for s in cone.sensors if s.name in mosaic.model.sensors]
        seen = sum(_is_found(mosaic, name) for name in names)
        if cone.name == rig.master_cone and seen >= 4:
            result[cone.name] = "named"
        elif seen >= (3 if cone.name == rig.master_cone else 2):
            result[cone.name] = "relative"
        else:
            result[cone.name] = "unobservable"
    return result


def _positions(mosaic: Mosaic, sensors: Sequence[str]) -> tuple[Array, Array]:
    """Corrections x, y of sensors one after the other, px, and their stitching covariance."""
    rows = [mosaic.model.sensors[name] + axis for name in sensors for axis in (0, 1)]
    pitch = mosaic.model.pitch_mm
    return mosaic.values[rows] / pitch, mosaic.covariance[np.ix_(rows, rows)] / pitch**2


def _prior(
    rig: Rig,
    mosaic: Mosaic,
    sensors: Sequence[str],
    temperatures_c: Mapping[str, float],
    settings: ValiditySettings,
) -> Array:
    """Covariance of where calibration + TDM expect the sensors, px squared."""
    pitch_um = mosaic.model.pitch_mm * 1e3
    found = [rig.sensor(name) for name in sensors]
    covariance = np.zeros((2 * len(found), 2 * len(found)))
    for i, sensor in enumerate(found):
        dc = sensor_dc(sensor, temperatures_c)
        unknown = 0.0 if sensor.probe in temperatures_c else settings.unknown_sigma_k
        tdm = sensor.drift.sigma_um_per_k * math.hypot(dc, unknown)
        variance = sensor.position_sigma_um**2 + tdm**2
        covariance[2 * i, 2 * i] = covariance[2 * i + 1, 2 * i + 1] = variance
    for probe in dict.fromkeys(sensor.probe for sensor in found):
        known = probe in temperatures_c
        sigma_k = settings.probe_sigma_k if known else settings.unknown_sigma_k
        moved = np.concatenate([_per_kelvin(s) * (s.probe == probe) for s in found])
        covariance += np.outer(moved, moved) * sigma_k**2
    return covariance / pitch_um**2


def _per_kelvin(sensor: Sensor) -> Array:
    return np.array([sensor.drift.x_um_per_k, sensor.drift.y_um_per_k])


def _similarity_directions(mosaic: Mosaic, sensors: Sequence[str]) -> Array:
    """How a common shift, scale and rotation moves the sensors: (2 m, 4)."""
    directions = np.zeros((2 * len(sensors), 4))
    for i, name in enumerate(sensors):
        place = mosaic.start[name].similarity
        directions[2 * i] = (1.0, 0.0, place.x_mm, -place.y_mm)
        directions[2 * i + 1] = (0.0, 1.0, place.y_mm, place.x_mm)
    return directions


def _contrasts(directions: Array) -> Array:
    """An orthonormal basis of what the directions cannot produce, as rows."""
    full, _, _ = np.linalg.svd(directions, full_matrices=True)
    return np.asarray(full[:, directions.shape[1] :].T)


def _residuals(
    rig: Rig,
    mosaic: Mosaic,
    sensors: Sequence[str],
    temperatures_c: Mapping[str, float],
    settings: ValiditySettings,
) -> tuple[Residual, ...]:
    if not sensors:
        return ()
    found, stitching = _positions(mosaic, sensors)
    prior = _prior(rig, mosaic, sensors, temperatures_c, settings)
    datum = [name for name in mosaic.datum_sensors if name in sensors]
    if len(datum) >= 2:
        directions = _similarity_directions(mosaic, sensors)
        rows = np.zeros((4, len(found)))
        for k, constraint in enumerate(datum_constraints(mosaic.start, datum)):
            for name, coefficient in constraint.coefficients.items():
                sensor, what = name.rsplit(".", 1)
                rows[k, 2 * sensors.index(sensor) + (what == "y")] = coefficient
        into_datum = np.eye(len(found)) - directions @ np.linalg.inv(rows @ directions) @ rows
        prior = into_datum @ prior @ into_datum.T
    sigma = np.sqrt(np.maximum(np.diag(stitching + prior), 0.0))
    return tuple(
        Residual(
            sensor=name,
            dx_px=float(found[2 * i]),
            dy_px=float(found[2 * i + 1]),
            sigma_x_px=float(sigma[2 * i]),
            sigma_y_px=float(sigma[2 * i + 1]),
        )
        for i, name in enumerate(sensors)
    )


def _relative(
    rig: Rig, mosaic: Mosaic, temperatures_c: Mapping[str, float], settings: ValiditySettings
) -> tuple[RelativeDisplacement, ...]:
    pairs = []
    for cone in rig.pan_cones:
        if cone.name != rig.master_cone and len(cone.sensors) >= 2:
            seen = [s.name for s in cone.sensors if _is_found(mosaic, s.name)]
            seen = [name for name in seen if name in mosaic.model.sensors]
            pairs += [(cone.name, a, b) for a, b in itertools.combinations(seen, 2)]
    result = []
    difference = np.hstack([np.eye(2), -np.eye(2)])
    for cone_name, a, b in pairs:
        found, stitching = _positions(mosaic, (a, b))
        prior = _prior(rig, mosaic, (a, b), temperatures_c, settings)
        delta = difference @ found
        covariance = difference @ (stitching + prior) @ difference.T
        result.append(
            RelativeDisplacement(
                cone=cone_name,
                sensor_a=a,
                sensor_b=b,
                dx_px=float(delta[0]),
                dy_px=float(delta[1]),
                sigma_x_px=math.sqrt(float(covariance[0, 0])),
                sigma_y_px=math.sqrt(float(covariance[1, 1])),
                statistic=float(delta @ np.linalg.inv(covariance) @ delta),
                limit=float(chi2.ppf(1.0 - settings.family_alpha / len(pairs), 2)),
            )
        )
    return tuple(result)
