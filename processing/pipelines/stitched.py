"""The complete chain for one exposure: from Level-0 frames to the virtual image and its verdict.

The order of the steps is decided here; each step has a module of its own. Nothing here
reads a file or waits.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.geometry.conditions import (
    Conditions,
    UsableTemperatures,
    parallax_px,
    tdi_misfit_px,
)
from processing.geometry.exposure_times import exposure_scales
from processing.geometry.placement import nominal_placements
from processing.geometry.virtual_camera import ground_plane
from processing.image.colour import (
    BandRegistration,
    colour_heads,
    green_positions,
    nominal_registration,
    register_band,
)
from processing.image.composition import ColourComposer, PanComposer, pan_cell_px
from processing.image.kernels import Interpolation
from processing.image.line_means import line_means
from processing.image.quicklook import quicklook
from processing.image.resampling import SATURATED_SOURCE
from processing.matching.band_gaps import filled_gaps
from processing.matching.content_check import (
    MIN_TEXTURED,
    MISMATCHED_BAND_SHARE,
    ContentCheck,
    check_content,
    moved_placements,
)
from processing.matching.frame_ends import match_frame_ends
from processing.matching.tie_points import TiePoints, match_tie_points
from processing.mosaic.band_slips import without_band_slips
from processing.mosaic.estimated_dc import EstimatedDc, estimate_dc
from processing.mosaic.fixed_mosaic import fixed_mosaic
from processing.mosaic.free_mosaic import Mosaic, MosaicSettings
from processing.mosaic.held import held_quantities
from processing.mosaic.layers import check_layers
from processing.mosaic.mounting import check_platform
from processing.mosaic.readout_slips import Slip
from processing.mosaic.stitching import Method, Stitching, stitch
from processing.mosaic.uncertainty_contribution import (
    CalibrationChecks,
    uncertainty_contribution_of,
)
from processing.mosaic.validity import Validity
from processing.pipelines.exposure_pipeline import ExposureInput, ExposurePipeline, Judgement
from processing.pipelines.product import PipelineSettings, Product
from processing.pipelines.stitched_stages import (
    AdjustedFrames,
    ComposedImage,
    CorrectedFrames,
    StitchedStages,
    figures_of,
    misplaced_px,
)
from processing.pipelines.synthetic_frames import synthetic_frames
from processing.quality.clipping import clipping_figures
from processing.quality.dark_frames import dark_frame_figures, dark_frames
from processing.quality.frame_identity import FixedPatterns, heads_by_pattern
from processing.quality.line_order import line_order_figures
from processing.quality.readout import blank_unread, unread_figures
from processing.quality.repeated_lines import repeated_line_figures
from processing.quality.report import QualityReport
from processing.quality.valid_area import Mask, area_of, gap_cells, grid_of
from processing.quality.word_format import word_format_figures
from processing.radiometry.calibration import RadiometricCalibration
from processing.radiometry.corrector import correctors_for
from processing.radiometry.demosaic import is_bayer
from processing.radiometry.level1 import FrameStatistics, exposed_rows, level1_counts_per_dn
from processing.rig import Rig

__all__ = ["Conditions", "Interpolation", "Method", "Pipeline", "PipelineSettings", "Product"]

Array = NDArray[Any]


class Pipeline(
    ExposurePipeline[PipelineSettings, CorrectedFrames, AdjustedFrames, ComposedImage, Product]
):
    """A rig, its radiometry and settings, and the buffers of one exposure.

    One exposure at a time: the arrays of a `Product` are this object's buffers and hold until the
    next call of `process`.
    """

    def __init__(
        self,
        rig: Rig,
        radiometry: Mapping[str, RadiometricCalibration] | None = None,
        settings: PipelineSettings | None = None,
    ) -> None:
        """Allocate all buffers and make the calibrations ready.

        Args:
            rig: the camera; it has a virtual image.
            radiometry: by sensor name; a sensor without one is taken as neutral.
            settings: None takes the defaults.

        Raises:
            ValueError: the rig has no virtual image or no PAN sensor.
            CalibrationError: a radiometric calibration that does not fit its sensor.
        """
        if rig.virtual_image is None or not rig.pan_cones:
            raise ValueError(f"rig {rig.name} has no virtual image of PAN sensors to compose")
        super().__init__(rig, settings or PipelineSettings())
        pan = [sensor for cone in rig.pan_cones for sensor in cone.sensors]
        self._heads = colour_heads(rig)
        self._grid = grid_of(rig.virtual_image.width_px, rig.virtual_image.height_px)
        resample = self.kernels.resample
        cell_px = pan_cell_px(rig)
        self._pan = PanComposer(rig.virtual_image, pan, cell_px=cell_px, resample=resample)
        self._colour = ColourComposer(rig.virtual_image, self._heads, resample=resample)
        self._correctors = correctors_for(
            (*pan, *(head.sensor for head in self._heads)), radiometry or {}
        )
        self._patterns = FixedPatterns(self._correctors)
        self._green = next(
            (
                head
                for head in self._heads
                if rig.cone_of(head.sensor.name).name == rig.colour_master_cone
            ),
            None,
        )

    def clone(self) -> Pipeline:
        """A second pipeline with buffers of its own, for another exposure at the same time.

        Calibrations, the larger part of the memory, are shared.
        """
        other = copy.copy(self)
        resample = self.kernels.resample
        pan = self._pan
        other._pan = PanComposer(pan.image, pan.sensors, cell_px=pan.cell_px, resample=resample)
        other._colour = ColourComposer(self._colour.image, self._heads, resample=resample)
        return other

    def warm_up(self) -> None:
        """Load every kernel that exposures with these settings call.

        A rehearsal exposure goes through all steps. Frames in memory may be read-only to the
        kernels: that is another variant of those that correct.
        """
        frames = synthetic_frames(self.rig)
        conditions = Conditions(
            temperatures_c=dict.fromkeys(self.rig.probes, 20.0),
            exposure_time_s={sensor.name: 0.005 for sensor in self.rig.sensors},
            tdi_shifts={sensor.name: 1 for sensor in self.rig.sensors},
        )
        self.process(frames, conditions)
        for frame in frames.values():
            frame.flags.writeable = False
        self._correct(self._read(frames, conditions))

    def _correct(self, exposure: ExposureInput) -> CorrectedFrames:
        rig, frames, conditions = self.rig, exposure.frames, exposure.conditions
        ground = ground_plane(rig, conditions)
        start = nominal_placements(
            rig,
            exposure.temperatures.placement_temperatures_c,
            conditions.tdi_shifts,
            use_drift=self.settings.use_drift,
            ground=ground,
        )
        with exposure.clock.stage("radiometry"):
            level1, statistics = self._level1(exposure)
            dark = dark_frames(rig, level1, exposure_scales(rig, conditions.exposure_time_s))
            figures = (
                unread_figures({n: seen.unread_fraction for n, seen in statistics.items()}),
                dark_frame_figures(dark),
                word_format_figures(rig, frames),
                repeated_line_figures(rig, frames),
                line_order_figures(rig, frames),
                clipping_figures(rig, frames),
            )
            tdi_shifts = {name: placement.tdi_shifts for name, placement in start.items()}
            by_pattern = heads_by_pattern(rig, frames, self._patterns, tdi_shifts)
            # A frame without light is as one that is missing: its noise is no ground.
            for name in dark:
                del level1[name], statistics[name]
        return CorrectedFrames(level1, statistics, start, ground, by_pattern, figures)

    def _level1(
        self, exposure: ExposureInput
    ) -> tuple[dict[str, Array], dict[str, FrameStatistics]]:
        """Level-1 frames by sensor, in this object's buffers, and what the pass saw."""
        frames, conditions = exposure.frames, exposure.conditions
        places = {name: self._pan.frame(name) for name in self._pan.names}
        heads = {head.sensor.name: head for head in self._heads}
        places |= {name: self._colour.frame(head) for name, head in heads.items()}
        level1, statistics = {}, {}
        scales = exposure_scales(self.rig, conditions.exposure_time_s)
        for name, out in places.items():
            if name not in frames:
                continue
            sensor = self._correctors[name].sensor
            unclean = (
                self._colour.unclean(heads[name]) if name in heads else self._pan.unclean(name)
            )
            statistics[name] = exposure.correct(
                self._correctors[name],
                out=out,
                tdi_shifts=conditions.tdi_shifts.get(name, 0),
                scale=scales.get(name, 1.0),
                measure_lines=name not in heads or not is_bayer(sensor),
                unclean=unclean,
            )
            level1[name] = self._colour.leading(heads[name]) if name in heads else out
            level1_frame = self._colour.planes(heads[name]) if name in heads else (out,)
            unread = statistics[name].unread_fraction
            changed = blank_unread(sensor, frames[name], unread, *level1_frame)
            if changed:
                unclean[:] = 1
            if changed or level1[name] is not out:
                rows = exposed_rows(sensor, conditions.tdi_shifts.get(name, 0))
                lines = line_means(level1[name], rows)
                statistics[name] = replace(statistics[name], lines=lines)
        return level1, statistics

    def _adjust(self, exposure: ExposureInput, corrected: CorrectedFrames) -> AdjustedFrames:
        rig, settings, temperatures = self.rig, self.settings, exposure.temperatures
        with exposure.clock.stage("tie_points"):
            tie_points, content, ends = self._match(corrected)
        with exposure.clock.stage("mosaic"):
            mosaic_settings = self._mosaic_settings(exposure.conditions)
            stitching = stitch(
                rig,
                corrected.start,
                tie_points,
                present=corrected.level1,
                temperatures_c=temperatures.usable_c if settings.use_drift else {},
                method=settings.method,
                settings=mosaic_settings,
                ends=ends,
            )
            estimated = self._estimate_dc(stitching.free, stitching.validity, temperatures)
            tie_points = stitching.tie_points
            platform = check_platform(rig, stitching.free, tie_points, temperatures.usable_c)
            layers = check_layers(
                rig,
                stitching.free,
                temperatures.usable_c,
                parallax_px=mosaic_settings.parallax_px,
            )
            held = held_quantities(stitching.image, tie_points)
            contribution = uncertainty_contribution_of(
                rig,
                stitching.image,
                validity=stitching.validity,
                checks=CalibrationChecks(estimated, layers, platform),
                slips=stitching.slips,
                held=held,
                temperatures_c=temperatures.usable_c,
                stale_s=self._stale_s(exposure.conditions),
                shifted_px=misplaced_px(rig, content),
                weak=(*stitching.weak, *content.mismatched),
                smear_px=tdi_misfit_px(rig, exposure.conditions, settings.thresholds.smear_px),
            )
        return AdjustedFrames(stitching, content, estimated, platform, layers, held, contribution)

    def _match(
        self, corrected: CorrectedFrames
    ) -> tuple[TiePoints, ContentCheck, TiePoints | None]:
        """Tie points, sought again where the content of a frame lies elsewhere, and frame ends."""
        rig, level1, settings = self.rig, corrected.level1, self.settings.tie_points
        tie_points = match_tie_points(rig, corrected.start, level1, settings=settings)
        content = check_content(rig, corrected.start, level1, tie_points, settings=settings)
        if content.shifted_px:
            pitch_mm = self._pan.image.pitch_mm
            elsewhere = moved_placements(corrected.start, content, pitch_mm)
            return match_tie_points(rig, elsewhere, level1, settings=settings), content, None
        start = corrected.start
        tie_points = filled_gaps(rig, start, level1, tie_points, settings=settings)
        ends = match_frame_ends(rig, start, level1, tie_points, settings=settings)
        return tie_points, content, ends

    def _resample(
        self, exposure: ExposureInput, corrected: CorrectedFrames, adjusted: AdjustedFrames
    ) -> ComposedImage:
        settings, clock = self.settings, exposure.clock
        mosaic = adjusted.stitching.image
        with clock.stage("composition"):
            pan = self._pan.compose(
                mosaic.placements,
                corrected.level1,
                feather_px=settings.feather_px,
                interpolation=settings.interpolation,
            )
        with clock.stage("colour"):
            registrations, slips = self._register(adjusted.stitching, corrected.level1)
            colour, gaps = self._compose_bands(mosaic, corrected.level1, registrations)
        with clock.stage("baselines"):
            baselines = self._baselines(exposure, adjusted.stitching.tie_points)
        with clock.stage("geometry"):
            geometry = self._geometry(mosaic, baselines) if settings.geometry else {}
        with clock.stage("quicklook"):
            picture = quicklook(pan.pan, colour)
        return ComposedImage(pan, registrations, colour, gaps, baselines, geometry, picture, slips)

    def _judge(self, stages: StitchedStages) -> Judgement:
        clock, image = stages.exposure.clock, stages.image
        with clock.stage("valid_area"):
            gaps = gap_cells(image.pan.source, *self._grid, saturated_bit=SATURATED_SOURCE)
            area = area_of({"pan": gaps, **image.gaps})
        with clock.stage("quality"):
            figures = tuple(figures_of(self.rig, self.settings, stages))
        bands, present = image.registrations, stages.corrected.level1
        return Judgement(
            stages.adjusted.stitching.image.method,
            figures,
            area,
            nominal_bands=tuple(r.band for r in bands if not r.registered and r.sensor in present),
            mismatched_bands=tuple(
                r.band
                for r in bands
                if r.textured >= MIN_TEXTURED and r.matched < MISMATCHED_BAND_SHARE * r.textured
            ),
        )

    def _product(
        self, stages: StitchedStages, judgement: Judgement, report: QualityReport
    ) -> Product:
        exposure, corrected, image = stages.exposure, stages.corrected, stages.image
        adjusted, stitching = stages.adjusted, stages.adjusted.stitching
        return Product(
            sensors=self._pan.names,
            pan=image.pan.pan,
            valid=image.pan.source,
            colour=image.colour,
            valid_area=judgement.valid_area,
            counts_per_dn=level1_counts_per_dn(self._pan.sensors[0].bits),
            quicklook=image.quicklook,
            start=corrected.start,
            tie_points=stitching.tie_points,
            mosaic=stitching.image,
            equal_datum=stitching.equal_datum,
            free=stitching.free,
            validity=stitching.validity,
            uncertainty_contribution=adjusted.uncertainty_contribution,
            estimated_dc=adjusted.estimated_dc,
            platform=adjusted.platform,
            ground=corrected.ground,
            temperatures=exposure.temperatures,
            balance=image.pan.balance,
            bands=image.registrations,
            baselines=image.baselines,
            geometry=image.geometry,
            report=report,
            timings_s=exposure.clock.seconds,
        )

    def _estimate_dc(
        self, mosaic: Mosaic, validity: Validity | None, temperatures: UsableTemperatures
    ) -> tuple[EstimatedDc, ...]:
        if validity is None:
            return ()
        moved = validity.displaced
        displaced = () if moved is None else (moved.sensor, *validity.alternatives)
        return estimate_dc(
            self.rig,
            mosaic,
            temperatures.placement_temperatures_c if self.settings.use_drift else {},
            measured=temperatures.usable_c,
            displaced=displaced,
        )

    def _register(
        self, stitching: Stitching, level1: Mapping[str, Array]
    ) -> tuple[tuple[BandRegistration, ...], tuple[Slip, ...]]:
        """How the bands other than green lie to it, and their read-out slips."""
        green = None if self._green is None else self._green.sensor.name
        placements, settings = stitching.image.placements, self.settings.colour
        heads = {
            head.sensor.name: head.leading
            for head in self._heads
            if head.sensor.name in level1 and head.sensor.name != green
        }
        if green is None or green not in level1:
            return tuple(nominal_registration(band, name) for name, band in heads.items()), ()
        positions = green_positions(placements[green], level1[green], settings)
        registrations = tuple(
            register_band(
                band,
                placements[green],
                placements[name],
                level1[green],
                level1[name],
                positions=positions,
                settings=settings,
            )
            for name, band in heads.items()
        )
        # Lines of green that lie elsewhere would be seen in every band.
        if any(green in (slip.sensor, *slip.alternatives) for slip in stitching.slips):
            return registrations, ()
        return without_band_slips(
            self.rig, placements[green], placements, registrations, settings=settings
        )

    def _compose_bands(
        self,
        mosaic: Mosaic,
        level1: Mapping[str, Array],
        registrations: Sequence[BandRegistration],
    ) -> tuple[dict[str, Array], dict[str, Mask]]:
        """Rasters of the bands, and their cells without valid pixels.

        Green lies as the adjustment placed it, the others as they are registered to it.
        """
        rasters: dict[str, Array] = {}
        gaps: dict[str, Mask] = {}
        columns, rows = self._grid
        homographies = {r.sensor: r.band_from_green for r in registrations if r.registered}
        for head in self._heads:
            name = head.sensor.name
            if name not in level1:
                rasters |= {band: self._colour.empty(band) for band in head.bands}
                gaps |= {band: np.ones((rows, columns), np.bool_) for band in head.bands}
                continue
            for band in head.bands:
                rasters[band] = self._colour.compose(
                    band,
                    mosaic.placements[name],
                    homographies.get(name),
                    interpolation=self.settings.interpolation,
                )
                gaps[band] = gap_cells(
                    self._colour.source, columns, rows, saturated_bit=SATURATED_SOURCE
                )
        return rasters, gaps

    def _baselines(self, exposure: ExposureInput, tie_points: TiePoints) -> dict[str, Mosaic]:
        """The fixed method with and without TDM, from the same tie points."""
        if not self.settings.baselines:
            return {}
        conditions = exposure.conditions
        settings = self._mosaic_settings(conditions)
        baselines = {}
        for name, use_drift in (("fixed", True), ("fixed-no-tdm", False)):
            places = nominal_placements(
                self.rig,
                exposure.temperatures.placement_temperatures_c,
                conditions.tdi_shifts,
                use_drift=use_drift,
                ground=ground_plane(self.rig, conditions),
            )
            baselines[name] = fixed_mosaic(self.rig, places, tie_points, settings=settings)
        return baselines

    def _geometry(
        self, mosaic: Mosaic, baselines: Mapping[str, Mosaic]
    ) -> dict[str, dict[str, Array]]:
        geometry = {mosaic.method: self._pan.geometry()}
        for name, baseline in baselines.items():
            geometry[name] = self._pan.geometry(baseline.placements)
        return geometry

    def _stale_s(self, conditions: Conditions) -> float:
        """Age of the oldest temperature where it is too old, else zero."""
        age_s = max(conditions.temperature_age_s.values(), default=0.0)
        return age_s if age_s > self.settings.thresholds.temperature_age_s else 0.0

    def _mosaic_settings(self, conditions: Conditions) -> MosaicSettings:
        parallax = parallax_px(self.rig, conditions, self.settings.relief_fraction)
        return replace(self.settings.mosaic, parallax_px=parallax)
