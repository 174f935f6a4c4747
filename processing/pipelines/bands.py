"""One exposure of a rig without a virtual image: radiance band by band, all in the reference band.

Level-0 words become radiance (or signal where a head has no absolute calibration), each band is
registered to the reference band and resampled once. Rigs that stitch are
`processing.pipelines.stitched`'s.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from processing.geometry.conditions import (
    Conditions,
    condition_figures,
    usable_temperatures,
)
from processing.geometry.placement import SensorPlacement
from processing.image.band_registration import (
    BandSettings,
    RegisteredBand,
    band_placements,
    raw_of_reference_pixels,
    reference_image,
    register_to_reference,
)
from processing.pipelines.synthetic_frames import synthetic_head_frames
from processing.quality.evaluation import evaluate
from processing.quality.figures import valid_area_figures
from processing.quality.readout import blank_unread
from processing.quality.report import Figure, QualityReport, Thresholds
from processing.quality.requirements import QualityRequirements
from processing.quality.valid_area import ValidArea, area_of, gap_cells, grid_of
from processing.radiometry.radiance import RadianceCalibration, radiance_from_raw, saturated_pixels
from processing.rig import Rig, Sensor, VirtualImage

Array = NDArray[Any]

RADIANCE_UNIT: Final = "W/m2/sr/nm"
SIGNAL_UNIT: Final = "DN"
VALID: Final = 1
SATURATED: Final = 2

BAND_FIGURES: Final[Mapping[str, str]] = {
    "<band>_points": "tie points of a band with the reference band that were kept",
    "<band>_rms_px": "root mean square length of their residuals, pixels",
    "<band>_shift_px": "largest displacement of raw pixels against the reference band, pixels",
}
"""Figures of a band in addition to those of `processing.quality.report.FIGURES`."""

_MATCHING_LEVEL: Final = 1000.0
"""Frames are matched with their median at this value: the kernels' guards are made for counts."""


@dataclass(frozen=True)
class FrameSettings:
    """Values a head reports with its frame: gain, and the black level in words where known."""

    gain: float = 1.0
    black: float | None = None


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


