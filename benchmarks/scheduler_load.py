"""`python -m benchmarks.scheduler_load`: what a scheduler and the command cost for each exposure.

A scheduler of dask runs in a process of its own, and so many simulated workers in another: their
tasks sleep as long as an exposure takes. The command's own executor submits them. CPU time is that
of the processes, so that a busy machine does not change it much.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import multiprocessing
import os
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import distributed

from daemon.cli.benchmark.measurement import machine
from daemon.postflight.batch.batch_run import run_batch
from daemon.postflight.batch.cluster_address import ClusterAddress
from daemon.postflight.batch.dask_executor import DaskExecutor
from daemon.postflight.batch.executor import BatchTask

PORT = 18_791
URL = f"tcp://127.0.0.1:{PORT}"
PAYLOAD_NBYTES = 400
"""Key and overlaps of an exposure, as `syntopic process` sends them."""


@dataclass(frozen=True)
class SleepingWork:
    """Work whose tasks sleep."""

    seconds: float
    threads: int = 1
    memory_nbytes: int = 1

    def open(self) -> SleepingAction:
        return SleepingAction(self.seconds)


class SleepingAction:
    """Sleeps, and returns a report as long as a short quality report."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds

    def clone(self) -> SleepingAction:
        return SleepingAction(self._seconds)

    def __call__(self, task: BatchTask) -> dict[str, Any]:
        time.sleep(self._seconds)
        return {"exposure": task.number, "report": "x" * 2000}


def simulated_workers(count: int) -> None:
    """So many workers in this process, until it is ended."""
    logging.getLogger("distributed").setLevel(logging.CRITICAL)

    async def serve() -> None:
        workers = [
            distributed.Worker(
                URL, nthreads=1, memory_limit=10**9, host="127.0.0.1", dashboard=False
            )
            for _ in range(count)
        ]
        await asyncio.gather(*workers)
        await asyncio.gather(*(worker.finished() for worker in workers))

    asyncio.run(serve())


def cpu_s(pid: int) -> float:
    """CPU seconds of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measured(tasks: int, seconds: float, workers: int, scheduler_pid: int) -> dict[str, Any]:
    """Figures of one run."""
    own_s = resource.getrusage(resource.RUSAGE_SELF)
    before_s, begun_s = cpu_s(scheduler_pid), time.monotonic()
    payload = "x" * PAYLOAD_NBYTES
    outcome = run_batch(
        DaskExecutor(ClusterAddress(URL)),
        SleepingWork(seconds),
        [BatchTask(number, payload) for number in range(1, tasks + 1)],
    )
    wall_s, used_s = time.monotonic() - begun_s, resource.getrusage(resource.RUSAGE_SELF)
    assert len(outcome.results) == tasks, outcome.failures[:3]
    ideal_s = tasks * seconds / workers
    client_s = used_s.ru_utime + used_s.ru_stime - own_s.ru_utime - own_s.ru_stime
    return {
        "tasks": tasks,
        "task_s": seconds,
        "wall_s": round(wall_s, 2),
        "tasks_per_s": round(tasks / wall_s, 1),
        "busy_share": round(ideal_s / wall_s, 3),
        "scheduler_cpu_ms_per_task": round(1e3 * (cpu_s(scheduler_pid) - before_s) / tasks, 2),
        "command_cpu_ms_per_task": round(1e3 * client_s / tasks, 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.scheduler_load", description=__doc__
    )
    parser.add_argument("--workers", type=int, default=100)
    parser.add_argument("--tasks", type=int, default=1500)
    parser.add_argument(
        "--seconds", type=float, nargs="+", default=[2.0, 0.5, 0.05], help="of a task"
    )
    options = parser.parse_args()
    dask = Path(sys.executable).with_name("dask")
    scheduler = subprocess.Popen(
        [str(dask), "scheduler", "--host", "127.0.0.1", "--port", str(PORT), "--no-dashboard"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | {"PYTHONPATH": str(Path.cwd())},
    )
    spawn = multiprocessing.get_context("spawn")
    workers = spawn.Process(target=simulated_workers, args=(options.workers,), daemon=True)
    workers.start()
    try:
        with distributed.Client(URL, timeout=60, set_as_default=False) as client:
            client.wait_for_workers(options.workers, timeout=300)
        runs = [
            measured(options.tasks, seconds, options.workers, scheduler.pid)
            for seconds in options.seconds
        ]
        status = Path(f"/proc/{scheduler.pid}/status").read_text()
        peak_kib = int(status.partition("VmHWM:")[2].split()[0])
    finally:
        workers.kill()
        scheduler.kill()
        scheduler.wait()
    output = {
        "machine": machine(),
        "load": os.getloadavg()[0],
        "workers": options.workers,
        "runs": runs,
        "scheduler_peak_mib": round(peak_kib / 1024),
    }
    print(json.dumps(output))


if __name__ == "__main__":
    main()
