"""`python -m benchmarks.mini`: the pipeline and the writer on an emulated mini exposure.

Flies three exposures to have real frames, then times the pipeline and a plain copy of the bytes
it reads and writes, and the Level-0 writer and a plain write + fsync of the same bytes. It exits
with 1 where the pipeline is slower than its record, and with 3 where there is none to compare with.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from benchmarks import gate
from daemon.cli.benchmark import peers
from daemon.cli.benchmark.measurement import interleaved, machine
from daemon.configuration.model import MountSection, PlanSection
from daemon.mission.exposure import CaptureRecord, FrameRecord
from daemon.mission.layout import Mission
from daemon.mission.store.store import Level0Writer, load_level0
from daemon.products.exposure_conditions import conditions_of
from daemon.products.exposure_products import FlightGeometry, make_products
from daemon.products.processing_threads import configure_threads, thread_counts
from daemon.products.processor import Processor
from daemon.products.stitched_image import build_stitched
from daemon.terminal.console import Console
from processing.pipelines.stitched import Pipeline, PipelineSettings
from processing.quality.report import NO_FLAGS
from processing.radiometry.calibration import load_radiometry
from processing.rig import load_rig
from sim_hw.__main__ import parser

THREADS = 2
COPY_S = 0.1
"""CPU time of the copies of one run: one alone takes 4 to 7 ms."""
GROUND: str = parser().get_default("ground")
"""What the demonstration flies over."""
Frames = Mapping[str, NDArray[np.uint16]]


def main() -> int:
    line = argparse.ArgumentParser(prog="python -m benchmarks.mini", description=__doc__)
    line.add_argument("--runs", type=int, default=gate.RUNS, help=f"{gate.RUNS} or more")
    line.add_argument("--json", action="store_true", help="print one JSON object")
    line.add_argument("--accept", action="store_true", help="write the ratios to the record")
    options = line.parse_args()
    if options.runs < gate.RUNS:
        line.error(f"--runs is {options.runs}; the gate compares medians of {gate.RUNS} or more")
    with tempfile.TemporaryDirectory(prefix="syntopic-bench-") as folder:
        mission, radiometry = _fly(Path(folder))
        result: dict[str, Any] = {
            "machine": machine(),
            "rig": "ultracam-x-mini",
            "pipeline": _in_own_process(mission, radiometry, options.runs),
            "writer": _time_writer(Path(folder), mission, options.runs),
        }
    ratios, processor = result["pipeline"]["ratios"], gate.processor_name()
    result["gate"] = gate.compared(ratios, processor, GROUND)
    if options.json:
        print(json.dumps(result))
    else:
        _print(result)
    if options.accept:
        gate.accept(ratios, processor, GROUND, result["machine"]["cores"])
        return 0
    return int(result["gate"]["status"])


def _fly(folder: Path) -> tuple[Mission, Path]:
    completed = subprocess.run(
        [
            *(sys.executable, "-m", "daemon", "demo", "--json", "--exposures", "3"),
            *("--out", str(folder)),
        ],
        stdout=subprocess.PIPE,
        check=True,
        timeout=300,
    )
    mission = Path(json.loads(completed.stdout)["mission"])
    return Mission.open(mission), mission.parents[1] / "sim" / "calibration" / "radiometry"


def _in_own_process(mission: Mission, radiometry: Path, runs: int) -> dict[str, Any]:
    """Time the pipeline in a process that begins as the service's worker does: no thread spins."""
    for name, count in thread_counts(THREADS).items():
        os.environ.setdefault(name, count)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as worker:
        return worker.submit(_time_pipeline, mission.path, radiometry, runs).result()