class BandPipeline:
    """A rig of single-band heads without a virtual image, and its radiance calibrations.

    Args:
        rig: every cone has one sensor and one band, all bands differ; `colour_master_cone` is the
            reference band.
        radiance: by sensor name; a sensor without one gives DN above black.
        thresholds: of the verdict. None asks ten times less saturation than for a picture: a
            radiance that is wrong is worse than a roof without detail.
        requirements: of the project, if any.

    Raises:
        ValueError: a rig of other make.
    """

    def __init__(
        self,
        rig: Rig,
        radiance: Mapping[str, RadianceCalibration] | None = None,
        *,
        settings: BandSettings | None = None,
        threads: int = 2,
        thresholds: Thresholds | None = None,
        requirements: QualityRequirements | None = None,
    ) -> None:
        single = all(len(c.sensors) == 1 and len(c.bands) == 1 for c in rig.cones)
        bands = [cone.bands[0] for cone in rig.cones if cone.bands]
        if not single or len(set(bands)) != len(rig.cones):
            raise ValueError(
                f"rig {rig.name}: without a virtual image each cone has one sensor and a band of "
                f"its own; give [virtual_image] for cameras that are stitched"
            )
        self.rig = rig
        self.settings = settings or BandSettings()
        self.thresholds = thresholds or replace(
            Thresholds(), saturated_fraction=0.0005, saturated_refly_fraction=0.01
        )
        self._requirements = requirements or QualityRequirements()
        self._threads = threads
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

    def process(
        self,
        frames: Mapping[str, Array],
        conditions: Conditions,
        heads: Mapping[str, FrameSettings] | None = None,
        *,
        frames_read: Callable[[], None] | None = None,
    ) -> BandProduct:
        """Make the bands of one exposure and evaluate it.

        Args:
            frames: Level-0 frames by sensor name, (h, w) uint16. A missing one leaves no band;
                without the reference all bands stay as calibrated.
            conditions: exposure times, temperatures, what capture knows.
            heads: gain and black level by sensor name.
            frames_read: called once the pixels of `frames` are no longer needed.

        Raises:
            ValueError: a frame of the wrong shape or type, or a radiance calibration without an
                exposure time.
        """
        cv2.setNumThreads(self._threads)
        numba.set_num_threads(max(1, min(self._threads, int(numba.config.NUMBA_NUM_THREADS))))
        temperatures = usable_temperatures(self.rig, conditions, self.thresholds)
        seconds: dict[str, float] = {}
        began = time.perf_counter()
        linear, saturated, read, units = {}, {}, {}, {}
        for name in (name for name in self._band_of if name in frames):
            sensor = self.rig.sensor(name)
            head_settings = (heads or {}).get(name, FrameSettings())
            linear[name], units[name] = self._linear(
                sensor, frames[name], conditions, head_settings
            )
            saturated[name] = saturated_pixels(sensor, frames[name])
            read[name] = np.ones(frames[name].shape, np.uint8)
            blank_unread(sensor, frames[name], read[name])
        if frames_read is not None:
            frames_read()
        seconds["radiometry"] = time.perf_counter() - began
        began = time.perf_counter()
        placements = band_placements(self.rig, temperatures.placement_temperatures_c)
        found = self._register(
            placements, linear, {name: saturated[name] | (read[name] == 0) for name in linear}
        )
        seconds["registration"] = time.perf_counter() - began
        began = time.perf_counter()
        bands, masks = {}, {}
        for name, frame in linear.items():
            homography = found[name].band_from_reference if name in found else np.eye(3)
            at = raw_of_reference_pixels(self._image, placements[name], homography)
            band = self._band_of[name]
            bands[band], masks[band] = _resampled(frame, saturated[name], read[name], at)
        seconds["resampling"] = time.perf_counter() - began
        missing = [name for name in self._band_of if name not in frames]
        figures = condition_figures(self.rig, conditions, temperatures)
        figures |= self._figures(found, saturated, masks, missing)
        area = self._valid_area(masks)
        figures |= valid_area_figures(area)
        report = evaluate(
            figures,
            capture_flags=conditions.flags,
            missing_sensors=missing,
            missing_probes=temperatures.missing,
            probes_out_of_range=temperatures.out_of_range,
            nominal_bands=[f.band for f in found.values() if not f.registered],
            thresholds=self.thresholds,
            requirements=self._requirements,
        )
        return BandProduct(
            image=self._image,
            reference=self._band_of[self._reference],
            bands=bands,
            masks=masks,
            units={self._band_of[name]: unit for name, unit in units.items()},
            registrations=tuple(found.values()),
            valid_area=area,
            report=report,
            timings_s=seconds,
        )

    def _valid_area(self, masks: Mapping[str, Array]) -> ValidArea:
        columns, rows = grid_of(self._image.width_px, self._image.height_px)
        nothing = np.ones((rows, columns), np.bool_)
        return area_of(
            {
                band: gap_cells(masks[band], columns, rows, saturated_bit=SATURATED)
                if band in masks
                else nothing
                for band in self._band_of.values()
            }
        )

    def _linear(
        self, sensor: Sensor, raw: Array, conditions: Conditions, head_settings: FrameSettings
    ) -> tuple[Array, str]:
        """Radiance, or DN above black where the head has no absolute calibration."""
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
        self,
        placements: Mapping[str, SensorPlacement],
        linear: Mapping[str, Array],
        unusable: Mapping[str, Array],
    ) -> dict[str, RegisteredBand]:
        """All bands but the reference, by sensor name."""
        matching = {name: _for_matching(f, unusable[name]) for name, f in linear.items()}
        found = {}
        for name in (name for name in linear if name != self._reference):
            if self._reference in matching:
                found[name] = register_to_reference(
                    self._band_of[name],
                    placements[self._reference],
                    placements[name],
                    matching[self._reference],
                    matching[name],
                    settings=self.settings,
                )
            else:
                found[name] = RegisteredBand(
                    self._band_of[name], name, np.eye(3), 0, 0, None, None, None,
                    (0.0, 0.0), 0.0, registered=False,
                )  # fmt: skip
        return found

    def _figures(
        self,
        found: Mapping[str, RegisteredBand],
        saturated: Mapping[str, Array],
        masks: Mapping[str, Array],
        missing: list[str],
    ) -> dict[str, Figure]:
        figures: dict[str, Figure] = {"method": "bands", "missing_sensors": ", ".join(missing)}
        figures["missing_sensors"] = figures["missing_sensors"] or None
        for band in found.values():
            figures[f"{band.band}_points"] = band.points
            figures[f"{band.band}_rms_px"] = band.rms_px
            figures[f"{band.band}_shift_px"] = band.largest_shift_px if band.registered else None
        shares = {name: float(np.mean(full)) for name, full in saturated.items()}
        if shares:
            worst = max(shares, key=lambda name: shares[name])
            # Each band is a measurement of its own: the worst decides.
            figures["saturated_fraction"] = shares[worst]
            figures["saturated_worst_fraction"] = shares[worst]
            figures["saturated_worst_sensor"] = worst
            everywhere = np.logical_and.reduce([mask & VALID != 0 for mask in masks.values()])
            figures["valid_fraction"] = float(np.mean(everywhere))
        return figures


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
