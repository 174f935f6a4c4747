"""All Level-2 files of one exposure, for the worker in flight, the commands and the replay."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon.configuration.model import MountSection, PlanSection
from daemon.mission.canonical_json import canonical_bytes
from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.mission.store import level2
from daemon.orientation.ground_model import GroundModel
from daemon.orientation.in_flight_orientation import orientation_json
from daemon.planning.overlaps import OverlapShares
from daemon.products.exposure_conditions import capture_flags, conditions_of
from daemon.products.processor import Processor
from daemon.products.product_files import Contents, FramesRead
from processing.quality.evaluation import evaluate
from processing.quality.figures import QualityFigures
from processing.quality.report import NO_FLAGS, Flag, as_json
from processing.radiometry.exposure_control import sampled_histogram
from processing.rig import Rig, Sensor


@dataclass(frozen=True)
class FlightGeometry:
    """What all exposures of a mission have in common besides the rig: mount, plan, height model."""

    mount: MountSection
    plan: PlanSection
    ground: GroundModel | None = None


@dataclass(frozen=True)
class ExposureProducts:
    """The Level-2 files of one exposure.

    `report` is the content of quality.json, `contents` the parts of every file by its name,
    `histograms` the counts of raw DN by sensor. Pixels among the contents hold until the
    processor's next exposure.
    """

    report: dict[str, Any]
    contents: Contents
    histograms: Mapping[str, tuple[int, ...]]


def make_products(
    processor: Processor,
    geometry: FlightGeometry,
    exposure: Exposure,
    frames: Mapping[str, NDArray[np.uint16]],
    flags: Flag = NO_FLAGS,
    overlap_shares: OverlapShares | None = None,
    *,
    frames_read: FramesRead = None,
) -> ExposureProducts:
    """All Level-2 files of one exposure: its images, and the files common to every rig.

    Args:
        frames: Level-0 frames by sensor name, (h, w) uint16.
        flags: in addition to those of the record.
        overlap_shares: overlaps with earlier exposures, where known.
        frames_read: called once the pixels of `frames` are no longer needed.

    Raises:
        RecordError: an exposure time or a TDI count that cannot be.
        ValueError: a frame of the wrong shape or type.
    """
    plan = geometry.plan
    conditions = conditions_of(
        exposure, processor.rig, plan, flags, overlap_shares, ground=geometry.ground
    )
    histograms = _histograms(processor.rig, frames)  # before the frames are let go
    report, contents = processor.make(exposure, frames, conditions, frames_read=frames_read)
    orientation = orientation_json(exposure, processor.rig, geometry.mount, plan.ground_height_m)
    contents["histogram.json"] = [canonical_bytes({k: list(v) for k, v in histograms.items()})]
    contents["orientation.json"] = [canonical_bytes(orientation)]
    return ExposureProducts(report, contents, histograms)


def process_exposure(
    processor: Processor,
    mission: Mission,
    geometry: FlightGeometry,
    exposure: Exposure,
    frames: Mapping[str, NDArray[np.uint16]],
    overlap_shares: OverlapShares | None = None,
) -> dict[str, Any]:
    """Make the images of one exposure and write its Level-2 folder.

    Returns:
        The content of quality.json.
    """
    products = make_products(processor, geometry, exposure, frames, overlap_shares=overlap_shares)
    level2.write_folder(mission.level2(exposure.number), products.contents)
    return products.report


def report_unprocessed(rig: Rig, exposure: Exposure, flags: Flag) -> dict[str, Any]:
    """The quality report of an exposure that has no image: what capture knows of it."""
    known_flags = capture_flags(exposure, rig) | flags | Flag.NOT_PROCESSED
    if exposure.simulated:
        known_flags |= Flag.SIMULATED
    missing = [sensor for sensor, _ in exposure.missing]
    report = as_json(evaluate(QualityFigures(), capture_flags=known_flags, missing_sensors=missing))
    return {**report, "exposure": exposure.number}


def _histograms(rig: Rig, frames: Mapping[str, NDArray[np.uint16]]) -> dict[str, tuple[int, ...]]:
    return {
        name: sampled_histogram(frame, _word_bits(rig.sensor(name)))
        for name, frame in frames.items()
    }


def _word_bits(sensor: Sensor) -> int:
    return 16 if sensor.justified == "left" else sensor.bits
