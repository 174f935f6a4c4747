"""The pipeline worker: Level-0 in, Level-2 products and a verdict out.

It reads an exposure from shared memory while it is still there, else from disk; it never makes the
capture wait.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon import products, store
from daemon.conditions import conditions_of
from daemon.configuration import PlanSection
from daemon.exposure import Exposure
from daemon.memory import FrameRing
from daemon.messages import (
    Ping,
    Pong,
    Process,
    Processed,
    ProcessFailed,
    Stop,
    WorkerReady,
    WorkerSettings,
)
from daemon.mission import Mission
from daemon.processes import Link
from processing.drawing import residuals_svg
from processing.pipeline import Pipeline, Settings
from processing.quality import Flag, as_json
from processing.radiometry import RadiometricCalibration, load_radiometry
from processing.rig import Rig, find_rig
from processing.stitch_record import stitch_record, stitch_record_json


def main(link: Link, settings: WorkerSettings, rings: tuple[FrameRing, ...]) -> None:
    """Process until told to stop."""
    started = time.monotonic()
    rig = find_rig(settings.rig)
    pipeline = make_pipeline(rig, settings)
    pipeline.warm_up()
    memory = {ring.head: ring for ring in rings}
    mission = Mission.open(settings.mission)
    link.send(WorkerReady(time.monotonic() - started))
    while not isinstance(order := link.receive(timeout_s=1.0), Stop):
        if isinstance(order, Ping):
            link.send(Pong({}))
        elif isinstance(order, Process):
            link.send(_process(pipeline, rig, mission, settings.plan, memory, order))


def make_pipeline(rig: Rig, settings: WorkerSettings) -> Pipeline:
    """The pipeline with the calibrations of its folder; sensors without one are taken as ideal."""
    radiometry: dict[str, RadiometricCalibration] = {}
    if settings.radiometry is not None:
        for sensor in rig.sensors:
            path = settings.radiometry / f"{sensor.name}.npz"
            if path.exists():
                radiometry[sensor.name] = load_radiometry(path)
    return Pipeline(
        rig,
        radiometry,
        Settings(
            method=settings.processing.method,
            interpolation=settings.processing.interpolation,
            baselines=settings.processing.baselines,
            threads=settings.processing.threads,
        ),
    )


def process_exposure(
    pipeline: Pipeline,
    rig: Rig,
    mission: Mission,
    plan: PlanSection,
    exposure: Exposure,
    frames: Mapping[str, NDArray[np.uint16]],
    flags: Flag = Flag(0),  # noqa: B008 - an immutable value
) -> tuple[dict[str, Any], Mapping[str, int]]:
    """Run the pipeline on one exposure and write its Level-2 folder.

    Returns:
        The content of quality.json, and the files written with their sizes in bytes.
    """
    product = pipeline.process(frames, conditions_of(exposure, rig, plan, flags))
    report = as_json(product.report)
    report["exposure"] = exposure.number
    told = product.temperatures
    stitching = None
    if product.mosaic.method == "free":
        stitching = stitch_record_json(
            stitch_record(rig, product.free, told.placing_c, told.usable_c, product.estimated_dc)
        )
    report["timings_s"] = {stage: round(s, 4) for stage, s in product.timings_s.items()}
    written = products.write_level2(
        mission,
        exposure.number,
        pan=product.pan,
        colour=product.colour,
        quicklook=product.quicklook,
        report_json=report,
        geometry=product.geometry,
        residuals_svg=residuals_svg(rig, product.tie_points, product.mosaic, product.validity),
        mosaic_json=stitching,
    )
    return report, written.files


def _process(
    pipeline: Pipeline,
    rig: Rig,
    mission: Mission,
    plan: PlanSection,
    memory: Mapping[str, FrameRing],
    order: Process,
) -> Processed | ProcessFailed:
    started = time.monotonic()
    exposure = order.exposure
    flags = Flag(0)
    try:
        if order.slots is None:
            flags |= Flag.PROCESSING_BEHIND
            frames = store.load_level0(mission.level0(exposure.number), rig)[0]
        else:
            frames = {
                frame.sensor: memory[frame.sensor].frame(
                    order.slots[frame.sensor], frame.height_px, frame.width_px
                )
                for frame in exposure.frames
            }
        report, files = process_exposure(pipeline, rig, mission, plan, exposure, frames, flags)
    except (OSError, ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        sentence = (
            f"exposure {exposure.number} was stored but not processed: {error}; "
            f"run syntopic process {mission.path} after landing"
        )
        return ProcessFailed(exposure.number, sentence)
    return Processed(exposure.number, report, files, time.monotonic() - started)
