"""Calibration of a whole rig in a 3D test field (`calibrate lab`).

Every CCD's shift, rotation, scale and perspective skew, every cone's lens and its rotation against
the master cone, in one bundle adjustment. Datum: principal distance and principal point of the
cones stay as they are, and the first CCD of each cone is not turned. Sources:
seeds/ultracam-calibration.txt, laboratory calibration; docs/calibration.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.calibration.laboratory.head import LENS_KEYS, layer_mm
from daemon.calibration.laboratory.series import Series, SeriesError, within_folder
from daemon.disk.level0 import read_tiff
from processing.bundle.adjust import Adjustment, Settings, adjust
from processing.bundle.network import (
    INTERIOR,
    Attitudes,
    Camera,
    Head,
    ImagePoints,
    Images,
    Network,
    NetworkError,
    Points,
    Stations,
)
from processing.bundle.rank import DefectError
from processing.bundle.rotations import omega_phi_kappa
from processing.bundle.terms import Kind, Part, Term
from processing.geometry.lens import measured_from_ideal
from processing.geometry.rotation import rotation_matrix
from processing.matching.discs import disc_positions, identified
from processing.rig import Cone, Rig, Sensor

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

LENS_FREE: Final = ("k1", "k2", "p1", "p2")
EXPECTED_SIGMA_PX: Final = 0.02
_MOST_ROUNDS: Final = 6
_SETTLED: Final = 0.03
_SETTLED_MM: Final = 5e-5
"""What a CCD moves by passes through its lens only in the next round: 2 in a thousand of it."""
_REACH_PX: Final = 120.0


@dataclass(frozen=True)
class Exposure:
    """One look at the field: frames by sensor, where the rig stood about, and temperatures."""

    name: str
    files: Mapping[str, Path]
    position_m: Array
    object_from_rig: Array
    temperatures: Mapping[str, float]


@dataclass(frozen=True)
class Field:
    """Surveyed targets: names, (n, 3) m, (n,) m."""

    names: tuple[str, ...]
    xyz_m: Array
    sigma_m: Array


@dataclass(frozen=True)
class Looks:
    """Image measurements: exposure, sensor and target by index (n,), and places (n, 2) px."""

    exposure: NDArray[np.int64]
    sensor: NDArray[np.int64]
    target: NDArray[np.int64]
    px: Array


@dataclass(frozen=True)
class RigCalibration:
    """What was found: the rig with its new places, and the last adjustment, whose cofactor holds
    for them. `skew_per_mm` and its sigmas by sensor: a rig file has no place for them."""

    rig: Rig
    before: Rig
    looks: Looks
    adjustment: Adjustment
    sigma_px: float
    rejected: int
    temperatures_c: Mapping[str, float]
    skew_per_mm: Mapping[str, tuple[float, float]]


def exposures_of(series: Series) -> list[Exposure]:
    """The exposures of the series; the caller ends with `Series.checked`."""
    known = {s.name for s in series.rig.sensors}
    found = []
    for image in series.images:
        files = image.table("files")
        for name in files.content:
            if name not in known:
                files.complain(name, f"a sensor of the rig is one of {', '.join(sorted(known))}")
        temperatures = image.table("temperatures", optional=True)
        found.append(
            Exposure(
                name=image.text("name"),
                files={name: series.folder / within_folder(files, name) for name in files.content},
                position_m=np.array(image.triple("position_m")),
                object_from_rig=_matrix(image),
                temperatures={n: temperatures.number(n) for n in temperatures.content},
            )
        )
    return found


def field_of(series: Series) -> Field:
    """The targets of the series; the caller ends with `Series.checked`."""
    names, xyz, sigma = [], [], []
    for target in series.table.tables("targets"):
        names.append(target.text("name"))
        xyz.append(target.triple("xyz_m"))
        sigma.append(target.number("sigma_m", positive=True))
    return Field(tuple(names), np.array(xyz).reshape(-1, 3), np.array(sigma))


def _matrix(image: Any) -> Array:
    content = image.content.get("object_from_rig")
    image.asked.add("object_from_rig")
    try:
        matrix = np.array(content, dtype=float)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape != (3, 3) or not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3):
        image.complain("object_from_rig", "it is a rotation matrix, three rows of three numbers")
        return np.eye(3)
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


def measured(rig: Rig, exposures: Sequence[Exposure], field: Field, *, progress: Progress) -> Looks:
    """Find the discs of every frame and tell which target each is.

    Raises:
        SeriesError: no frame shows the field where it is expected.
        daemon.disk.level0.RasterError: a frame cannot be read.
    """
    rows: list[tuple[int, int, int, float, float]] = []
    total = sum(len(e.files) for e in exposures)
    done = 0
    for k, exposure in enumerate(exposures):
        for j, sensor in enumerate(rig.sensors):
            if sensor.name not in exposure.files:
                continue
            frame = read_tiff(
                exposure.files[sensor.name], width_px=sensor.width_px, height_px=sensor.height_px
            )
            found = disc_positions(frame)
            predicted, index = _predicted(rig, sensor, exposure, field)
            a, b = identified(predicted, found, reach_px=_REACH_PX)
            rows += [
                (k, j, int(index[p]), float(found[q, 0]), float(found[q, 1]))
                for p, q in zip(a, b, strict=True)
            ]
            done += 1
            progress(f"measuring {exposure.name}", done, total)
    if not rows:
        raise SeriesError(["no frame shows the targets where they are expected; check the poses"])
    table = np.array(rows)
    whole = table[:, :3].astype(np.int64)
    return Looks(whole[:, 0], whole[:, 1], whole[:, 2], table[:, 3:])


def _predicted(
    rig: Rig, sensor: Sensor, exposure: Exposure, field: Field
) -> tuple[Array, NDArray[np.int64]]:
    """Where the nominal rig would see targets, px, and which these are."""
    cone = rig.cone_of(sensor.name)
    centre = exposure.position_m + exposure.object_from_rig @ _offset_m(rig, cone)
    ray = (field.xyz_m - centre) @ exposure.object_from_rig @ rotation_matrix(*cone.rotation_rad)
    front = np.flatnonzero(ray[:, 2] < 0.0)
    ideal = -cone.lens.f_mm * ray[front, :2] / ray[front, 2:]
    slack = _REACH_PX * sensor.pitch_mm
    half = np.array([sensor.width_px, sensor.height_px]) * sensor.pitch_mm / 2.0 + slack
    near = (np.abs(ideal - np.array([sensor.x_mm, sensor.y_mm])) < half).all(axis=1)
    at = measured_from_ideal(cone.lens, ideal[near]) - np.array([sensor.x_mm, sensor.y_mm])
    px = np.stack(
        [
            at[:, 0] / sensor.pitch_mm + (sensor.width_px - 1) / 2,
            (sensor.height_px - 1) / 2 - at[:, 1] / sensor.pitch_mm,
        ],
        axis=1,
    )
    good = np.isfinite(px).all(axis=1)
    return px[good], front[near][good]


def _master(rig: Rig) -> Cone:
    return rig.cone(rig.master_cone) if rig.master_cone else rig.cones[0]


def _offset_m(rig: Rig, cone: Cone) -> Array:
    """Projection centre against the master cone's, in the axes of its camera, m."""
    forward, right, down = np.subtract(cone.position_mm, _master(rig).position_mm)
    return np.array([right, forward, -down]) * 1e-3


