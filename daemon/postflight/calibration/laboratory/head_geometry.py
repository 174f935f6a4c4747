"""Geometric calibration of a head from collimator series (`calibrate head`).

Targets are found by matching them to one another, their known directions and the ten parameters
adjusted with one rotation for every series. Source: Heier et al. (2002), 5.1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, Strict

from daemon.mission.store.level0 import read_tiff
from daemon.postflight.calibration.laboratory.laboratory_series import (
    PathInFolder,
    SensorOfRig,
    SeriesError,
    SeriesFile,
)
from processing.bundle.adjust import Adjustment, AdjustmentSettings, adjust
from processing.bundle.adjustment_results import image_residuals_mm
from processing.bundle.network import (
    INTERIOR,
    Attitudes,
    CameraModel,
    ImagePoints,
    Images,
    Network,
    NetworkError,
    Points,
    Stations,
)
from processing.bundle.rank_diagnosis import RankDefectError
from processing.geometry.placement import layer_mm_from_raw
from processing.geometry.residual_grid import (
    ResidualGrid,
    cross_validation_residuals,
    fit_residual_grid,
)
from processing.geometry.rotation import rotation_from_angles, rotation_matrix
from processing.matching.target_matching import (
    TargetImage,
    TargetPositions,
    first_guess,
    positions_of,
)
from processing.rig import Cone, Lens, Sensor
from processing.rig.value_types import Number, Positive, Text

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]
Pixel = Annotated[int, Strict()]

FREE: Final = ("dx0", "dy0", "df", "k1", "k2", "p1", "p2", "b1", "b2")
"""Without k3, which a field of 40 degrees hardly separates from k2."""
LENS_KEYS: Final = {
    name: f"{name}_mm" if name in ("dx0", "dy0", "df") else name for name in INTERIOR
}
REJECT_BEYOND: Final = 4.5
GRID_NODES: Final = (9, 7)
_MIN_TARGETS: Final = 12


@dataclass(frozen=True)
class Target:
    """One image: a cut-out at `origin_px`, its collimator angles and its series."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    path: Annotated[PathInFolder, Field(alias="file")]
    sensor: SensorOfRig
    series: Text
    alpha_rad: Number
    beta_rad: Number
    temperature_c: Number
    rotation_deg: Number = 0.0
    origin_px: tuple[Pixel, Pixel] = (0, 0)


class CollimatorSeries(SeriesFile):
    """The keys of a series for `calibrate head`."""

    KIND = "head"
    RENAMED: ClassVar = {"images.turned_deg": "rotation_deg"}

    images: tuple[Target, ...]
    target_radius_rad: Positive
    angle_sigma_rad: Positive = 1e-6


@dataclass(frozen=True)
class HeadGeometry:
    """Result of a head: the matching, the adjustment, and the grid on top.

    `measured_mm`, `residual_mm` (n, 2) of the targets used; `grid_residual_mm` (n, 2) what a grid
    made of the other half of the targets leaves.
    """

    cone: Cone
    sensor: Sensor
    matching: TargetPositions
    adjustment: Adjustment
    measured_mm: Array
    residual_mm: Array
    grid_residual_mm: Array
    grid: ResidualGrid
    series: tuple[str, ...]
    temperature_c: float
    sigma_mm: float

    @property
    def residual_px(self) -> float:
        """Root mean square of a coordinate's residual to the ten parameters, px."""
        return float(np.sqrt(np.mean(self.residual_mm**2))) / self.sensor.pitch_mm

    @property
    def grid_residual_px(self) -> float:
        """The same with the grid, at targets that it was not made of."""
        return float(np.sqrt(np.mean(self.grid_residual_mm**2))) / self.sensor.pitch_mm

    @property
    def lens(self) -> Lens:
        """The rig's lens with what was found; the grid where it helps at targets not its own."""
        found = self.adjustment.state.interior[0]
        values: dict[str, Any] = {
            LENS_KEYS[n]: float(v) for n, v in zip(INTERIOR, found, strict=True)
        }
        grid = self.grid.as_lens_grid() if self.grid_residual_px < self.residual_px else None
        return replace(self.cone.lens, **values, residual_grid=grid)


def collimator_axes(alpha_rad: float, beta_rad: float) -> Array:
    """Columns: direction to the target, and the axes of its plane along alpha and beta; (3, 3).

    alpha turns about the laboratory's y, beta lifts: direction (sin a cos b, sin b, -cos a cos b).
    """
    right, up, backwards = rotation_from_angles("YX", [-alpha_rad, beta_rad]).T
    return np.stack([-backwards, right, up], axis=1)


def rotation_about_axis(degrees: float) -> Array:
    """Laboratory from camera for a head turned in its holder, (3, 3)."""
    return rotation_matrix(0.0, 0.0, math.radians(degrees))


