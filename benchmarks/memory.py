"""`python -m benchmarks.memory RIG`: what the pipeline holds in memory, exposure by exposure.

The exposure of `syntopic bench` is processed repeatedly, two at a time as in the service; the
memory the process owns (PSS) is read after each. Nothing is written.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from daemon.cli.benchmark import pipeline
from daemon.cli.benchmark.measurement import machine
from daemon.configuration.model import PlanSection
from daemon.mission.layout import Mission
from daemon.mission.store import store
from daemon.products.exposure_conditions import conditions_of
from daemon.products.pipeline_pool import PipelinePool
from processing.pipelines.stitched import Pipeline, PipelineSettings
from processing.quality.report import Flag
from processing.radiometry.calibration import RadiometryFolder
from processing.rig import find_rig, load_rig

WARM_UP_EXPOSURES = 4
"""Exposures until each pipeline has used all of its buffers twice."""


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.memory", description=__doc__)
    parser.add_argument("rig", help="name of a shipped rig")
    parser.add_argument("--exposures", type=int, default=200)
    parser.add_argument("--parallel", type=int, default=2, help="exposures in work at a time")
    options = parser.parse_args()
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "syntopic"
    found = find_rig(options.rig)
    folder = pipeline.benchmark_exposure(options.rig, found, cache / "bench" / found.name)
    seen = held_mib(folder, options.exposures, options.parallel)
    warmed_up = seen[min(WARM_UP_EXPOSURES, len(seen) - 1)]
    output: dict[str, Any] = {
        "machine": machine(),
        "rig": found.name,
        "exposures": options.exposures,
        "parallel_exposures": options.parallel,
        "warmed_up_mib": round(warmed_up, 1),
        "last_mib": round(seen[-1], 1),
        "most_mib": round(max(seen), 1),
        "tenths_mib": [
            round(float(np.median(part)), 1) for part in np.array_split(seen, 10) if len(part)
        ],
    }
    print(json.dumps(output))


def held_mib(folder: Path, exposures: int, parallel: int) -> list[float]:
    """MiB of the process after every exposure, in the order they were done.

    Args:
        folder: from `daemon.cli.benchmark.pipeline.exposures_of`.
    """
    mission = Mission.open(folder / "mission")
    rig = load_rig(mission.rig_path)
    radiometry = folder / "calibration" / "radiometry"
    pipeline = Pipeline(rig, RadiometryFolder(radiometry, rig), PipelineSettings(geometry=False))
    pipeline.warm_up()
    stored, exposure = store.load_level0(mission.level0(1), rig)
    frames = {name: np.array(frame) for name, frame in stored.items()}
    conditions = conditions_of(exposure, rig, PlanSection(), Flag(0))
    seen: list[float] = []

    def one(worker: Pipeline) -> None:
        worker.process(frames, conditions)
        seen.append(pss_mib())

    work = PipelinePool(pipeline, parallel)
    for task in [work.submit(one) for _ in range(exposures)]:
        task.result()
    work.end()
    return seen


def pss_mib() -> float:
    """Proportional set size of this process, MiB."""
    for line in Path("/proc/self/smaps_rollup").read_text().splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) / 1024
    raise OSError("no Pss in /proc/self/smaps_rollup")


if __name__ == "__main__":
    main()
