"""Each head of a rig as an image of its own, resampled once to strict perspective.

For rigs without a virtual image, such as oblique heads, nothing is stitched: distortion, principal
point and the drift of sensor and lens are taken out, and the image is a central perspective of
`f_mm`.

Source: Jacobsen (2008) ("perfect perspective based on a resampling").
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.conditions import Conditions
from processing.geometry.placement import head_placement, raw_from_vip_mm, vip_mm_from_px
from processing.geometry.rotation import rotation_matrix
from processing.image.kernels import DEFAULT_INTERPOLATION, Interpolation
from processing.image.lattice import OUTSIDE
from processing.image.line_means import line_means
from processing.image.resampling import (
    SATURATED_SOURCE,
    SUPPORT_MARGIN_PX,
    WEIGHT_UNIT,
)
from processing.pipelines.exposure_pipeline import (
    ExposureInput,
    ExposurePipeline,
    Judgement,
    Stages,
    StageSettings,
)
from processing.pipelines.synthetic_frames import synthetic_head_frames
from processing.quality.dark_frames import dark_frame_figures, dark_frames
from processing.quality.defect_lines import defect_line_figures, defect_lines
from processing.quality.figures import FigureGroup
from processing.quality.frame_identity import FixedPatterns, heads_by_pattern, pattern_figures
from processing.quality.frame_signal import signal_figures
from processing.quality.line_order import line_order_figures
from processing.quality.readout import blank_unread, unread_figures
from processing.quality.repeated_lines import repeated_line_figures
from processing.quality.report import QualityReport
from processing.quality.signal_steps import signal_steps, step_figures
from processing.quality.valid_area import ValidArea, area_of_rasters, grid_of
from processing.quality.word_format import word_format_figures
from processing.radiometry.calibration import RadiometricCalibration
from processing.radiometry.corrector import correctors_for
from processing.radiometry.demosaic import BAYER_BANDS, demosaic, is_bayer
from processing.radiometry.level1 import LEVEL1_CEILING, LEVEL1_FLOOR, FrameStatistics
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


def has_head_images(rig: Rig) -> bool:
    """Whether each head of a rig is an image of its own.

    Without a virtual image, heads of one band each are registered to the colour master. Heads of
    several bands, of the same band, with diverging axes, and PAN heads without colour are not.

    Args:
        rig: the camera.

    Returns:
        False for rigs with a virtual image, which are stitched.
    """
    if rig.virtual_image is not None:
        return False
    bands = [cone.bands for cone in rig.cones]
    if any(len(one) > 1 for one in bands) or len(set(bands)) < len(bands):
        return True
    is_pan = rig.colour_master_cone is None and bool(rig.pan_cones)
    return is_pan or has_diverging_axes(rig)


def has_diverging_axes(rig: Rig) -> bool:
    """Whether the heads of a rig look into different directions.

    Args:
        rig: the camera.

    Returns:
        True where two optical axes differ by more than `DIVERGING_AXES_RAD`.
    """
    axes = np.array([rotation_matrix(*c.rotation_rad)[:, 2] for c in rig.cones])
    return bool(np.arccos(np.clip(axes @ axes.T, -1.0, 1.0)).max() > DIVERGING_AXES_RAD)


def perspective_of(cone: Cone) -> VirtualImage:
    """The strict perspective a head is resampled to: its own pixels and principal distance.

    Args:
        cone: with one sensor.

    Returns:
        Size, pitch and principal distance, without drift.
    """
    sensor = cone.sensors[0]
    return VirtualImage(sensor.width_px, sensor.height_px, sensor.pitch_um, cone.lens.f_mm, 1)


def raw_of_perspective(
    cone: Cone, temperatures_c: Mapping[str, float], colrow: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Raw pixels of pixels of the strict perspective.

    Args:
        cone: with one sensor.
        temperatures_c: temperature by probe name, degC.
        colrow: column and row of the perspective, (n, 2).

    Returns:
        Raw column and row, (n, 2); NaN where the lens folds.
    """
    image = perspective_of(cone)
    placed = head_placement(cone, cone.sensors[0], image, temperatures_c)
    return raw_from_vip_mm(placed, vip_mm_from_px(image, colrow))


