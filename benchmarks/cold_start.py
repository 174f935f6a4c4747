"""`python -m benchmarks.cold_start RIG`: from the start of a worker to its first exposure.

Each run is a process of its own, which does what the worker of the service does, with compiled
kernels in numba's cache and calibrations in the page cache.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

STEPS = ("imports", "calibrations", "kernels", "rehearsal")


def main() -> None:
    """Measure, and print the medians as JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cold_start", description=__doc__)
    parser.add_argument("rig", help="name of a shipped rig")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--once-in", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.once_in is not None:
        print(json.dumps(once(options.once_in)))
        return

    from daemon.cli.benchmark import pipeline
    from daemon.cli.benchmark.measurement import machine
    from processing.rig import find_rig

    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "syntopic"
    found = find_rig(options.rig)
    folder = pipeline.benchmark_exposure(options.rig, found, cache / "bench" / found.name)
    command = [sys.executable, "-m", __spec__.name, options.rig, "--once-in", str(folder)]
    runs = []
    for _ in range(options.runs + 1):
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600)
        runs.append(json.loads(done.stdout))
    medians = {
        step: round(statistics.median(run[step] for run in runs[1:]), 2)
        for step in (*STEPS, "all", "cpu")
    }
    print(json.dumps({"machine": machine(), "rig": found.name, "seconds": medians}))


def once(folder: Path) -> dict[str, float]:
    """Seconds of each step in this process; `all` begins with the interpreter's start."""
    began = time.perf_counter()
    marks: dict[str, float] = {}

    def mark(step: str) -> None:
        marks[step] = time.perf_counter() - began - sum(marks.values())

    from daemon.mission.layout import Mission
    from daemon.products.processing_threads import configure_threads
    from processing.pipelines.kernel_compilation import compile_missing
    from processing.pipelines.stitched import Pipeline, PipelineSettings
    from processing.radiometry.calibration import RadiometryFolder
    from processing.rig import load_rig

    configure_threads()
    mark("imports")
    rig = load_rig(Mission.open(folder / "mission").rig_path)
    radiometry = RadiometryFolder(folder / "calibration" / "radiometry", rig)
    pipeline = Pipeline(rig, radiometry, PipelineSettings(geometry=False))
    mark("calibrations")
    compile_missing()
    mark("kernels")
    pipeline.warm_up()
    mark("rehearsal")
    return marks | {"all": sum(marks.values()), "cpu": time.process_time()}


if __name__ == "__main__":
    main()
