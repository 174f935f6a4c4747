"""Processors of exposures: one interface for every rig, chosen by the rig alone.

The worker in flight, `syntopic process` after landing and the replay all come through here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from daemon.configuration.model import MountSection, PlanSection, ProcessingSection
from daemon.mission.canonical_json import canonical_bytes
from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.mission.store.radiometry_folder import RadiometryFolder
from daemon.orientation.in_flight_orientation import orientation_json
from daemon.planning.plan_readers import read_plan
from daemon.products.band_images import build_bands, radiance_folder, radiance_of
from daemon.products.head_images import build_heads
from daemon.products.product_files import FramesRead, ProductFiles
from daemon.products.stitched_image import build_stitched
from processing.pipelines.bands import BandPipeline
from processing.pipelines.perspective import HeadPipeline, has_diverging_axes
from processing.pipelines.stitched import Conditions, Pipeline, PipelineSettings
from processing.quality.report import Thresholds
from processing.quality.requirements import QualityRequirements
from processing.radiometry.histogram import sampled_histogram
from processing.rig import Rig, Sensor

Frames: TypeAlias = Mapping[str, NDArray[np.uint16]]


class AnyPipeline(Protocol):
    """Interface common to the pipelines of all kinds of rig."""

    @property
    def rig(self) -> Rig:
        """The camera."""

    def warm_up(self) -> None:
        """Compile, or load, every kernel a flight will need."""

    def clone(self) -> AnyPipeline:
        """A second one for another exposure at the same time; calibrations are shared."""


@dataclass(frozen=True)
class Processor:
    """Frames of one exposure in, the files of its Level-2 folder out; one exposure at a time.

    `made` gets the pipeline, the exposure, frames, conditions and a callback for when the frames
    are read. Pixels in what comes back may be buffers that hold until the next exposure.
    """

    pipeline: AnyPipeline
    build: Callable[[Any, Exposure, Frames, Conditions, FramesRead], ProductFiles]

    @property
    def rig(self) -> Rig:
        return self.pipeline.rig

    def warm_up(self) -> None:
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
        CalibrationError, ValueError: a calibration that does not fit, or a rig of no known kind.
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
        CalibrationError, ValueError: a calibration that does not fit, or a rig of no known kind.
        PlanError: a plan that cannot be read.
    """
    requirements = quality_requirements_of(plan_file)
    threads = processing.threads
    given: dict[str, Any] = processing.thresholds
    thresholds = replace(Thresholds(), **given)
    if rig.virtual_image is None and not has_diverging_axes(rig):
        radiance = radiance_of(rig, radiometry or own_radiance)
        pipeline = BandPipeline(rig, radiance, threads=threads, requirements=requirements)
        pipeline.thresholds = replace(pipeline.thresholds, **given)
        return Processor(pipeline, partial(build_bands, radiance))
    known = None if radiometry is None else RadiometryFolder(radiometry, rig)
    if rig.virtual_image is None:
        return Processor(
            HeadPipeline(
                rig,
                known,
                interpolation=processing.interpolation,
                threads=threads,
                thresholds=thresholds,
                requirements=requirements,
            ),
            build_heads,
        )
    return Processor(
        Pipeline(
            rig,
            known,
            PipelineSettings(
                method=processing.method,
                interpolation=processing.interpolation,
                baselines=processing.baselines,
                geometry=processing.geometry,
                threads=threads,
                thresholds=thresholds,
                requirements=requirements,
            ),
        ),
        build_stitched,
    )


def make_products(
    processor: Processor,
    mount: MountSection,
    plan: PlanSection,
    exposure: Exposure,
    frames: Mapping[str, NDArray[np.uint16]],
    conditions: Conditions,
    *,
    frames_read: Callable[[], None] | None = None,
) -> ProductFiles:
    """All Level-2 files of one exposure: its images, and the files common to every rig.

    Returns:
        The content of quality.json, and the parts of every file by its name. Pixels among them
        hold until the processor's next exposure.
    """
    histograms = histograms_of(processor.rig, frames)  # before the frames are let go
    report, contents = processor.make(exposure, frames, conditions, frames_read=frames_read)
    orientation = orientation_json(exposure, processor.rig, mount, plan.ground_height_m)
    contents["histogram.json"] = [canonical_bytes({k: list(v) for k, v in histograms.items()})]
    contents["orientation.json"] = [canonical_bytes(orientation)]
    return report, contents


def histograms_of(rig: Rig, frames: Mapping[str, NDArray[np.uint16]]) -> dict[str, tuple[int, ...]]:
    """Counts of raw DN by sensor."""
    return {
        name: sampled_histogram(frame, _word_bits(rig.sensor(name)))
        for name, frame in frames.items()
    }


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


def _word_bits(sensor: Sensor) -> int:
    return 16 if sensor.justified == "left" else sensor.bits
