"""What the stages of `processing.pipelines.stitched` hand on, and the figures of its report."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.geometry.conditions import parallax_px, tdi_misfit_px
from processing.geometry.exposure_times import (
    exposure_scale_figures,
    exposure_scales,
    unknown_exposure_figures,
)
from processing.geometry.placement import SensorPlacement
from processing.geometry.virtual_camera import GroundPlane, projection_figures
from processing.image.colour import BandRegistration
from processing.image.composition import Composition
from processing.matching.content_check import WIDE_SEARCH_PX, ContentCheck, content_figures
from processing.matching.tie_point_search import saturated_window_fraction
from processing.mosaic.estimated_dc import EstimatedDc, estimated_dc_figures
from processing.mosaic.free_mosaic import Mosaic
from processing.mosaic.held import HeldQuantities, scale_figures
from processing.mosaic.layers import LayerCheck, layer_figures
from processing.mosaic.mounting import PlatformCheck, platform_figures
from processing.mosaic.precision import UncertaintyContribution, precision_figures
from processing.mosaic.readout_slips import Slip, slip_figures
from processing.mosaic.stitching import Stitching
from processing.pipelines.exposure_pipeline import Stages
from processing.pipelines.product import PipelineSettings
from processing.quality.band_levels import level_figures
from processing.quality.block_sides import sides_of_blocks
from processing.quality.common_windows import measure_common_windows
from processing.quality.confirmed_ground import confirmed_ground_figures
from processing.quality.defect_lines import defect_line_figures, defect_lines
from processing.quality.figures import FigureGroup
from processing.quality.figures.circumstances import ParallaxFigures
from processing.quality.figures.image import (
    LineOrderFigures,
    RepeatedLineFigures,
    ValidFigures,
    WordFormatFigures,
)
from processing.quality.figures.stitching import SaturatedOverlapFigures, SupportFigures
from processing.quality.frame_blocks import block_edges, block_figures, edge_limits
from processing.quality.frame_identity import identity_figures
from processing.quality.frame_signal import sharpness_figures, signal_figures
from processing.quality.ground_steps import GroundView, is_drawn_by_step
from processing.quality.local_sharpness import local_blur_figures
from processing.quality.other_ground import other_ground_figures, other_ground_regions
from processing.quality.relative_sharpness import relative_sharpness_figures
from processing.quality.signal_steps import signal_steps, step_figures, without_edges
from processing.quality.stitching_figures import poorest_overlap, stitching_figures
from processing.quality.valid_area import Mask
from processing.radiometry.level1 import FrameStatistics, exposed_rows
from processing.rig import Rig

Array = NDArray[Any]


@dataclass(frozen=True)
class CorrectedFrames:
    """Level-1 by sensor name, and where calibration and TDM place the sensors.

    `by_pattern` are frames that show another head's fixed pattern, `figures` those of the raw
    frames.
    """

    level1: Mapping[str, Array]
    statistics: Mapping[str, FrameStatistics]
    start: Mapping[str, SensorPlacement]
    ground: GroundPlane | None
    by_pattern: Mapping[str, str]
    figures: tuple[FigureGroup | None, ...]


@dataclass(frozen=True)
class AdjustedFrames:
    """Where the stitching places the frames, and what was found out about it."""

    stitching: Stitching
    content: ContentCheck
    estimated_dc: tuple[EstimatedDc, ...]
    platform: PlatformCheck | None
    layers: LayerCheck | None
    held: HeldQuantities | None
    uncertainty_contribution: UncertaintyContribution


@dataclass(frozen=True)
class ComposedImage:
    """The virtual image: PAN, and by band the colour and its cells without valid pixels.

    `slips` are those of bands that are registered to green.
    """

    pan: Composition
    registrations: tuple[BandRegistration, ...]
    colour: Mapping[str, Array]
    gaps: Mapping[str, Mask]
    baselines: Mapping[str, Mosaic]
    geometry: Mapping[str, Mapping[str, Array]]
    quicklook: Array
    slips: tuple[Slip, ...] = ()


StitchedStages = Stages[CorrectedFrames, AdjustedFrames, ComposedImage]


def figures_of(
    rig: Rig, settings: PipelineSettings, stages: StitchedStages
) -> Iterator[FigureGroup | None]:
    """All figures of a stitched exposure but those of its conditions and of its valid area.

    Args:
        rig: the camera.
        settings: of the pipeline.
        stages: the exposure and what all stages made of it.

    Yields:
        Groups of figures; None for a group that was not determined.
    """
    conditions, temperatures = stages.exposure.conditions, stages.exposure.temperatures
    corrected, adjusted, image = stages.corrected, stages.adjusted, stages.image
    level1, start, stitching = corrected.level1, corrected.start, adjusted.stitching
    tie_points, mosaic = stitching.tie_points, stitching.image
    yield exposure_scale_figures(exposure_scales(rig, conditions.exposure_time_s))
    others = level1.keys() - set(stages.exposure.implausible_exposures)
    yield unknown_exposure_figures(rig, others, conditions.exposure_time_s)
    yield from corrected.figures
    exposed = {
        s.name: exposed_rows(s, start[s.name].tdi_shifts) for s in rig.sensors if s.name in start
    }
    pan = [s for cone in rig.pan_cones for s in cone.sensors if s.name in level1]
    yield from signal_figures(pan, level1, corrected.statistics)
    yield sharpness_figures(pan, level1, exposed)
    means = {n: seen.lines for n, seen in corrected.statistics.items() if seen.lines is not None}
    view = GroundView(rig, mosaic.placements, level1)
    misfit_px = tdi_misfit_px(rig, conditions, settings.thresholds.smear_px)
    partly_exposed = math.ceil(max(misfit_px.values(), default=0.0))
    steps = without_edges(rig.sensors, signal_steps(rig.sensors, means, view), partly_exposed)
    limits = edge_limits(rig, means)
    blocks = block_edges(rig, mosaic.placements, level1, means, limits)
    yield from stitching_figures(
        rig,
        tie_points,
        mosaic,
        validity=stitching.validity,
        balance=image.pan.balance,
        bands=image.registrations,
        present=level1,
        changed={*(step.sensor for step in steps), *(block.sensor for block in blocks)},
    )
    yield _saturated_overlap(rig, settings, corrected, stitching)
    yield SupportFigures(stitching.weak)
    yield estimated_dc_figures(adjusted.estimated_dc)
    yield from platform_figures(adjusted.platform)
    yield scale_figures(adjusted.held)
    yield projection_figures(rig, conditions, settings.relief_fraction)
    yield content_figures(
        adjusted.content, _of_other_group(rig, adjusted.content, image.registrations, level1)
    )
    yield other_ground_figures(
        other_ground_regions(
            rig,
            start,
            level1,
            tie_points,
            image.registrations,
            settings=settings.tie_points,
            colour=settings.colour,
            explained=_explained_frames(corrected, adjusted) | {s.sensor for s in image.slips},
        )
    )
    yield confirmed_ground_figures(rig, level1, tie_points, image.registrations)
    odd = _odd_frames(corrected)
    yield relative_sharpness_figures(rig, start, {n: level1[n] for n in level1 if n not in odd})
    yield step_figures(steps)
    # The defects of another head are not those that were filled.
    own = [sensor for sensor in rig.sensors if sensor.name not in corrected.by_pattern]
    yield defect_line_figures(defect_lines(own, means))
    yield block_figures(rig, limits, blocks)
    shared = measure_common_windows(rig, mosaic.placements, level1)
    yield local_blur_figures(rig, shared)
    yield level_figures(rig, shared)
    identity = identity_figures(rig, corrected.by_pattern, start, tie_points, image.registrations)
    yield identity
    yield from layer_figures(adjusted.layers)
    every = [line for step in steps for line in step.every]
    every += sides_of_blocks(rig, means, blocks)
    yield slip_figures(
        rig,
        [
            slip
            for slip in _worst_first(stitching.slips, image.slips)
            # The lens of another head bends the residuals of a frame.
            if slip.sensor not in identity.exchanged_frames
            and not is_drawn_by_step(view, every, slip.sensor, (slip.axis, slip.first, slip.last))
        ],
    )
    yield precision_figures(
        rig, mosaic, level1, temperatures.usable_c, adjusted.uncertainty_contribution
    )
    yield ValidFigures(float(np.count_nonzero(image.pan.source)) / image.pan.source.size)
    yield ParallaxFigures(parallax_px(rig, conditions, settings.relief_fraction))


def _worst_first(*groups: tuple[Slip, ...]) -> list[Slip]:
    """All slips, those of the group with the longest one first; each group in its order."""
    longest = sorted(groups, key=lambda group: -max((s.length_px for s in group), default=0.0))
    return [slip for group in longest for slip in group]


def _explained_frames(corrected: CorrectedFrames, adjusted: AdjustedFrames) -> set[str]:
    """Frames of which the report knows why points of theirs do not match."""
    content = adjusted.content
    slipped = {slip.sensor for slip in adjusted.stitching.slips}
    repeated = {
        str(group.repeated_lines_sensor)
        for group in corrected.figures
        if isinstance(group, RepeatedLineFigures)
    }
    return {*content.mismatched, *content.shifted_px, *slipped, *corrected.by_pattern, *repeated}


def _of_other_group(
    rig: Rig,
    content: ContentCheck,
    registrations: Sequence[BandRegistration],
    level1: Mapping[str, Array],
) -> tuple[str, ...]:
    """The other colour heads and all PAN heads, where green alone disagrees with PAN.

    Where other colour heads agree with green, and PAN heads with each other, the frames of either
    group may be of another exposure.
    """
    if rig.colour_master_cone is None:
        return ()
    green = rig.cone(rig.colour_master_cone).sensors[0].name
    agreeing = [band.sensor for band in registrations if band.registered]
    pan = [s.name for cone in rig.pan_cones for s in cone.sensors if s.name in level1]
    if set(content.mismatched) != {green} or not agreeing or len(pan) < 2:
        return ()
    return (*agreeing, *pan)


def _odd_frames(corrected: CorrectedFrames) -> set[str]:
    """Frames whose words or lines are not the sensor's: healthy neighbours seem blurred by them."""
    found: set[str] = set()
    for group in corrected.figures:
        if isinstance(group, WordFormatFigures):
            found |= {*group.word_format_sensors, *group.constant_bits_sensors}
        if isinstance(group, LineOrderFigures) and group.line_order_sensor is not None:
            found.add(group.line_order_sensor)
    return found


