"""Each head of a rig as an image of its own, resampled once to strict perspective.

For rigs with diverging axes (oblique heads) nothing is stitched: distortion, principal point and
the drift of sensor and lens are taken out, and the image is a central perspective of `f_mm`.

Source: Jacobsen (2008) ("perfect perspective based on a resampling").
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from processing.geometry.conditions import (
    Conditions,
    UsableTemperatures,
    condition_figures,
    usable_temperatures,
)
from processing.geometry.placement import nominal_placements, raw_from_vip_mm, vip_mm_from_px
from processing.geometry.rotation import rotation_matrix
from processing.image.kernels import DEFAULT_INTERPOLATION, Interpolation
from processing.image.lattice import OUTSIDE
from processing.image.resampling import (
    SATURATED_SOURCE,
    SUPPORT_MARGIN_PX,
    WEIGHT_UNIT,
    resample,
)
from processing.image.sharpness import bright_level
from processing.pipelines.synthetic_frames import synthetic_head_frames
from processing.quality.evaluation import evaluate
from processing.quality.figures import valid_area_figures
from processing.quality.readout import blank_unread, unread_figures
from processing.quality.report import Figure, QualityReport, Thresholds
from processing.quality.requirements import QualityRequirements
from processing.quality.signal_steps import line_means_of, signal_steps, step_figures
from processing.quality.valid_area import ValidArea, area_of, gap_cells, grid_of
from processing.quality.word_format import word_format_figures
from processing.radiometry.calibration import RadiometricCalibration
from processing.radiometry.demosaic import BAYER_BANDS, demosaic, is_bayer
from processing.radiometry.level1 import (
    LEVEL1_CEILING,
    LEVEL1_FLOOR,
    FrameStatistics,
    corrector_for,
    level1_from_level0,
)
from processing.rig import Cone, Rig, VirtualImage

Array = NDArray[Any]

DIVERGING_AXES_RAD: Final = math.radians(15.0)
_CELL_PX: Final = 16
"""The mapping is exact at every sixteenth pixel and linear between: 14 px of distortion at the
corner bend by less than 1e-3 px over that."""


@dataclass(frozen=True)
class HeadImage:
    """One head's image: `bands` by name (h, w) uint16, 0 is no data, the lowest bit saturation; all
    of it a perspective of `image`."""

    cone: str
    image: VirtualImage
    bands: Mapping[str, NDArray[np.uint16]]


@dataclass(frozen=True)
class HeadsProduct:
    """The images of one exposure by cone name, and their quality report.

    `valid_area` is that of the rig's image cone, whose image the plan counts.
    """

    heads: Mapping[str, HeadImage]
    valid_area: ValidArea
    report: QualityReport
    timings_s: Mapping[str, float] = field(default_factory=dict)


def has_diverging_axes(rig: Rig) -> bool:
    """Whether a rig without a virtual image has heads of which each is an image of its own."""
    if rig.virtual_image is not None:
        return False
    if any(len(cone.bands) > 1 for cone in rig.cones):
        return True
    axes = np.array([rotation_matrix(*c.rotation_rad)[:, 2] for c in rig.cones])
    return bool(np.arccos(np.clip(axes @ axes.T, -1.0, 1.0)).max() > DIVERGING_AXES_RAD)


def perspective_of(cone: Cone) -> VirtualImage:
    """The strict perspective a head is resampled to: its own pixels and principal distance."""
    sensor = cone.sensors[0]
    return VirtualImage(sensor.width_px, sensor.height_px, sensor.pitch_um, cone.lens.f_mm, 1)


def raw_of_perspective(
    cone: Cone, temperatures_c: Mapping[str, float], colrow: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Raw pixels (n, 2) of pixels (n, 2) of the strict perspective; NaN where the lens folds."""
    image = perspective_of(cone)
    return raw_from_vip_mm(_placement(cone, temperatures_c), vip_mm_from_px(image, colrow))


