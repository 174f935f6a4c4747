"""One exposure of a rig without a virtual image: radiance band by band, all in the reference band.

Level-0 words become radiance (or signal where a head has no absolute calibration), each band is
registered to the reference band and resampled once. Rigs that stitch are
`processing.pipelines.stitched`'s.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.geometry.conditions import Conditions, FrameSettings
from processing.geometry.placement import SensorPlacement
from processing.image.band_registration import (
    BandSettings,
    RegisteredBand,
    band_placements,
    raw_of_reference_pixels,
    reference_image,
    register_to_reference,
)
from processing.pipelines.exposure_pipeline import (
    ExposureInput,
    ExposurePipeline,
    Judgement,
    Stages,
    StageSettings,
)
from processing.pipelines.synthetic_frames import synthetic_head_frames
from processing.quality.figures import FigureGroup
from processing.quality.figures.image import SaturationFigures, ValidFigures
from processing.quality.figures.stitching import BandFitFigures, BandShiftFigures
from processing.quality.readout import blank_unread
from processing.quality.report import QualityReport, Thresholds
from processing.quality.valid_area import ValidArea, area_of_rasters, grid_of
from processing.radiometry.level1 import unread_fraction
from processing.radiometry.radiance import RadianceCalibration, radiance_from_raw, saturated_pixels
from processing.rig import Rig, Sensor, VirtualImage

Array = NDArray[Any]

RADIANCE_UNIT: Final = "W/m2/sr/nm"
SIGNAL_UNIT: Final = "DN"
VALID: Final = 1
SATURATED: Final = 2

BAND_THRESHOLDS: Final = replace(
    Thresholds(), saturated_fraction=0.0005, saturated_refly_fraction=0.01
)
"""Ten times less saturation than for a picture: a radiance that is wrong is worse than a roof
without detail."""

_MATCHING_LEVEL: Final = 1000.0
"""Frames are matched with their median at this value: the kernels' guards are made for counts."""


@dataclass(frozen=True)
class BandProduct:
    """The bands of one exposure on the raster of `image`.

    `bands` (H, W) float32 by band in the rig's order, NaN without data, in `units`. `masks` (H, W)
    uint8: VALID and SATURATED bits; `valid_area` describes where they are valid, in a few numbers.
    `registrations` are those of all bands but the reference.
    """

    image: VirtualImage
    reference: str
    bands: Mapping[str, Array]
    masks: Mapping[str, Array]
    units: Mapping[str, str]
    registrations: tuple[RegisteredBand, ...]
    valid_area: ValidArea
    report: QualityReport
    timings_s: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class BandPipelineSettings(StageSettings):
    """How exposures of single-band heads are processed."""

    thresholds: Thresholds = BAND_THRESHOLDS
    registration: BandSettings = field(default_factory=BandSettings)


@dataclass(frozen=True)
class _CorrectedBands:
    """By sensor name: radiance or signal, its unit, saturated pixels, pixels that were read."""

    linear: Mapping[str, Array]
    units: Mapping[str, str]
    saturated: Mapping[str, Array]
    read: Mapping[str, Array]


@dataclass(frozen=True)
class _RegisteredBands:
    """By sensor name: the placement, and the registration of all but the reference."""

    placements: Mapping[str, SensorPlacement]
    registrations: Mapping[str, RegisteredBand]


@dataclass(frozen=True)
class _BandRasters:
    """By band, on the raster of the reference."""

    bands: Mapping[str, Array]
    masks: Mapping[str, Array]
    units: Mapping[str, str]


_BandStages = Stages[_CorrectedBands, _RegisteredBands, _BandRasters]


