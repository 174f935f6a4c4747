"""Times of runs that alternate, and the machine they were taken on."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any


def interleaved(runs: int, **tasks: Callable[[], object]) -> dict[str, dict[str, float]]:
    """Time tasks in turn; for each task seconds: median, least, most, and median CPU seconds."""
    seconds: dict[str, list[float]] = {name: [] for name in tasks}
    cpu_s: dict[str, list[float]] = {name: [] for name in tasks}
    for _ in range(runs):
        for name, task in tasks.items():
            used, started = time.process_time(), time.perf_counter()
            task()
            seconds[name].append(time.perf_counter() - started)
            cpu_s[name].append(time.process_time() - used)
    return {
        name: {**spread(values), "median_cpu_s": statistics.median(cpu_s[name])}
        for name, values in seconds.items()
    }


def spread(seconds: list[float]) -> dict[str, float]:
    """Median, least and most."""
    return {"median_s": statistics.median(seconds), "min_s": min(seconds), "max_s": max(seconds)}


def machine() -> dict[str, Any]:
    """Properties of the machine, with its load at the time of the measurement."""
    text = Path("/proc/cpuinfo").read_text()
    models = [line.split(":", 1)[1].strip() for line in text.splitlines() if "model name" in line]
    memory_kb = int(Path("/proc/meminfo").read_text().split()[1])
    return {
        "date": f"{datetime.now(UTC):%Y-%m-%d}",
        "processor": models[0] if models else platform.processor(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gib": round(memory_kb / 2**20, 1),
        "load": round(os.getloadavg()[0], 1),
        "python": platform.python_version(),
    }