class HeadPipeline:
    """A rig with diverging axes, and its radiometric calibrations.

    Args:
        rig: every cone has one sensor.
        radiometry: by sensor name; a sensor without one is taken as flat.
        interpolation: as in `processing.image.kernels`.
        requirements: of the project, if any.

    Raises:
        ValueError: a rig of other make.
        processing.radiometry.calibration.CalibrationError: a calibration that is not the sensor's.
    """

    def __init__(
        self,
        rig: Rig,
        radiometry: Mapping[str, RadiometricCalibration] | None = None,
        *,
        interpolation: Interpolation = DEFAULT_INTERPOLATION,
        threads: int = 2,
        thresholds: Thresholds | None = None,
        requirements: QualityRequirements | None = None,
    ) -> None:
        if rig.virtual_image is not None or any(len(c.sensors) != 1 for c in rig.cones):
            raise ValueError(
                f"rig {rig.name}: heads are images of their own where each has one sensor and "
                "there is no [virtual_image]"
            )
        self.rig = rig
        self._correctors = {
            sensor.name: corrector_for(sensor, (radiometry or {}).get(sensor.name))
            for sensor in rig.sensors
        }
        self._interpolation = interpolation
        self._threads = threads
        self._thresholds = thresholds or Thresholds()
        self._requirements = requirements or QualityRequirements()
        self._lattices: dict[str, tuple[tuple[float | None, float | None], Array]] = {}

    def clone(self) -> HeadPipeline:
        """Another for an exposure at the same time; calibrations and lattices are shared."""
        return copy.copy(self)

    def warm_up(self) -> None:
        """Compile every kernel a flight will need, from the cache where there is one."""
        frames = synthetic_head_frames(self.rig)
        self.process(frames, Conditions())
        # Frames in memory may be read-only to the kernels: that is another variant of one of them.
        for sensor in self.rig.sensors:
            frames[sensor.name].flags.writeable = False
            level1_from_level0(
                self._correctors[sensor.name],
                frames[sensor.name],
                temperature_c=None,
                exposure_time_s=0.0,
                tdi_shifts=0,
                out=np.empty((sensor.height_px, sensor.width_px), np.uint16),
            )

    def process(
        self,
        frames: Mapping[str, Array],
        conditions: Conditions,
        *,
        frames_read: Callable[[], None] | None = None,
    ) -> HeadsProduct:
        """Make the images of one exposure.

        Args:
            frames: Level-0 by sensor name, (h, w) uint16; a missing one leaves no image.
            conditions: temperatures, exposure times, what capture knows.
            frames_read: called once the pixels of `frames` are no longer needed.

        Raises:
            ValueError: a frame of the wrong shape or type.
        """
        cv2.setNumThreads(self._threads)
        numba.set_num_threads(max(1, min(self._threads, int(numba.config.NUMBA_NUM_THREADS))))
        seconds = {"radiometry": 0.0, "resampling": 0.0}
        temperatures = usable_temperatures(self.rig, conditions, self._thresholds)
        known = temperatures.placement_temperatures_c
        heads: dict[str, HeadImage] = {}
        level1: dict[str, Array] = {}
        planes: dict[str, dict[str, Array]] = {}
        statistics: dict[str, FrameStatistics] = {}
        present = [cone for cone in self.rig.cones if cone.sensors[0].name in frames]
        for cone in present:
            sensor = cone.sensors[0]
            began = time.perf_counter()
            level1[sensor.name] = np.empty((sensor.height_px, sensor.width_px), np.uint16)
            statistics[sensor.name] = level1_from_level0(
                self._correctors[sensor.name],
                np.ascontiguousarray(frames[sensor.name]),
                temperature_c=known.get(sensor.probe),
                exposure_time_s=conditions.exposure_time_s.get(sensor.name, 0.0),
                tdi_shifts=0,
                out=level1[sensor.name],
            )
            planes[cone.name] = _planes(cone, level1[sensor.name])
            blank_unread(sensor, frames[sensor.name], *planes[cone.name].values())
            seconds["radiometry"] += time.perf_counter() - began
        seen = {**unread_figures(self.rig, frames), **word_format_figures(self.rig, frames)}
        if frames_read is not None:
            frames_read()
        for cone in present:
            began = time.perf_counter()
            lattice = self._lattice(cone, known)
            bands = {
                name: self._resampled(plane, lattice) for name, plane in planes[cone.name].items()
            }
            heads[cone.name] = HeadImage(cone.name, perspective_of(cone), bands)
            seconds["resampling"] += time.perf_counter() - began
        area = self._valid_area(heads)
        seen |= self._step_figures(planes)
        report = self._quality_report(conditions, temperatures, level1, statistics, area, seen)
        return HeadsProduct(heads, area, report, seconds)

    def _valid_area(self, heads: Mapping[str, HeadImage]) -> ValidArea:
        cone = self.rig.cone(self.rig.image_cone_name)
        image = perspective_of(cone)
        columns, rows = grid_of(image.width_px, image.height_px)
        nothing = np.ones((rows, columns), np.bool_)
        product = heads[cone.name].bands if cone.name in heads else {}
        return area_of(
            {
                band: gap_cells(product[band], columns, rows, saturated_bit=1)
                if band in product
                else nothing
                for band in _bands(cone)
            }
        )

    def _quality_report(
        self,
        conditions: Conditions,
        temperatures: UsableTemperatures,
        level1: Mapping[str, Array],
        statistics: Mapping[str, FrameStatistics],
        area: ValidArea,
        seen: Mapping[str, Figure],
    ) -> QualityReport:
        missing = [s.name for s in self.rig.sensors if s.name not in level1]
        figures = condition_figures(self.rig, conditions, temperatures)
        figures |= {**valid_area_figures(area), **seen}
        figures |= {"method": "heads", "missing_sensors": ", ".join(missing) or None}
        if statistics:
            saturated = {name: seen.saturated_fraction for name, seen in statistics.items()}
            worst = max(saturated, key=lambda name: saturated[name])
            figures |= {
                "mean_dn": float(np.mean([seen.mean_dn for seen in statistics.values()])),
                "saturated_fraction": float(np.mean(list(saturated.values()))),
                "saturated_worst_fraction": saturated[worst],
                "saturated_worst_sensor": worst,
                "bright_fraction": bright_level(
                    [self.rig.sensor(name) for name in level1], list(level1.values())
                ),
            }
        return evaluate(
            figures,
            capture_flags=conditions.flags,
            missing_sensors=missing,
            missing_probes=temperatures.missing,
            probes_out_of_range=temperatures.out_of_range,
            thresholds=self._thresholds,
            requirements=self._requirements,
        )

    def _step_figures(self, planes: Mapping[str, Mapping[str, Array]]) -> dict[str, Figure]:
        """Steps of the signal in green, or in the one band of a head."""
        leading, rows = {}, {}
        for name, bands in planes.items():
            sensor = self.rig.cone(name).sensors[0]
            leading[sensor.name] = bands.get("green", next(iter(bands.values())))
            rows[sensor.name] = (0, sensor.height_px - 1)
        return step_figures(
            signal_steps(self.rig.sensors, line_means_of(self.rig.sensors, leading, rows))
        )

    def _lattice(self, cone: Cone, known: Mapping[str, float]) -> Array:
        """Raw (column, row) at every `_CELL_PX`-th pixel; kept while temperatures stay."""
        key = (known.get(cone.probe), known.get(cone.sensors[0].probe))
        cached = self._lattices.get(cone.name)
        if cached is None or cached[0] != key:
            cached = (key, _lattice_of(cone, known))
            self._lattices[cone.name] = cached
        return cached[1]

    def _resampled(self, plane: Array, lattice: Array) -> NDArray[np.uint16]:
        height, width = plane.shape
        value = np.empty((height, width), np.uint16)
        source = np.empty((height, width), np.uint8)
        edge = float(SUPPORT_MARGIN_PX)
        resample(
            np.ascontiguousarray(plane)[None],
            np.array([[edge, width - 1 - edge - 1e-3, edge, height - 1 - edge - 1e-3]]),
            lattice[None],
            _CELL_PX,
            np.full((1, *(2 * (n - 1) + 1 for n in lattice.shape[:2])), WEIGHT_UNIT, np.uint8),
            np.ones(1, np.float32),
            interpolation=self._interpolation,
            out=value,
            source=source,
        )
        value = np.clip(value, LEVEL1_FLOOR, LEVEL1_CEILING) & np.uint16(0xFFFE)
        value |= (source & SATURATED_SOURCE != 0).astype(np.uint16)
        value[source == 0] = 0
        return np.asarray(value, np.uint16)