def calibrate_head(
    cone: Cone,
    sensor: Sensor,
    targets: Sequence[Target],
    *,
    target_radius_rad: float,
    angle_sigma_rad: float,
    free: Sequence[str] = FREE,
    progress: Progress,
) -> HeadGeometry:
    """Match the targets of one head and adjust.

    Raises:
        SeriesError: too few targets, or directions that do not determine the parameters (named).
        daemon.mission.store.level0.RasterError: an image cannot be read.
    """
    if len(targets) < _MIN_TARGETS:
        raise SeriesError(
            [f"{sensor.name}: {len(targets)} targets; {_MIN_TARGETS} or more are needed"]
        )
    images = []
    for k, target in enumerate(targets):
        pixels = read_tiff(target.path).astype(np.float64)
        by_target, bend = _nominal(cone, sensor, target)
        images.append(TargetImage(pixels, first_guess(pixels), by_target, bend))
        progress(f"{sensor.name}: reading", k + 1, len(targets))
    radius_px = target_radius_rad * cone.lens.f_mm / sensor.pitch_mm
    matching = positions_of(
        images,
        half_px=max(5, math.ceil(1.25 * radius_px)),
        progress=lambda done, total: progress(f"{sensor.name}: matching", done, total),
    )
    matched = [k for k in range(len(targets)) if np.isfinite(matching.position_px[k]).all()]
    px = matching.position_px[matched] + np.array([targets[k].origin_px for k in matched])
    matched_mm = float(np.median(matching.sigma_px[matched])) * sensor.pitch_mm
    sigma_mm = math.hypot(matched_mm, angle_sigma_rad * cone.lens.f_mm)
    network = head_network(
        cone,
        [targets[k] for k in matched],
        layer_mm_from_raw(sensor, px),
        sigma_mm=sigma_mm,
        free=free,
    )
    return _adjusted(cone, sensor, targets, matching, network, sigma_mm)


def head_network(
    cone: Cone,
    targets: Sequence[Target],
    measured_mm: Array,
    *,
    sigma_mm: float,
    free: Sequence[str] = FREE,
) -> Network:
    """Known directions seen by one camera: three unknowns a series, and the parameters."""
    names = tuple(dict.fromkeys(t.series for t in targets))
    index = {name: k for k, name in enumerate(names)}
    rotated = [next(t.rotation_deg for t in targets if t.series == name) for name in names]
    lens = cone.lens
    interior = np.array([float(getattr(lens, LENS_KEYS[name])) for name in INTERIOR])
    camera = CameraModel(cone.name, lens.f_mm, interior=interior, free=frozenset(free))
    count = np.arange(len(names))
    directions = np.array([collimator_axes(t.alpha_rad, t.beta_rad)[:, 0] for t in targets])
    return Network(
        cameras=(camera,),
        stations=Stations(("collimator",), np.zeros((1, 3)), np.ones(1, bool)),
        attitudes=Attitudes(
            names,
            np.array([rotation_about_axis(t) for t in rotated]),
            np.zeros(len(names), bool),
        ),
        images=Images(
            names,
            station=np.zeros(len(names), np.int64),
            attitude=count,
            camera=np.zeros(len(names), np.int64),
            head=np.full(len(names), -1),
        ),
        points=Points(
            tuple(f"target {k}" for k in range(len(targets))),
            directions,
            np.zeros((len(targets), 3)),
            np.ones(len(targets), bool),
        ),
        image_points=ImagePoints(
            image=np.array([index[t.series] for t in targets]),
            point=np.arange(len(targets)),
            xy_mm=measured_mm,
            sigma_mm=np.full((len(targets), 2), sigma_mm),
        ),
    )


def _adjusted(
    cone: Cone,
    sensor: Sensor,
    targets: Sequence[Target],
    matching: TargetPositions,
    network: Network,
    sigma_mm: float,
) -> HeadGeometry:
    try:
        first = adjust(network)
        # What the lens does beyond its parameters must not make good targets look like blunders.
        spread = max(first.sigma0, 1.0)
        scaled = replace(
            network,
            image_points=replace(
                network.image_points, sigma_mm=network.image_points.sigma_mm * spread
            ),
        )
        result = adjust(scaled, AdjustmentSettings(reject_beyond=REJECT_BEYOND))
    except RankDefectError as error:
        raise SeriesError([f"{sensor.name}: {d.sentence}" for d in error.rank_defects]) from error
    except NetworkError as error:
        raise SeriesError([f"{sensor.name}: {p}" for p in error.problems]) from error
    residual = image_residuals_mm(result)
    used = ~result.rejected & np.isfinite(residual).all(axis=1)
    measured, residual = network.image_points.xy_mm[used], residual[used]
    half = (sensor.width_px * sensor.pitch_mm / 2.0, sensor.height_px * sensor.pitch_mm / 2.0)
    return HeadGeometry(
        cone=cone,
        sensor=sensor,
        matching=matching,
        adjustment=result,
        measured_mm=measured,
        residual_mm=residual,
        grid_residual_mm=cross_validation_residuals(
            measured, residual, half_mm=half, nodes=GRID_NODES
        ),
        grid=fit_residual_grid(measured, residual, half_mm=half, nodes=GRID_NODES),
        series=network.attitudes.names,
        temperature_c=float(np.mean([t.temperature_c for t in targets])),
        sigma_mm=sigma_mm,
    )


def _nominal(cone: Cone, sensor: Sensor, target: Target) -> tuple[Array, Array]:
    """First and half of the second derivatives of pixel position by place on the target."""
    axes = rotation_about_axis(target.rotation_deg).T @ collimator_axes(
        target.alpha_rad, target.beta_rad
    )
    scale = cone.lens.f_mm / sensor.pitch_mm

    def pixel(x: float, y: float) -> Array:
        ray = axes @ np.array([1.0, x, y])
        return np.array([-scale * ray[0] / ray[2], scale * ray[1] / ray[2]])

    h = 1e-3
    middle = pixel(0.0, 0.0)
    right, left, up, down = pixel(h, 0), pixel(-h, 0), pixel(0, h), pixel(0, -h)
    cross = pixel(h, h) - pixel(h, -h) - pixel(-h, h) + pixel(-h, -h)
    first = np.stack([(right - left) / (2 * h), (up - down) / (2 * h)], axis=1)
    bend = np.stack([right + left - 2 * middle, 0.5 * cross, up + down - 2 * middle], axis=1)
    return first, bend / (2 * h * h)
