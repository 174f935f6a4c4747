"""`syntopic worker`: processes that join the scheduler of a cluster.

A process ends when its scheduler is gone, and is started again until the scheduler is back. What
it computed is committed whether or not a scheduler is there to receive it.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from typing import Any, Final

from daemon.postflight.batch.cluster_address import ClusterAddress
from daemon.products.processing_threads import configure_threads, thread_counts

JOIN_TIMEOUT_S: Final = 30.0
RESTART_DELAY_S: Final = 0.5
FINISH_TIMEOUT_S: Final = 30.0
SETTINGS: Final = {
    # Results are small; the memory of an exposure is freed by its own pipeline.
    **{f"distributed.worker.memory.{name}": False for name in ("target", "spill", "pause")},
    "distributed.worker.memory.terminate": False,
    # Both wake the process 50 to 200 times a second to draw diagrams of it.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
}
"""Settings of dask in a worker process."""

_SPAWN = multiprocessing.get_context("spawn")


def run_workers(
    address: ClusterAddress,
    processes: int,
    memory_nbytes: int,
    *,
    threads: int,
    away_timeout_s: float,
    report: Callable[[str], None],
) -> None:
    """Keep worker processes running until Ctrl-C.

    Args:
        address: of the scheduler.
        processes: number of workers.
        memory_nbytes: that each declares.
        threads: of the kernels of each.
        away_timeout_s: how long no worker may reach the scheduler.
        report: takes a sentence.

    Raises:
        TimeoutError: no worker reached the scheduler for so long.
    """
    environment = thread_counts(threads)
    os.environ.update(environment)
    joined = _SPAWN.Value("d", time.monotonic())
    running: list[BaseProcess | None] = [None] * processes
    ended_s = [0.0] * processes
    try:
        while True:
            for index, process in enumerate(running):
                if process is not None and not process.is_alive():
                    process.join()
                    if process.exitcode:
                        report(f"worker {index} ended with status {process.exitcode}; restarting")
                    running[index], ended_s[index] = None, time.monotonic()
                elif process is None and time.monotonic() - ended_s[index] > RESTART_DELAY_S:
                    running[index] = _begun(address, memory_nbytes, joined)
            if time.monotonic() - joined.value > away_timeout_s:
                raise TimeoutError
            time.sleep(0.1)
    finally:
        _end([process for process in running if process is not None])


def _begun(address: ClusterAddress, memory_nbytes: int, joined: Any) -> BaseProcess:
    process = _SPAWN.Process(
        target=worker_main, args=(address, memory_nbytes, joined, os.getpid()), daemon=True
    )
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    return process


def _end(running: list[BaseProcess]) -> None:
    """Exposures in work may finish; then the processes are killed."""
    limit_s = time.monotonic() + FINISH_TIMEOUT_S
    for process in running:
        process.terminate()
    for process in running:
        process.join(max(0.0, limit_s - time.monotonic()))
        if process.is_alive():
            process.kill()
            process.join()


def worker_main(address: ClusterAddress, memory_nbytes: int, joined: Any, parent_pid: int) -> None:
    """One worker, until its scheduler or its parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    configure_threads()
    asyncio.run(_serve(address, memory_nbytes, joined, parent_pid))


async def _serve(address: ClusterAddress, memory_nbytes: int, joined: Any, parent_pid: int) -> None:
    import logging

    import dask
    import distributed

    from daemon.postflight.batch.dask_executor import security_of

    # The parent reports what ends; a worker's own messages repeat it.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    dask.config.set(SETTINGS)
    stopping = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stopping.set)
    worker = distributed.Worker(
        address.url,
        nthreads=1,
        memory_limit=memory_nbytes,
        security=security_of(address, "worker"),
        host="127.0.0.1" if address.is_loopback else None,
        dashboard_address="127.0.0.1:0",
        death_timeout=JOIN_TIMEOUT_S,
    )
    try:
        await worker
    except (OSError, TimeoutError):
        await worker.close(timeout=1.0)
        return
    while not stopping.is_set() and worker.status is distributed.Status.running:
        joined.value = time.monotonic()
        if os.getppid() != parent_pid:
            break
        await asyncio.sleep(0.2)
    await worker.close(timeout=FINISH_TIMEOUT_S, executor_wait=True)