def misplaced_px(rig: Rig, content: ContentCheck) -> float:
    """How far the farthest frame lies from where points are sought; zero where all are there.

    Where frames lie elsewhere and PAN frames were not found, or most of the PAN frames were not,
    these lie beyond the wide search: that far at least.

    Args:
        rig: the camera.
        content: check of the frames' content.

    Returns:
        PAN pixels; zero where all are there.
    """
    farthest = max((math.hypot(*shift) for shift in content.shifted_px.values()), default=0.0)
    pan = {s.name for cone in rig.pan_cones for s in cone.sensors}
    lost = len(pan & content.mismatched.keys())
    if (content.shifted_px and lost) or (lost > 2 and 2 * lost > len(pan)):
        return max(farthest, float(WIDE_SEARCH_PX))
    return farthest


def _saturated_overlap(
    rig: Rig, settings: PipelineSettings, corrected: CorrectedFrames, stitching: Stitching
) -> SaturatedOverlapFigures | None:
    """Whether saturation is why the poorest overlap has too few tie points."""
    pairs: Sequence[tuple[str, str]] = stitching.tie_points.pairs
    poorest = poorest_overlap(rig, stitching.image, corrected.level1)
    if poorest is None or poorest not in pairs:
        return None
    if stitching.image.used[poorest] >= settings.thresholds.tie_points_per_overlap:
        return None
    return SaturatedOverlapFigures(
        saturated_window_fraction(
            rig, corrected.start, corrected.level1, poorest, settings=settings.tie_points
        )
    )