def _planes(cone: Cone, level1: NDArray[np.uint16]) -> dict[str, NDArray[np.uint16]]:
    sensor = cone.sensors[0]
    if not is_bayer(sensor):
        return {cone.bands[0]: level1}
    out = np.empty((3, *level1.shape), np.uint16)
    demosaic(level1, sensor.colour_filter_array, out=out)
    return dict(zip(BAYER_BANDS, out, strict=True))


def _bands(cone: Cone) -> Sequence[str]:
    return BAYER_BANDS if is_bayer(cone.sensors[0]) else cone.bands[:1]


def _placement(cone: Cone, temperatures_c: Mapping[str, float]) -> Any:
    """The head as if it alone were the rig: no rotation, its own perspective."""
    single_cone = replace(
        cone, role="pan", rotation_rad=(0.0, 0.0, 0.0), position_mm=(0.0, 0.0, 0.0)
    )
    rig = Rig(
        name=cone.name,
        title="",
        timing="synchronous",
        frame_interval_s=1.0,
        master_cone=cone.name,
        colour_master_cone=None,
        reference_cone=cone.name,
        calibration_id="",
        calibration_date="",
        virtual_image=perspective_of(cone),
        cones=(single_cone,),
    )
    return nominal_placements(rig, temperatures_c, {})[cone.sensors[0].name]


def _lattice_of(cone: Cone, known: Mapping[str, float]) -> Array:
    """Raw (column, row) at every `_CELL_PX`-th pixel of the perspective, (rows, columns, 2)."""
    sensor = cone.sensors[0]
    columns = np.arange(-(-sensor.width_px // _CELL_PX) + 1) * float(_CELL_PX)
    rows = np.arange(-(-sensor.height_px // _CELL_PX) + 1) * float(_CELL_PX)
    c, r = np.meshgrid(columns, rows)
    raw = raw_of_perspective(cone, known, np.stack([c.ravel(), r.ravel()], axis=1))
    raw[~np.isfinite(raw).all(axis=1)] = OUTSIDE
    return np.asarray(raw.reshape(*c.shape, 2))
