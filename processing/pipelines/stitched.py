"""The complete chain for one exposure: from Level-0 frames to the virtual image and its verdict.

The order of the steps is decided here; each step has a module of its own. Nothing here
reads a file or waits.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from processing.geometry.conditions import (
    Conditions,
    UsableTemperatures,
    condition_figures,
    exposure_scale_figures,
    exposure_scales,
    parallax_px,
    tdi_misfit_px,
    unknown_exposure_figures,
    usable_temperatures,
)
from processing.geometry.placement import SensorPlacement, nominal_placements
from processing.geometry.virtual_camera import ground_plane, projection_figures
from processing.image.colour import (
    BandRegistration,
    colour_heads,
    green_positions,
    nominal_registration,
    register_band,
)
from processing.image.composition import ColourComposer, PanComposer, pan_cell_px
from processing.image.kernels import Interpolation
from processing.image.quicklook import quicklook
from processing.image.resampling import SATURATED_SOURCE
from processing.matching.content_check import (
    MIN_TEXTURED,
    check_content,
    content_figures,
    moved_placements,
)
from processing.matching.tie_point_search import saturated_window_fraction
from processing.matching.tie_points import TiePoints, match_tie_points
from processing.mosaic.estimated_dc import EstimatedDc, estimate_dc
from processing.mosaic.fixed_mosaic import fixed_mosaic
from processing.mosaic.free_mosaic import Mosaic, MosaicSettings
from processing.mosaic.held import held_quantities, scale_figures
from processing.mosaic.layers import check_layers, layer_figures
from processing.mosaic.mounting import check_platform, platform_figures
from processing.mosaic.precision import precision_figures
from processing.mosaic.readout_slips import slip_figures
from processing.mosaic.stitching import Method, stitch
from processing.mosaic.uncertainty_contribution import uncertainty_contribution_of
from processing.mosaic.validity import Validity
from processing.pipelines.product import PipelineSettings, Product
from processing.pipelines.stopwatch import Stopwatch
from processing.pipelines.synthetic_frames import synthetic_frames
from processing.quality.band_levels import level_figures
from processing.quality.clipping import clipping_figures
from processing.quality.common_windows import measure_common_windows
from processing.quality.evaluation import evaluate
from processing.quality.figures import (
    estimated_dc_figures,
    frame_figures,
    stitching_figures,
    valid_area_figures,
)
from processing.quality.frame_blocks import block_edges, block_figures
from processing.quality.frame_identity import (
    FixedPatterns,
    heads_by_pattern,
    identity_figures,
)
from processing.quality.local_sharpness import local_blur_figures
from processing.quality.readout import blank_unread, unread_figures
from processing.quality.relative_sharpness import relative_sharpness_figures
from processing.quality.report import Figure
from processing.quality.signal_steps import line_means_of, signal_steps, step_figures
from processing.quality.valid_area import Mask, area_of, gap_cells, grid_of
from processing.quality.word_format import word_format_figures
from processing.radiometry.calibration import RadiometricCalibration
from processing.radiometry.level1 import (
    FrameStatistics,
    corrector_for,
    exposed_rows,
    level1_counts_per_dn,
    level1_from_level0,
)
from processing.rig import Rig

__all__ = ["Conditions", "Interpolation", "Method", "Pipeline", "PipelineSettings", "Product"]

Array = NDArray[Any]
Placements = Mapping[str, SensorPlacement]


class Pipeline:
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
        self.rig = rig
        self.settings = settings or PipelineSettings()
        pan = [sensor for cone in rig.pan_cones for sensor in cone.sensors]
        self._heads = colour_heads(rig)
        self._grid = grid_of(rig.virtual_image.width_px, rig.virtual_image.height_px)
        self._pan = PanComposer(rig.virtual_image, pan, cell_px=pan_cell_px(rig))
        self._colour = ColourComposer(rig.virtual_image, self._heads)
        known = radiometry or {}
        self._correctors = {
            sensor.name: corrector_for(sensor, known.get(sensor.name))
            for sensor in (*pan, *(head.sensor for head in self._heads))
        }
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
        other._pan = PanComposer(self._pan.image, self._pan.sensors, cell_px=self._pan.cell_px)
        other._colour = ColourComposer(self._colour.image, self._heads)
        return other

    def warm_up(self) -> None:
        """Compile every kernel a flight will need, from the cache where there is one.

        A rehearsal exposure goes through all steps, twice where the steps can see the pixels in
        read-only memory.
        """
        frames = synthetic_frames(self.rig)
        conditions = Conditions(
            temperatures_c=dict.fromkeys(self.rig.probes, 20.0),
            exposure_time_s={sensor.name: 0.005 for sensor in self.rig.sensors},
            tdi_shifts={sensor.name: 1 for sensor in self.rig.sensors},
        )
        settings = self.settings
        try:
            self.settings = replace(settings, baselines=True, geometry=True)
            self.process(frames, conditions)
            for frame in frames.values():
                frame.flags.writeable = False
            self.settings = settings
            self.process(frames, conditions)
        finally:
            self.settings = settings

    def process(
        self,
        frames: Mapping[str, Array],
        conditions: Conditions,
        *,
        frames_read: Callable[[], None] | None = None,
    ) -> Product:
        """Make the virtual image of one exposure and evaluate it.

        Args:
            frames: Level-0 frames by sensor name, (h, w) uint16, DN. A missing one leaves a hole.
            conditions: what else is known of the exposure.
            frames_read: called once the pixels of `frames` are no longer needed.

        Returns:
            The product; its pixel arrays hold until the next call.

        Raises:
            ValueError: a frame of the wrong shape or type; none at all of the PAN sensors is none.
        """
        numba.set_num_threads(
            max(1, min(self.settings.threads, int(numba.config.NUMBA_NUM_THREADS)))
        )
        rig, settings, clock = self.rig, self.settings, Stopwatch()
        temperatures = usable_temperatures(rig, conditions, settings.thresholds)
        ground = ground_plane(rig, conditions)
        start = nominal_placements(
            rig,
            temperatures.placement_temperatures_c,
            conditions.tdi_shifts,
            use_drift=settings.use_drift,
            ground=ground,
        )
        with clock.stage("radiometry"):
            level1, statistics = self._correct(frames, conditions, temperatures)
            unread = unread_figures(rig, frames) | word_format_figures(rig, frames)
            unread |= clipping_figures(rig, frames)
            by_pattern = heads_by_pattern(rig, frames, self._patterns, start)
        if frames_read is not None:
            frames_read()
        with clock.stage("tie_points"):
            tie_points = match_tie_points(rig, start, level1, settings=settings.tie_points)
            content = check_content(rig, start, level1, tie_points, settings=settings.tie_points)
            if content.shifted_px:
                elsewhere = moved_placements(start, content, self._pan.image.pitch_mm)
                tie_points = match_tie_points(rig, elsewhere, level1, settings=settings.tie_points)
        with clock.stage("mosaic"):
            stitched = stitch(
                rig,
                start,
                tie_points,
                present=level1,
                temperatures_c=temperatures.usable_c if settings.use_drift else {},
                method=settings.method,
                settings=self._mosaic_settings(conditions),
            )
            tie_points, mosaic, validity = stitched.tie_points, stitched.image, stitched.validity
            estimated = self._estimate_dc(stitched.free, validity, temperatures)
            platform = check_platform(rig, stitched.free, tie_points, temperatures.usable_c)
            layers = check_layers(
                rig,
                stitched.free,
                temperatures.usable_c,
                parallax_px=self._mosaic_settings(conditions).parallax_px,
            )
            held = held_quantities(mosaic, tie_points)
            uncertainty_contribution = uncertainty_contribution_of(
                rig,
                mosaic,
                validity=validity,
                estimated_dc=estimated,
                layers=layers,
                platform=platform,
                slips=stitched.slips,
                held=held,
                temperatures_c=temperatures.usable_c,
                stale_s=self._stale_s(conditions),
                shifted_px=max((math.hypot(*p) for p in content.shifted_px.values()), default=0.0),
                weak=stitched.weak,
                smear_px=tdi_misfit_px(rig, conditions, settings.thresholds.smear_px),
            )
        with clock.stage("composition"):
            image = self._pan.compose(
                mosaic.placements,
                level1,
                feather_px=settings.feather_px,
                interpolation=settings.interpolation,
            )
        with clock.stage("colour"):
            registrations, colour, gaps = self._register(mosaic, level1)
        with clock.stage("baselines"):
            baselines = self._baselines(tie_points, temperatures, conditions)
        with clock.stage("geometry"):
            geometry = self._geometry(mosaic, baselines) if settings.geometry else {}
        with clock.stage("quicklook"):
            picture = quicklook(image.pan, colour)
        with clock.stage("valid_area"):
            pan_gaps = gap_cells(image.source, *self._grid, saturated_bit=SATURATED_SOURCE)
            area = area_of({"pan": pan_gaps, **gaps})
        with clock.stage("quality"):
            figures = condition_figures(rig, conditions, temperatures)
            figures |= exposure_scale_figures(exposure_scales(rig, conditions.exposure_time_s))
            figures |= unknown_exposure_figures(rig, level1.keys(), conditions.exposure_time_s)
            figures |= unread | self._frame_figures(level1, statistics, start)
            figures |= stitching_figures(
                rig,
                tie_points,
                mosaic,
                validity=validity,
                balance=image.balance,
                bands=registrations,
                present=level1,
            )
            figures |= self._saturated_overlap(figures, tie_points, start, level1)
            figures["resting_on_calibration"] = ", ".join(stitched.weak) or None
            figures |= estimated_dc_figures(estimated) | platform_figures(platform)
            figures |= scale_figures(held)
            figures |= projection_figures(rig, conditions, settings.relief_fraction)
            figures |= content_figures(content)
            figures |= relative_sharpness_figures(rig, start, level1)
            exposed = {
                s.name: exposed_rows(s, start[s.name].tdi_shifts)
                for s in rig.sensors
                if s.name in start
            }
            means = line_means_of(rig.sensors, level1, exposed)
            figures |= step_figures(signal_steps(rig.sensors, means))
            figures |= block_figures(block_edges(rig, mosaic.placements, level1, means))
            shared = measure_common_windows(rig, mosaic.placements, level1)
            figures |= local_blur_figures(rig, shared) | level_figures(rig, shared)
            figures |= identity_figures(rig, by_pattern, start, tie_points, registrations)
            figures |= layer_figures(layers) | slip_figures(rig, stitched.slips)
            figures |= precision_figures(
                rig, mosaic, level1, temperatures.usable_c, uncertainty_contribution
            )
            figures |= self._product_figures(image.source, frames, conditions)
            figures |= valid_area_figures(area)
            report = evaluate(
                figures,
                capture_flags=conditions.flags,
                missing_sensors=self._missing(frames),
                missing_probes=temperatures.missing,
                probes_out_of_range=temperatures.out_of_range,
                mismatched_bands=[
                    r.band for r in registrations if r.textured >= MIN_TEXTURED and r.points == 0
                ],
                nominal_bands=[
                    r.band for r in registrations if not r.registered and r.sensor in level1
                ],
                thresholds=settings.thresholds,
                requirements=settings.requirements,
            )
        return Product(
            sensors=self._pan.names,
            pan=image.pan,
            valid=image.source,
            colour=colour,
            valid_area=area,
            counts_per_dn=level1_counts_per_dn(self._pan.sensors[0].bits),
            quicklook=picture,
            start=start,
            tie_points=tie_points,
            mosaic=mosaic,
            equal_datum=stitched.equal_datum,
            free=stitched.free,
            validity=validity,
            uncertainty_contribution=uncertainty_contribution,
            estimated_dc=estimated,
            platform=platform,
            ground=ground,
            temperatures=temperatures,
            balance=image.balance,
            bands=registrations,
            baselines=baselines,
            geometry=geometry,
            report=report,
            timings_s=clock.seconds,
        )

    def _correct(
        self, frames: Mapping[str, Array], conditions: Conditions, temperatures: UsableTemperatures
    ) -> tuple[dict[str, Array], dict[str, FrameStatistics]]:
        """Level-1 frames by sensor, in this object's buffers, and what the pass saw."""
        places = {name: self._pan.frame(name) for name in self._pan.names}
        heads = {head.sensor.name: head for head in self._heads}
        places |= {name: self._colour.frame(head) for name, head in heads.items()}
        level1, statistics = {}, {}
        scales = exposure_scales(self.rig, conditions.exposure_time_s)
        for name, out in places.items():
            if name not in frames:
                continue
            corrector = self._correctors[name]
            statistics[name] = level1_from_level0(
                corrector,
                np.ascontiguousarray(frames[name]),
                temperature_c=temperatures.placement_temperatures_c.get(corrector.sensor.probe),
                exposure_time_s=conditions.exposure_time_s.get(name, 0.0),
                tdi_shifts=conditions.tdi_shifts.get(name, 0),
                scale=scales.get(name, 1.0),
                out=out,
            )
            level1[name] = self._colour.leading(heads[name]) if name in heads else out
            level1_frame = self._colour.planes(heads[name]) if name in heads else (out,)
            blank_unread(corrector.sensor, frames[name], *level1_frame)
        return level1, statistics

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
        self, mosaic: Mosaic, level1: Mapping[str, Array]
    ) -> tuple[tuple[BandRegistration, ...], dict[str, Array], dict[str, Mask]]:
        """Green as the adjustment placed it, the other bands by their tie points with green.

        Returns:
            How the bands were registered, their rasters, and their cells without valid pixels.
        """
        registrations = []
        rasters: dict[str, Array] = {}
        gaps: dict[str, Mask] = {}
        columns, rows = self._grid
        green = None if self._green is None else self._green.sensor.name
        intervals = self.settings.colour
        positions = None
        if green is not None and green in level1:
            positions = green_positions(mosaic.placements[green], level1[green], intervals)
        for head in self._heads:
            name, leading = head.sensor.name, head.leading
            if name not in level1:
                rasters |= {band: self._colour.empty(band) for band in head.bands}
                gaps |= {band: np.ones((rows, columns), np.bool_) for band in head.bands}
                continue
            placement = mosaic.placements[name]
            homography = None
            if name != green:
                found = nominal_registration(leading, name)
                if green is not None and positions is not None:
                    found = register_band(
                        leading,
                        mosaic.placements[green],
                        placement,
                        level1[green],
                        level1[name],
                        positions=positions,
                        settings=intervals,
                    )
                registrations.append(found)
                homography = found.band_from_green if found.registered else None
            for band in head.bands:
                rasters[band] = self._colour.compose(
                    band, placement, homography, interpolation=self.settings.interpolation
                )
                gaps[band] = gap_cells(
                    self._colour.source, columns, rows, saturated_bit=SATURATED_SOURCE
                )
        return tuple(registrations), rasters, gaps

    def _baselines(
        self, tie_points: TiePoints, temperatures: UsableTemperatures, conditions: Conditions
    ) -> dict[str, Mosaic]:
        """The fixed method with and without TDM, from the same tie points."""
        if not self.settings.baselines:
            return {}
        settings = self._mosaic_settings(conditions)
        baselines = {}
        for name, use_drift in (("fixed", True), ("fixed-no-tdm", False)):
            places = nominal_placements(
                self.rig,
                temperatures.placement_temperatures_c,
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

    def _frame_figures(
        self,
        level1: Mapping[str, Array],
        statistics: Mapping[str, FrameStatistics],
        start: Placements,
    ) -> dict[str, Figure]:
        present = [sensor for sensor in self._pan.sensors if sensor.name in level1]
        return frame_figures(
            present,
            [level1[s.name] for s in present],
            [exposed_rows(s, start[s.name].tdi_shifts) for s in present],
            [statistics[s.name] for s in present],
        )

    def _saturated_overlap(
        self,
        figures: Mapping[str, Figure],
        tie_points: TiePoints,
        start: Placements,
        level1: Mapping[str, Array],
    ) -> dict[str, Figure]:
        """Whether saturation is why the poorest overlap has too few tie points."""
        few = self.settings.thresholds.tie_points_per_overlap
        points = figures.get("tie_points_min_overlap")
        pairs = {"-".join(pair): pair for pair in tie_points.pairs}
        pair = pairs.get(str(figures.get("tie_points_min_overlap_name")))
        if pair is None or not isinstance(points, int) or points >= few:
            return {}
        saturated_fraction = saturated_window_fraction(
            self.rig, start, level1, pair, settings=self.settings.tie_points
        )
        return {"tie_points_min_overlap_burnt": saturated_fraction}

    def _product_figures(
        self, source: Array, frames: Mapping[str, Array], conditions: Conditions
    ) -> dict[str, Figure]:
        return {
            "valid_fraction": float(np.count_nonzero(source)) / source.size,
            "missing_sensors": ", ".join(self._missing(frames)) or None,
            "parallax_px": parallax_px(self.rig, conditions, self.settings.relief_fraction),
        }

    def _stale_s(self, conditions: Conditions) -> float:
        """Age of the oldest temperature where it is too old, else zero."""
        age_s = max(conditions.temperature_age_s.values(), default=0.0)
        return age_s if age_s > self.settings.thresholds.temperature_age_s else 0.0

    def _missing(self, frames: Mapping[str, Array]) -> Sequence[str]:
        return [sensor.name for sensor in self.rig.sensors if sensor.name not in frames]

    def _mosaic_settings(self, conditions: Conditions) -> MosaicSettings:
        parallax = parallax_px(self.rig, conditions, self.settings.relief_fraction)
        return replace(self.settings.mosaic, parallax_px=parallax)