class BandPipeline(
    ExposurePipeline[
        BandPipelineSettings, _CorrectedBands, _RegisteredBands, _BandRasters, BandProduct
    ]
):
    """A rig of single-band heads without a virtual image, and its radiance calibrations.

    Args:
        rig: every cone has one sensor and one band, all bands differ; `colour_master_cone` is the
            reference band.
        radiance: by sensor name; a sensor without one gives DN above black.
        settings: None takes the defaults.

    Raises:
        ValueError: a rig of other make.
    """

    def __init__(
        self,
        rig: Rig,
        radiance: Mapping[str, RadianceCalibration] | None = None,
        settings: BandPipelineSettings | None = None,
    ) -> None:
        single = all(len(c.sensors) == 1 and len(c.bands) == 1 for c in rig.cones)
        bands = [cone.bands[0] for cone in rig.cones if cone.bands]
        if not single or len(set(bands)) != len(rig.cones):
            raise ValueError(
                f"rig {rig.name}: without a virtual image each cone has one sensor and a band of "
                f"its own; give [virtual_image] for cameras that are stitched"
            )
        super().__init__(rig, settings or BandPipelineSettings())
        self._radiance = dict(radiance or {})
        self._image = reference_image(rig)
        self._band_of = {cone.sensors[0].name: cone.bands[0] for cone in rig.cones}
        assert rig.colour_master_cone is not None
        self._reference = rig.cone(rig.colour_master_cone).sensors[0].name

    def clone(self) -> BandPipeline:
        """Another for an exposure at the same time; calibrations are shared."""
        return copy.copy(self)

    def warm_up(self) -> None:
        """Compile every kernel a flight will need, from the cache where there is one."""
        exposure_time_s = {sensor.name: 0.001 for sensor in self.rig.sensors}
        self.process(synthetic_head_frames(self.rig), Conditions(exposure_time_s=exposure_time_s))

    def _correct(self, exposure: ExposureInput) -> _CorrectedBands:
        linear, saturated, read, units = {}, {}, {}, {}
        with exposure.clock.stage("radiometry"):
            for name in (name for name in self._band_of if name in exposure.frames):
                sensor, frame = self.rig.sensor(name), exposure.frames[name]
                linear[name], units[name] = self._linear(sensor, frame, exposure.conditions)
                saturated[name] = saturated_pixels(sensor, frame)
                read[name] = np.ones(frame.shape, np.uint8)
                blank_unread(sensor, frame, unread_fraction(sensor, frame), read[name])
        return _CorrectedBands(linear, units, saturated, read)

    def _adjust(self, exposure: ExposureInput, corrected: _CorrectedBands) -> _RegisteredBands:
        with exposure.clock.stage("registration"):
            temperatures_c = exposure.temperatures.placement_temperatures_c
            placements = band_placements(self.rig, temperatures_c)
            return _RegisteredBands(placements, self._register(placements, corrected))

    def _resample(
        self, exposure: ExposureInput, corrected: _CorrectedBands, adjusted: _RegisteredBands
    ) -> _BandRasters:
        found = adjusted.registrations
        bands, masks, units = {}, {}, {}
        with exposure.clock.stage("resampling"):
            for name, frame in corrected.linear.items():
                homography = found[name].band_from_reference if name in found else np.eye(3)
                at = raw_of_reference_pixels(self._image, adjusted.placements[name], homography)
                band = self._band_of[name]
                bands[band], masks[band] = _resampled(
                    frame, corrected.saturated[name], corrected.read[name], at
                )
                units[band] = corrected.units[name]
        return _BandRasters(bands, masks, units)

    def _judge(self, stages: _BandStages) -> Judgement:
        found, masks = stages.adjusted.registrations.values(), stages.image.masks
        cells = grid_of(self._image.width_px, self._image.height_px)
        return Judgement(
            "bands",
            _figures(found, stages.corrected.saturated, masks, len(self._band_of)),
            area_of_rasters(masks, self._band_of.values(), cells, saturated_bit=SATURATED),
            nominal_bands=tuple(f.band for f in found if not f.registered),
        )

    def _product(
        self, stages: _BandStages, judgement: Judgement, report: QualityReport
    ) -> BandProduct:
        image = stages.image
        return BandProduct(
            image=self._image,
            reference=self._band_of[self._reference],
            bands=image.bands,
            masks=image.masks,
            units=image.units,
            registrations=tuple(stages.adjusted.registrations.values()),
            valid_area=judgement.valid_area,
            report=report,
            timings_s=stages.exposure.clock.seconds,
        )

    def _linear(self, sensor: Sensor, raw: Array, conditions: Conditions) -> tuple[Array, str]:
        """Radiance, or DN above black where the head has no absolute calibration."""
        head_settings = conditions.frame_settings.get(sensor.name, FrameSettings())
        calibration = self._radiance.get(sensor.name)
        if calibration is None:
            black = (
                sensor.black_dn * sensor.raw_units_per_dn
                if head_settings.black is None
                else head_settings.black
            )
            dn = (np.asarray(raw, np.float32) - np.float32(black)) / sensor.raw_units_per_dn
            return dn.astype(np.float32), SIGNAL_UNIT
        radiance = radiance_from_raw(
            sensor,
            calibration,
            raw,
            exposure_time_s=conditions.exposure_time_s.get(sensor.name, 0.0),
            gain=head_settings.gain,
            black=head_settings.black,
        )
        return radiance, RADIANCE_UNIT

    def _register(
        self, placements: Mapping[str, SensorPlacement], corrected: _CorrectedBands
    ) -> dict[str, RegisteredBand]:
        """All bands but the reference, by sensor name."""
        linear, saturated, read = corrected.linear, corrected.saturated, corrected.read
        matching = {
            name: _for_matching(frame, saturated[name] | (read[name] == 0))
            for name, frame in linear.items()
        }
        found = {}
        for name in (name for name in linear if name != self._reference):
            if self._reference in matching:
                found[name] = register_to_reference(
                    self._band_of[name],
                    placements[self._reference],
                    placements[name],
                    matching[self._reference],
                    matching[name],
                    settings=self.settings.registration,
                )
            else:
                found[name] = RegisteredBand(
                    self._band_of[name], name, np.eye(3), 0, 0, None, None, None,
                    (0.0, 0.0), 0.0, registered=False,
                )  # fmt: skip
        return found


