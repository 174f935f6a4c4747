"""Processors of exposures: one interface for every rig, chosen by the rig alone.

The worker in flight, `syntopic process` after landing and the replay all come through here.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from daemon.configuration.model import ProcessingSection
from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.planning.plan_readers import read_plan
from daemon.products.band_images import build_bands, radiance_folder, radiance_of
from daemon.products.head_images import build_heads
from daemon.products.product_files import FramesRead, ProductFiles
from daemon.products.stitched_image import build_stitched
from processing.pipelines.bands import BAND_THRESHOLDS, BandPipeline, BandPipelineSettings
from processing.pipelines.exposure_pipeline import ExposurePipeline
from processing.pipelines.kernel_compilation import compile_missing
from processing.pipelines.parallel_compilation import KernelCompilationError
from processing.pipelines.perspective import HeadPipeline, HeadSettings, has_head_images
from processing.pipelines.stitched import Conditions, Pipeline, PipelineSettings
from processing.quality.report import Thresholds
from processing.quality.requirements import QualityRequirements
from processing.radiometry.calibration import RadiometryFolder
from processing.rig import Rig

log = logging.getLogger(__name__)
Frames: TypeAlias = Mapping[str, NDArray[np.uint16]]


@dataclass(frozen=True)
class Processor:
    """Frames of one exposure in, the files of its Level-2 folder out; one exposure at a time.

    `build` gets the pipeline, the exposure, frames, conditions and a callback for when the frames
    are read. Pixels in what comes back may be buffers that hold until the next exposure.
    """

    pipeline: ExposurePipeline[Any, Any, Any, Any, Any]
    build: Callable[[Any, Exposure, Frames, Conditions, FramesRead], ProductFiles]

    @property
    def rig(self) -> Rig:
        return self.pipeline.rig

    def warm_up(self) -> None:
        """Load every kernel; another process compiles those that are not in the cache."""
        try:
            compile_missing()
        except KernelCompilationError as error:
            log.warning("kernels are compiled by this process: %s", error)
        self.pipeline.warm_up()

    def clone(self) -> Processor:
        return replace(self, pipeline=self.pipeline.clone())

    def make(
        self,
        exposure: Exposure,
        frames: Frames,
        conditions: Conditions,
        *,
        frames_read: FramesRead = None,
    ) -> ProductFiles:
        """Make the images of one exposure and evaluate it."""
        return self.build(self.pipeline, exposure, frames, conditions, frames_read)


def processor_for(
    rig: Rig, mission: Mission, processing: ProcessingSection, radiometry: Path | None
) -> Processor:
    """The processor of a mission: by its flight plan, and with its own calibrations by default.

    Args:
        radiometry: folder of calibrations; sensors without one are taken as ideal.

    Raises:
        CalibrationError, ValueError: a calibration that does not fit, a rig of no known kind, or a
            device that cannot be used.
    """
    own = radiance_folder(mission)
    return build_processor(rig, processing, radiometry, mission.plan_path, own_radiance=own)


def build_processor(
    rig: Rig,
    processing: ProcessingSection,
    radiometry: Path | None,
    plan_file: Path | None,
    *,
    own_radiance: Path | None = None,
) -> Processor:
    """Create the processor of this rig: stitched, head by head, or band by band.

    Args:
        radiometry: folder of calibrations; sensors without one are taken as ideal.
        plan_file: flight plan with the requirements exposures are evaluated by.
        own_radiance: folder of radiance calibrations where `radiometry` is None.

    Raises:
        CalibrationError, ValueError: a calibration that does not fit, a rig of no known kind, or a
            device that cannot be used.
        PlanError: a plan that cannot be read.
    """
    given: dict[str, Any] = processing.thresholds
    common: dict[str, Any] = {
        "threads": processing.threads,
        "device": processing.device,
        "thresholds": replace(Thresholds(), **given),
        "requirements": quality_requirements_of(plan_file),
    }
    if rig.virtual_image is None and not has_head_images(rig):
        radiance = radiance_of(rig, radiometry or own_radiance)
        common["thresholds"] = replace(BAND_THRESHOLDS, **given)
        pipeline = BandPipeline(rig, radiance, BandPipelineSettings(**common))
        return Processor(pipeline, partial(build_bands, radiance))
    known = None if radiometry is None else RadiometryFolder(radiometry, rig)
    common["interpolation"] = processing.interpolation
    if rig.virtual_image is None:
        return Processor(HeadPipeline(rig, known, HeadSettings(**common)), build_heads)
    settings = PipelineSettings(
        method=processing.method,
        baselines=processing.baselines,
        geometry=processing.geometry,
        **common,
    )
    return Processor(Pipeline(rig, known, settings), build_stitched)


def quality_requirements_of(plan_file: Path | None) -> QualityRequirements:
    """Requirements of a flight plan on every exposure; none without a plan."""
    if plan_file is None:
        return QualityRequirements()
    wanted = read_plan(plan_file).specification
    return QualityRequirements(
        forward_overlap=max(0.0, wanted.forward_overlap - wanted.overlap_tolerance),
        sidelap=max(0.0, wanted.sidelap - wanted.overlap_tolerance),
        gsd_m=wanted.gsd_m,
        tilt_deg=wanted.tilt_deg,
        crab_deg=wanted.crab_deg,
        sun_deg=wanted.sun_deg,
        time_sigma_ns=wanted.time_sigma_ns,
    )