@dataclass(frozen=True, kw_only=True)
class HeadSettings(StageSettings):
    """How exposures of separate heads are processed."""

    interpolation: Interpolation = DEFAULT_INTERPOLATION


@dataclass(frozen=True)
class _CorrectedHeads:
    """Level-1 and statistics by sensor name, the planes of each head by cone name."""

    level1: Mapping[str, Array]
    statistics: Mapping[str, FrameStatistics]
    planes: Mapping[str, Mapping[str, Array]]
    figures: tuple[FigureGroup | None, ...]


_Lattices = Mapping[str, Array]
_Heads = Mapping[str, HeadImage]
_HeadStages = Stages[_CorrectedHeads, _Lattices, _Heads]


class HeadPipeline(
    ExposurePipeline[HeadSettings, _CorrectedHeads, _Lattices, _Heads, HeadsProduct]
):
    """A rig whose heads are images of their own, and its radiometric calibrations.

    Args:
        rig: every cone has one sensor.
        radiometry: by sensor name; a sensor without one is taken as flat.
        settings: None takes the defaults.

    Raises:
        ValueError: a rig of other make.
        processing.radiometry.calibration.CalibrationError: a calibration that is not the sensor's.
    """

    def __init__(
        self,
        rig: Rig,
        radiometry: Mapping[str, RadiometricCalibration] | None = None,
        settings: HeadSettings | None = None,
    ) -> None:
        if rig.virtual_image is not None or any(len(c.sensors) != 1 for c in rig.cones):
            raise ValueError(
                f"rig {rig.name}: heads are images of their own where each has one sensor and "
                "there is no [virtual_image]"
            )
        super().__init__(rig, settings or HeadSettings())
        self._correctors = correctors_for(rig.sensors, radiometry or {})
        self._patterns = FixedPatterns(self._correctors)
        self._lattices: dict[str, tuple[tuple[float | None, float | None], Array]] = {}

    def clone(self) -> HeadPipeline:
        """Another for an exposure at the same time; calibrations and lattices are shared."""
        return copy.copy(self)

    def warm_up(self) -> None:
        """Compile every kernel a flight will need, from the cache where there is one."""
        frames = synthetic_head_frames(self.rig)
        self.process(frames, Conditions())
        # Frames in memory may be read-only to the kernels: that is another variant of one of them.
        exposure = self._read(frames, Conditions())
        for sensor in self.rig.sensors:
            frames[sensor.name].flags.writeable = False
            out = np.empty((sensor.height_px, sensor.width_px), np.uint16)
            exposure.correct(self._correctors[sensor.name], out=out)

    def _correct(self, exposure: ExposureInput) -> _CorrectedHeads:
        frames = exposure.frames
        level1: dict[str, Array] = {}
        planes: dict[str, dict[str, Array]] = {}
        statistics: dict[str, FrameStatistics] = {}
        with exposure.clock.stage("radiometry"):
            for cone in self._present(exposure):
                sensor = cone.sensors[0]
                out = np.empty((sensor.height_px, sensor.width_px), np.uint16)
                statistics[sensor.name] = exposure.correct(self._correctors[sensor.name], out=out)
                level1[sensor.name] = out
                planes[cone.name] = _planes(cone, out)
                unread = statistics[sensor.name].unread_fraction
                blank_unread(sensor, frames[sensor.name], unread, *planes[cone.name].values())
        unread_fraction = {name: seen.unread_fraction for name, seen in statistics.items()}
        figures = (
            unread_figures(unread_fraction),
            word_format_figures(self.rig, frames),
            repeated_line_figures(self.rig, frames),
            line_order_figures(self.rig, frames),
            dark_frame_figures(dark_frames(self.rig, level1, {})),
            pattern_figures(heads_by_pattern(self.rig, frames, self._patterns, {})),
        )
        return _CorrectedHeads(level1, statistics, planes, figures)

    def _adjust(self, exposure: ExposureInput, corrected: _CorrectedHeads) -> _Lattices:
        """By calibration and drift alone: separate heads have no tie points."""
        known = exposure.temperatures.placement_temperatures_c
        with exposure.clock.stage("resampling"):
            return {cone.name: self._lattice(cone, known) for cone in self._present(exposure)}

    def _resample(
        self, exposure: ExposureInput, corrected: _CorrectedHeads, adjusted: _Lattices
    ) -> _Heads:
        with exposure.clock.stage("resampling"):
            return {
                cone.name: HeadImage(
                    cone.name,
                    perspective_of(cone),
                    {
                        band: self._resampled(plane, adjusted[cone.name])
                        for band, plane in corrected.planes[cone.name].items()
                    },
                )
                for cone in self._present(exposure)
            }

    def _judge(self, stages: _HeadStages) -> Judgement:
        corrected = stages.corrected
        present = [cone.sensors[0] for cone in self._present(stages.exposure)]
        figures = (
            *corrected.figures,
            *signal_figures(present, corrected.level1, corrected.statistics),
            *self._line_figures(corrected.planes),
        )
        return Judgement("heads", figures, self._valid_area(stages.image))

    def _product(
        self, stages: _HeadStages, judgement: Judgement, report: QualityReport
    ) -> HeadsProduct:
        seconds = stages.exposure.clock.seconds
        return HeadsProduct(stages.image, judgement.valid_area, report, seconds)

    def _present(self, exposure: ExposureInput) -> list[Cone]:
        return [cone for cone in self.rig.cones if cone.sensors[0].name in exposure.frames]

    def _valid_area(self, heads: _Heads) -> ValidArea:
        cone = self.rig.cone(self.rig.image_cone_name)
        image = perspective_of(cone)
        cells = grid_of(image.width_px, image.height_px)
        rasters = heads[cone.name].bands if cone.name in heads else {}
        return area_of_rasters(rasters, _bands(cone), cells, saturated_bit=1)

    def _line_figures(
        self, planes: Mapping[str, Mapping[str, Array]]
    ) -> tuple[FigureGroup | None, ...]:
        """Steps of the signal, and defect lines, in green or in the one band of a head."""
        means = {}
        for name, bands in planes.items():
            sensor = self.rig.cone(name).sensors[0]
            leading = bands.get("green", next(iter(bands.values())))
            means[sensor.name] = line_means(leading, (0, sensor.height_px - 1))
        steps = signal_steps(self.rig.sensors, means)
        defects = defect_lines(self.rig.sensors, means)
        return step_figures(steps), defect_line_figures(defects)

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
        self.kernels.resample(
            np.ascontiguousarray(plane)[None],
            np.array([[edge, width - 1 - edge - 1e-3, edge, height - 1 - edge - 1e-3]]),
            lattice[None],
            _CELL_PX,
            np.full((1, *(2 * (n - 1) + 1 for n in lattice.shape[:2])), WEIGHT_UNIT, np.uint8),
            np.ones(1, np.float32),
            interpolation=self.settings.interpolation,
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


def _lattice_of(cone: Cone, known: Mapping[str, float]) -> Array:
    """Raw (column, row) at every `_CELL_PX`-th pixel of the perspective, (rows, columns, 2)."""
    sensor = cone.sensors[0]
    columns = np.arange(-(-sensor.width_px // _CELL_PX) + 1) * float(_CELL_PX)
    rows = np.arange(-(-sensor.height_px // _CELL_PX) + 1) * float(_CELL_PX)
    c, r = np.meshgrid(columns, rows)
    raw = raw_of_perspective(cone, known, np.stack([c.ravel(), r.ravel()], axis=1))
    raw[~np.isfinite(raw).all(axis=1)] = OUTSIDE
    return np.asarray(raw.reshape(*c.shape, 2))
