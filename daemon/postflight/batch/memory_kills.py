"""Whether the kernel ended a process for memory, by its count: on this machine and on a cluster's.

A scheduler reports only that a worker is gone. Any worker of the same machine, also the one that
took its place, states the count; it is compared with the one at the beginning of the run.

Source: Linux kernel, /proc/vmstat, `oom_kill`: processes ended for memory since boot, of the whole
machine and of control groups.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from daemon.postflight.batch.executor import TaskLost

ANSWER_TIMEOUT_S: Final = 30.0
"""How long after a loss a worker of the same machine may take to join and state the count."""
CAUSE: Final = "the kernel killed its process: out of memory"


def memory_kills() -> int:
    """Processes that the kernel ended for memory since boot; 0 where it does not count them."""
    try:
        lines = Path("/proc/vmstat").read_text("ascii").splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("oom_kill ")), 0)


class ClusterLosses:
    """Lost tasks of a cluster, returned once it is known whether memory ended their worker."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}  # by machine, those of ended workers included
        self._ended: dict[str, bool] = {}  # by worker, whether it was for memory
        self._waiting: list[tuple[float, TaskLost]] = []

    def note(self, client: Any, workers: Iterable[str]) -> None:
        """Note the counts of machines that are not known.

        Args:
            client: of the cluster.
            workers: addresses of workers that are there.
        """
        unknown = {_machine(one): one for one in workers if _machine(one) not in self._counts}
        for worker, count in _kills_by_worker(client, unknown.values()).items():
            self._counts[_machine(worker)] = count

    def add(self, lost: TaskLost) -> None:
        """A task whose worker is gone; `decided` returns it.

        Args:
            lost: `process` is the address of the worker.
        """
        self._waiting.append((time.monotonic() + ANSWER_TIMEOUT_S, lost))

    def decided(self, client: Any, present: Iterable[str]) -> list[TaskLost]:
        """Losses whose cause is known, or will not be.

        Args:
            client: of the cluster.
            present: addresses of workers that are there.
        """
        if not self._waiting:
            return []
        machines = {_machine(lost.process) for _, lost in self._waiting}
        gone = {lost.process for _, lost in self._waiting}
        askable = {_machine(one): one for one in present if one not in gone}
        counts = {
            _machine(worker): count
            for worker, count in _kills_by_worker(
                client, [one for machine, one in askable.items() if machine in machines]
            ).items()
        }
        found, waiting = [], []
        for limit_s, lost in self._waiting:
            machine = _machine(lost.process)
            if machine in counts and lost.process not in self._ended:
                before = self._counts.setdefault(machine, counts[machine])
                self._ended[lost.process] = counts[machine] > before
                self._counts[machine] += self._ended[lost.process]
            if self._ended.get(lost.process):
                found.append(replace(lost, kind="out-of-memory", cause=f"{CAUSE} ({lost.process})"))
            elif lost.process in self._ended or time.monotonic() >= limit_s:
                found.append(lost)
            else:
                waiting.append((limit_s, lost))
        self._waiting = waiting
        return found


def _machine(worker: str) -> str:
    return urlsplit(worker).hostname or ""


def _kills_by_worker(client: Any, workers: Iterable[str]) -> dict[str, int]:
    """Counts by worker; one that does not answer is left out."""
    chosen = list(workers)
    if not chosen:
        return {}
    try:
        answers: dict[str, Any] = client.run(memory_kills, workers=chosen, on_error="ignore")
    except (OSError, TimeoutError, ValueError):
        return {}
    return {worker: count for worker, count in answers.items() if isinstance(count, int)}