def _time_pipeline(mission_path: Path, radiometry: Path, runs: int) -> dict[str, Any]:
    configure_threads()
    mission = Mission.open(mission_path)
    rig = load_rig(mission.rig_path)
    calibrations = {s.name: load_radiometry(radiometry / f"{s.name}.npz") for s in rig.sensors}
    pipeline = Pipeline(rig, calibrations, PipelineSettings(geometry=False, threads=THREADS))
    pipeline.warm_up()
    frames, exposure = load_level0(mission.level0(2), rig)
    plan = PlanSection(ground_height_m=395.0, height_above_ground_m=3000.0)
    geometry = FlightGeometry(MountSection(), plan)
    conditions = conditions_of(exposure, rig, plan, NO_FLAGS)
    stages: dict[str, list[float]] = {}
    product = pipeline.process(frames, conditions)
    written = [product.pan, *product.colour.values()]
    sources = [*frames.values(), *written]
    copies = [np.empty_like(array) for array in sources]

    def process() -> None:
        done = pipeline.process(frames, conditions)
        for stage, seconds in done.timings_s.items():
            stages.setdefault(stage, []).append(seconds)

    def copy() -> None:
        for target, source in zip(copies, sources, strict=True):
            np.copyto(target, source)

    remaps = [
        peers.remap_of(rig, product.mosaic.placements[name], frames[name])
        for name in product.sensors
    ]

    def remap() -> None:
        for one in remaps:
            one()

    used = time.process_time()
    copy()
    times = math.ceil(COPY_S / max(time.process_time() - used, 1e-3))
    processor = Processor(pipeline, build_stitched)

    def copies_of_one_run() -> None:
        for _ in range(times):
            copy()

    timed = interleaved(
        runs,
        process=process,
        products=lambda: make_products(processor, geometry, exposure, frames),
        copy=copies_of_one_run,
        remap=remap,
    )
    timed["copy"] = {name: seconds / times for name, seconds in timed["copy"].items()}
    pixels = sum(frame.size for frame in frames.values())
    seconds = timed["process"]["median_s"]
    return {
        **timed,
        "stages_median_s": {stage: float(np.median(s)) for stage, s in stages.items()},
        "megapixels_per_s": pixels / 1e6 / seconds,
        "ratio_to_copy": seconds / timed["copy"]["median_s"],
        "ratio_to_remap": seconds / timed["remap"]["median_s"],
        "ratios": gate.ratios_of(timed),
        "realtime_factor": rig.frame_interval_s / seconds,
    }


def _time_writer(folder: Path, mission: Mission, runs: int) -> dict[str, Any]:
    rig = load_rig(mission.rig_path)
    frames, exposure = load_level0(mission.level0(2), rig)
    target = Mission.create(
        folder / "writer",
        rig.name,
        rig_toml=mission.rig_path.read_bytes(),
        service_toml=b"",
        started_utc=datetime.now(UTC),
    )
    writer = Level0Writer(target)
    numbers = iter(range(1, 10_000))
    records: tuple[FrameRecord, ...] = tuple(
        replace(f, file="", sha256="") for f in exposure.frames
    )

    def store() -> None:
        writer.write(CaptureRecord(number=next(numbers), frames=records), frames)

    def plain() -> None:
        path = folder / "plain"
        with path.open("wb", buffering=0) as file:
            for frame in frames.values():
                file.write(np.ascontiguousarray(frame).data)
            os.fsync(file.fileno())
        path.unlink()

    timed = interleaved(runs, store=store, plain=plain)
    writer.close()
    ratio = timed["plain"]["median_s"] / timed["store"]["median_s"]
    return {**timed, "ratio_of_plain_speed": ratio}


def _print(result: Mapping[str, Any]) -> None:
    console = Console()
    m = result["machine"]
    console.print(
        f"{m['date']}  {m['processor']}, {m['cores']} cores, {m['memory_gib']} GiB, "
        f"Python {m['python']}"
    )
    table = Table(title=f"Pipeline, {result['rig']}", title_justify="left")
    for heading in ("stage", "median ms"):
        table.add_column(heading, justify="right")
    pipeline = result["pipeline"]
    for stage, seconds in pipeline["stages_median_s"].items():
        table.add_row(stage, f"{seconds * 1e3:.1f}")
    table.add_row("all", f"{pipeline['process']['median_s'] * 1e3:.1f}")
    console.print(table)
    console.print(
        f"{pipeline['megapixels_per_s']:.1f} Mpx/s, {pipeline['ratio_to_copy']:.0f} times a plain "
        f"copy, {pipeline['ratio_to_remap']:.2f} times a bare remap, realtime_factor "
        f"{pipeline['realtime_factor']:.2f}"
    )
    console.print(
        f"writer: {result['writer']['ratio_of_plain_speed']:.2f} of the speed of write + fsync"
    )
    for sentence in result["gate"]["sentences"]:
        console.print(sentence, soft_wrap=True)


if __name__ == "__main__":
    sys.exit(main())