def _figures(
    found: Collection[RegisteredBand],
    saturated: Mapping[str, Array],
    masks: Mapping[str, Array],
    band_count: int,
) -> Iterator[FigureGroup]:
    """Registration by band, saturation by sensor name, and valid pixels of the masks by band.

    What is valid is at most the share of the bands that are there: one of five is no image.
    """
    yield BandFitFigures(
        points_by_band={band.band: band.points for band in found},
        rms_px_by_band={band.band: band.rms_px for band in found},
    )
    yield BandShiftFigures(
        {band.band: band.largest_shift_px if band.registered else None for band in found}
    )
    shares = {name: float(np.mean(full)) for name, full in saturated.items()}
    if shares:
        worst = max(shares, key=lambda name: shares[name])
        # Each band is a measurement of its own: the worst decides.
        yield SaturationFigures(shares[worst], shares[worst], worst)
        everywhere = np.logical_and.reduce([mask & VALID != 0 for mask in masks.values()])
        yield ValidFigures(min(float(np.mean(everywhere)), len(masks) / band_count))


def _for_matching(frame: Array, unusable: Array) -> Array:
    """A frame at a common level, unusable pixels marked."""
    level = float(np.median(frame))
    scaled: Array = frame * np.float32(_MATCHING_LEVEL / level if level > 0.0 else 1.0)
    scaled[unusable] = np.nan
    return scaled


def _resampled(frame: Array, saturated: Array, read: Array, at: Array) -> tuple[Array, Array]:
    """A band on the reference raster (cubic), and its mask."""
    height, width = frame.shape
    raster = cv2.remap(frame, at, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    saturated_here = cv2.remap(
        saturated.astype(np.float32), at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
    )
    inside = (
        (at[..., 0] >= 0.0)
        & (at[..., 0] <= width - 1)
        & (at[..., 1] >= 0.0)
        & (at[..., 1] <= height - 1)
        & (cv2.remap(read, at, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT) != 0)
    )
    mask = np.where(inside, np.uint8(VALID), np.uint8(0))
    mask[inside & (saturated_here > 0.0)] |= SATURATED
    raster[~inside] = np.nan
    return raster, mask