def calibrate_rig(
    rig: Rig,
    exposures: Sequence[Exposure],
    field: Field,
    looks: Looks,
    *,
    offset_sigma_mm: float,
    skew_sigma_per_mm: float,
    progress: Progress,
) -> RigCalibration:
    """Adjust everything; twice, so that the second time corrections are small and nothing wrong
    is among the measurements.

    Args:
        offset_sigma_mm: how well the drawing knows the cones' projection centres.
        skew_sigma_per_mm: how far a CCD is skewed, beforehand (one sigma).

    Raises:
        SeriesError: what cannot be determined, named.
    """

    def adjusted(current: Rig, own: Looks, sigma_px: float, settings: Settings) -> Adjustment:
        network = lab_network(
            current,
            exposures,
            field,
            own,
            offset_sigma_mm=offset_sigma_mm,
            skew_sigma_per_mm=skew_sigma_per_mm,
            sigma_px=sigma_px,
            drawn=rig,
        )
        try:
            return adjust(
                network,
                settings,
                progress=lambda what, step, _: progress(f"adjusting: {what}", step, 0),
            )
        except DefectError as error:
            raise SeriesError([d.sentence for d in error.defects]) from error
        except NetworkError as error:
            raise SeriesError(list(error.problems)) from error

    first = adjusted(rig, looks, EXPECTED_SIGMA_PX, Settings(robust=True))
    # Discs that are none, and targets taken for others, are out; the noise is what was found.
    kept = ~first.rejected & (first.weight > 0.0)
    looks = Looks(*(getattr(looks, f)[kept] for f in ("exposure", "sensor", "target", "px")))
    found_px = EXPECTED_SIGMA_PX * _image_factor(first)
    current = _moved(rig, first)
    for _ in range(_MOST_ROUNDS):
        result = adjusted(current, looks, found_px, Settings())
        current = _moved(current, result)
        factor = _image_factor(result)
        if abs(factor - 1.0) < _SETTLED and _largest_move(result) < _SETTLED_MM:
            break
        found_px *= factor
    seen = [e.temperatures for e in exposures]
    probes = {name for t in seen for name in t}
    mean = {p: float(np.mean([t[p] for t in seen if p in t])) for p in sorted(probes)}
    return RigCalibration(
        rig=_at_temperatures(current, mean),
        before=rig,
        looks=looks,
        adjustment=result,
        sigma_px=found_px,
        rejected=int((~kept).sum()),
        temperatures_c=mean,
        skew_per_mm=_skew(rig, result),
    )


