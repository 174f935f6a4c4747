"""Wall-clock limits that hold on a busy machine as well.

A limit of a device or a process is asserted on the time that passed less the time for which the
machine withheld its cores: the kernel counts for each thread how long it was ready to run and did
not run. On an idle machine that is close to zero and the limit holds as it is written.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

CALIBRATION_S = 0.2


@dataclass(frozen=True)
class Scheduled:
    """How long a thread ran and how long it waited for a core since it began, ns."""

    run_ns: int = 0
    waited_ns: int = 0


class Stopwatch:
    """Measures from its creation on; covers this process and the processes it started."""

    def __init__(self) -> None:
        self._begun_s = time.monotonic()
        self._before = _scheduled()
        self._last: dict[str, Scheduled] = {}

    @property
    def elapsed_s(self) -> float:
        """Seconds of wall time."""
        return time.monotonic() - self._begun_s

    @property
    def withheld_s(self) -> float:
        """Seconds by which waiting for a core may have delayed a result.

        A result passes through one thread after another: at least the longest wait of one thread
        counts. The waits of all threads count together as far as they fit into the share of the
        wall time in which a thread that is ready has no core. Threads that ended count up to the
        last reading; zero where the kernel does not count.
        """
        self._last |= _scheduled()
        elapsed_ns = self.elapsed_s * 1e9
        none = Scheduled()
        before = {task: self._before.get(task, none) for task in self._last}
        waits = [now.waited_ns - before[task].waited_ns for task, now in self._last.items()]
        ran_ns = sum(now.run_ns - before[task].run_ns for task, now in self._last.items())
        together_ns = sum(waits)
        share = together_ns / max(1, ran_ns + together_ns)
        return max(0, *waits, min(together_ns, elapsed_ns * share)) * 1e-9

    @property
    def own_s(self) -> float:
        """Seconds of wall time that the machine did not withhold; not negative."""
        return max(0.0, self.elapsed_s - self.withheld_s)

    def is_within(self, limit_s: float) -> bool:
        """Whether less than the limit has passed, on a machine with idle cores."""
        return self.elapsed_s < limit_s or self.own_s < limit_s


def slowdown() -> float:
    """How many times longer a computation takes now than it computes; 1.0 on an idle machine."""
    begun_s, begun_cpu_s = time.monotonic(), time.thread_time()
    while time.thread_time() - begun_cpu_s < CALIBRATION_S:
        pass
    return max(1.0, (time.monotonic() - begun_s) / CALIBRATION_S)


def _scheduled() -> dict[str, Scheduled]:
    """Every thread by its path in /proc.

    Source: Documentation/scheduler/sched-stats.rst of the kernel, /proc/<pid>/schedstat.
    """
    found = {}
    for task in _threads():
        with suppress(OSError, ValueError):
            run_ns, waited_ns, _ = (task / "schedstat").read_text("ascii").split()
            found[str(task)] = Scheduled(int(run_ns), int(waited_ns))
    return found


def _threads() -> Iterator[Path]:
    """The threads of this process and of its living descendants, in /proc."""
    for process in _family(os.getpid()):
        with suppress(OSError):
            yield from Path(f"/proc/{process}/task").iterdir()


def _family(process: int) -> Iterator[int]:
    """A process and its living descendants."""
    yield process
    with suppress(OSError):
        for task in Path(f"/proc/{process}/task").iterdir():
            for child in (task / "children").read_text("ascii").split():
                yield from _family(int(child))
