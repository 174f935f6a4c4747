"""`python -m benchmarks.shared_maps RIG`: calibration maps in several processes at once.

Each process reads the calibrations of the exposure of `syntopic bench` and makes them ready. Then
the memory it owns (PSS) is read, first with maps of its own, then with shared ones.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from benchmarks.memory import pss_mib
from daemon.cli.benchmark import pipeline
from daemon.cli.benchmark.measurement import machine
from daemon.products.shared_maps import share_maps
from processing.radiometry.calibration import RadiometryFolder
from processing.radiometry.corrector import correctors_for
from processing.rig import find_rig

WAIT_S = 3600.0
_others: Any = None
"""Where the processes wait for each other."""


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.shared_maps", description=__doc__)
    parser.add_argument("rig", help="name of a shipped rig")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "syntopic"
    rig = find_rig(options.rig)
    folder = pipeline.benchmark_exposure(options.rig, rig, cache / "bench" / rig.name)
    context = multiprocessing.get_context("spawn")
    barrier = context.Barrier(options.processes)
    with ProcessPoolExecutor(
        options.processes, mp_context=context, initializer=_take_barrier, initargs=(barrier,)
    ) as pool:
        radiometry = folder / "calibration" / "radiometry"
        started = [pool.submit(measured, options.rig, radiometry) for _ in range(options.processes)]
        found = [one.result() for one in started]
    print(json.dumps({"machine": machine(), "rig": rig.name, "processes": found}))


def _take_barrier(barrier: Any) -> None:
    global _others
    _others = barrier


def measured(name: str, radiometry: Path) -> dict[str, float]:
    """MiB of this process without maps, with its own ones, and with shared ones.

    Args:
        name: of the rig.
        radiometry: folder of its calibrations.
    """
    rig = find_rig(name)
    _others.wait(WAIT_S)
    found = {"without_mib": pss_mib()}
    correctors = correctors_for(rig.sensors, RadiometryFolder(radiometry, rig))
    _others.wait(WAIT_S)
    found["own_mib"] = pss_mib()
    _others.wait(WAIT_S)
    if not share_maps(correctors):
        raise OSError("the disk for temporary files has no room for the maps")
    _others.wait(WAIT_S)
    found["shared_mib"] = pss_mib()
    _others.wait(WAIT_S)
    return {key: round(value, 1) for key, value in found.items()}


if __name__ == "__main__":
    main()