def _image_factor(result: Adjustment) -> float:
    """Image noise found over that expected, without what was rejected."""
    used = ~result.rejected & (result.weight > 0.0)
    own = (result.equations.group <= 1) & np.isin(result.equations.source, np.flatnonzero(used))
    freedom = float(result.redundancy_number[own].sum())
    squares = float(np.sum(result.residual[own] ** 2))
    return float(np.sqrt(squares / max(freedom, 1.0)))


def _largest_move(result: Adjustment) -> float:
    """Largest shift of a CCD that an adjustment found, mm."""
    return max(
        abs(float(value))
        for camera, values in zip(result.network.cameras, result.state.terms, strict=True)
        for term, value in zip(camera.terms, values, strict=True)
        if term.kind in ("shift-x", "shift-y")
    )


def lab_network(
    rig: Rig,
    exposures: Sequence[Exposure],
    field: Field,
    looks: Looks,
    *,
    offset_sigma_mm: float,
    skew_sigma_per_mm: float,
    sigma_px: float,
    drawn: Rig,
) -> Network:
    """The bundle: a camera and a head for every cone, terms for every CCD.

    `drawn` is the rig file whose projection centres count as observed.
    """
    master = _master(rig)
    cone_index = {cone.name: k for k, cone in enumerate(rig.cones)}
    of_sensor = np.array([cone_index[rig.cone_of(s.name).name] for s in rig.sensors])
    cone_of_look = of_sensor[looks.sensor]
    looked = set(cone_of_look.tolist())
    pairs = sorted(set(zip(looks.exposure.tolist(), cone_of_look.tolist(), strict=True)))
    image_of = {pair: k for k, pair in enumerate(pairs)}
    xy = np.empty_like(looks.px)
    sigma = np.empty_like(looks.px)
    for j, sensor in enumerate(rig.sensors):
        own = looks.sensor == j
        xy[own] = layer_mm(sensor, looks.px[own])
        sigma[own] = sigma_px * sensor.pitch_mm
    heads = tuple(
        Head(
            cone.name,
            rotation_matrix(*cone.rotation_rad),
            _offset_m(drawn, cone),
            rotation_free=free,
            offset_free=free,
            offset_sigma_m=offset_sigma_mm * 1e-3 if free else None,
        )
        for k, cone in enumerate(rig.cones)
        for free in [cone.name != master.name and k in looked]
    )
    used = np.unique(looks.target)
    point_of = np.full(len(field.names), -1)
    point_of[used] = np.arange(len(used))
    names = tuple(e.name for e in exposures)
    held = np.zeros(len(exposures), bool)
    return Network(
        cameras=tuple(
            _camera(cone, skew_sigma_per_mm)
            if k in looked
            # A cone that took no part stays as it is.
            else Camera(cone.name, cone.lens.f_mm)
            for k, cone in enumerate(rig.cones)
        ),
        stations=Stations(names, np.stack([e.position_m for e in exposures]), held),
        attitudes=Attitudes(names, np.stack([e.object_from_rig for e in exposures]), held),
        images=Images(
            tuple(f"{exposures[e].name}/{rig.cones[c].name}" for e, c in pairs),
            station=np.array([e for e, _ in pairs]),
            attitude=np.array([e for e, _ in pairs]),
            camera=np.array([c for _, c in pairs]),
            head=np.array([c for _, c in pairs]),
        ),
        points=Points(
            tuple(field.names[k] for k in used),
            field.xyz_m[used],
            np.repeat(field.sigma_m[used, None], 3, axis=1),
            np.zeros(len(used), bool),
        ),
        image_points=ImagePoints(
            image=np.array(
                [
                    image_of[pair]
                    for pair in zip(looks.exposure.tolist(), cone_of_look.tolist(), strict=True)
                ]
            ),
            point=point_of[looks.target],
            xy_mm=xy,
            sigma_mm=sigma,
        ),
        heads=heads,
    )


