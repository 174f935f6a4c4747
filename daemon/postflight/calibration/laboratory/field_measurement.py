"""Frames of a 3D test field to image points: the series, discs found, targets identified.

What is made of the points is in `field`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict

from daemon.mission.store.level0 import read_tiff
from daemon.postflight.calibration.laboratory.laboratory_series import (
    PathInFolder,
    SensorOfRig,
    SeriesError,
    SeriesFile,
)
from processing.geometry.lens import measured_from_ideal
from processing.geometry.rotation import rotation_matrix
from processing.matching.disc_targets import disc_positions, identify_targets
from processing.rig import Cone, Rig, Sensor
from processing.rig.value_types import Number, Positive, Text, Triple

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

_REACH_PX: Final = 120.0


def _orthogonal(rows: tuple[Triple, Triple, Triple]) -> tuple[Triple, Triple, Triple]:
    matrix = np.array(rows)
    if not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3):
        raise ValueError("it is a rotation matrix, three rows of three numbers")
    return rows


Rotation = Annotated[tuple[Triple, Triple, Triple], AfterValidator(_orthogonal)]


class _Row(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SurveyedTarget(_Row):
    """A target of the field with its standard deviation."""

    name: Text
    xyz_m: Triple
    sigma_m: Positive


class FieldImage(_Row):
    """One look at the field, as the list has it."""

    name: Text
    files: dict[SensorOfRig, PathInFolder]
    position_m: Triple
    object_from_rig: Rotation
    temperatures: dict[str, Number] = {}


class FieldSeries(SeriesFile):
    """The keys of a series for `calibrate lab`."""

    KIND = "lab"

    images: tuple[FieldImage, ...]
    offset_sigma_mm: Positive = 0.2
    skew_sigma_per_mm: Positive = 5e-6
    targets: tuple[SurveyedTarget, ...]


@dataclass(frozen=True)
class FieldExposure:
    """One look at the field: frames by sensor, where the rig stood about, and temperatures."""

    name: str
    files: Mapping[str, Path]
    position_m: Array
    object_from_rig: Array
    temperatures: Mapping[str, float]


@dataclass(frozen=True)
class TargetField:
    """Surveyed targets: names, (n, 3) m, (n,) m."""

    names: tuple[str, ...]
    xyz_m: Array
    sigma_m: Array


@dataclass(frozen=True)
class TargetObservations:
    """Image measurements: exposure, sensor and target by index (n,), and places (n, 2) px."""

    exposure: NDArray[np.int64]
    sensor: NDArray[np.int64]
    target: NDArray[np.int64]
    px: Array


def field_exposures(series: FieldSeries) -> list[FieldExposure]:
    """The exposures of a series."""
    return [
        FieldExposure(
            name=image.name,
            files=image.files,
            position_m=np.array(image.position_m),
            object_from_rig=_nearest_rotation(image.object_from_rig),
            temperatures=image.temperatures,
        )
        for image in series.images
    ]


def field_of(series: FieldSeries) -> TargetField:
    """The targets of a series."""
    return TargetField(
        tuple(target.name for target in series.targets),
        np.array([target.xyz_m for target in series.targets]).reshape(-1, 3),
        np.array([target.sigma_m for target in series.targets]),
    )


def _nearest_rotation(rows: Rotation) -> Array:
    left, _, right = np.linalg.svd(np.array(rows))
    return np.asarray(left @ right)


def measure_targets(
    rig: Rig, exposures: Sequence[FieldExposure], field: TargetField, *, progress: Progress
) -> TargetObservations:
    """Find the discs of every frame and identify the target of each.

    Raises:
        SeriesError: no frame shows the field where it is expected.
        daemon.mission.store.level0.RasterError: a frame cannot be read.
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
            a, b = identify_targets(predicted, found, reach_px=_REACH_PX)
            rows += [
                (k, j, int(index[p]), float(found[q, 0]), float(found[q, 1]))
                for p, q in zip(a, b, strict=True)
            ]
            done += 1
            progress(f"measuring {exposure.name}", done, total)
    if not rows:
        raise SeriesError(["no frame shows the targets where they are expected; check the poses"])
    table = np.array(rows)
    indices = table[:, :3].astype(np.int64)
    return TargetObservations(indices[:, 0], indices[:, 1], indices[:, 2], table[:, 3:])


def _predicted(
    rig: Rig, sensor: Sensor, exposure: FieldExposure, field: TargetField
) -> tuple[Array, NDArray[np.int64]]:
    """Positions of targets by the nominal rig, px, and their ids."""
    cone = rig.cone_of(sensor.name)
    centre = exposure.position_m + exposure.object_from_rig @ offset_m(rig, cone)
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


def master_of(rig: Rig) -> Cone:
    """The master cone, the first where there is none."""
    return rig.cone(rig.master_cone) if rig.master_cone else rig.cones[0]


def offset_m(rig: Rig, cone: Cone) -> Array:
    """Projection centre against the master cone's, in the axes of its camera, m."""
    forward, right, down = np.subtract(cone.position_mm, master_of(rig).position_mm)
    return np.array([right, forward, -down]) * 1e-3