def term_name(sensor: Sensor, kind: Kind) -> str:
    return f"{sensor.name} {kind}"


def _camera(cone: Cone, skew_sigma_per_mm: float) -> Camera:
    parts = tuple(_part(cone, sensor) for sensor in cone.sensors)
    terms, sigma = [], {}
    for k, sensor in enumerate(cone.sensors):
        kinds: list[Kind] = ["shift-x", "shift-y", "scale", "perspective-x", "perspective-y"]
        if k > 0:
            kinds.append("rotation")
        for kind in kinds:
            terms.append(Term(term_name(sensor, kind), kind, (sensor.name,), parts))
            if kind in ("perspective-x", "perspective-y"):
                sigma[term_name(sensor, kind)] = skew_sigma_per_mm
    interior = np.array([float(getattr(cone.lens, LENS_KEYS[name])) for name in INTERIOR])
    return Camera(
        cone.name,
        cone.lens.f_mm,
        interior=interior,
        free=frozenset(LENS_FREE),
        sigma=sigma,
        terms=tuple(terms),
    )


def _part(cone: Cone, sensor: Sensor) -> Part:
    half = np.array([sensor.width_px, sensor.height_px]) * sensor.pitch_mm / 2.0
    return Part(
        sensor.name,
        cone.name,
        sensor.x_mm - float(half[0]),
        sensor.y_mm - float(half[1]),
        sensor.x_mm + float(half[0]),
        sensor.y_mm + float(half[1]),
    )


def _moved(rig: Rig, result: Adjustment) -> Rig:
    """The rig with what an adjustment found; skew is not part of a rig."""
    master = _master(rig)
    cones = []
    angles = omega_phi_kappa(result.state.head_rotation)
    for k, cone in enumerate(rig.cones):
        camera = result.network.cameras[k]
        if not camera.terms:
            cones.append(cone)
            continue
        values = dict(
            zip([t.name for t in camera.terms], result.state.terms[k].tolist(), strict=True)
        )
        lens: dict[str, Any] = {
            LENS_KEYS[n]: float(v)
            for n, v in zip(INTERIOR, result.state.interior[k], strict=True)
            if n in LENS_FREE
        }
        right, forward, up = (float(v) * 1e3 for v in result.state.head_offset[k])
        at = master.position_mm
        is_master = cone.name == master.name
        cones.append(
            replace(
                cone,
                lens=replace(cone.lens, **lens),
                rotation_rad=cone.rotation_rad
                if is_master
                else (float(angles[k, 0]), float(angles[k, 1]), float(angles[k, 2])),
                position_mm=cone.position_mm
                if is_master
                else (at[0] + forward, at[1] + right, at[2] - up),
                sensors=tuple(_placed(s, values) for s in cone.sensors),
            )
        )
    return replace(rig, cones=tuple(cones))


def _placed(sensor: Sensor, values: Mapping[str, float]) -> Sensor:
    return replace(
        sensor,
        x_mm=sensor.x_mm + values[term_name(sensor, "shift-x")],
        y_mm=sensor.y_mm + values[term_name(sensor, "shift-y")],
        scale=sensor.scale * (1.0 + values[term_name(sensor, "scale")]),
        rotation_rad=sensor.rotation_rad + values.get(term_name(sensor, "rotation"), 0.0),
    )


def _at_temperatures(rig: Rig, mean: Mapping[str, float]) -> Rig:
    """The new places hold at the temperatures of the calibration."""
    return replace(
        rig,
        cones=tuple(
            replace(
                cone,
                calibration_c=round(mean.get(cone.probe, cone.calibration_c), 2),
                sensors=tuple(
                    replace(s, calibration_c=round(mean.get(s.probe, s.calibration_c), 2))
                    for s in cone.sensors
                ),
            )
            for cone in rig.cones
        ),
    )


def _skew(rig: Rig, result: Adjustment) -> dict[str, tuple[float, float]]:
    found = {}
    for k, cone in enumerate(rig.cones):
        names = [t.name for t in result.network.cameras[k].terms]
        for sensor in cone.sensors if names else ():
            x, y = (
                float(result.state.terms[k][names.index(term_name(sensor, kind))])
                for kind in ("perspective-x", "perspective-y")
            )
            found[sensor.name] = (x, y)
    return found
