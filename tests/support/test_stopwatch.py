"""Time that the machine withheld is not held against a limit; time that was slept or used is."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.support.stopwatch import Stopwatch

BUSY = [sys.executable, "-c", "while True: pass"]
COMPETITORS = 4

needs_counts = pytest.mark.skipif(
    not Path("/proc/self/schedstat").exists(), reason="this kernel does not count waiting threads"
)


@contextmanager
def one_contested_core() -> Iterator[None]:
    """This thread and busy loops share one core."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    loops = [subprocess.Popen(BUSY) for _ in range(COMPETITORS)]
    try:
        time.sleep(0.3)
        yield
    finally:
        os.sched_setaffinity(0, before)
        for loop in loops:
            loop.kill()
            loop.wait(10)


def compute(cpu_s: float) -> None:
    begun_s = time.thread_time()
    while time.thread_time() - begun_s < cpu_s:
        pass


@needs_counts
def test_time_for_which_a_core_was_withheld_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    # Threads that other tests left behind wait for cores, too.
    own = Path(f"/proc/{os.getpid()}/task/{threading.get_native_id()}")
    monkeypatch.setattr("tests.support.stopwatch._threads", lambda: iter([own]))
    with one_contested_core():
        watch = Stopwatch()
        compute(0.2)
        assert watch.elapsed_s > 0.3
        assert 0.15 < watch.own_s < 0.27
        assert watch.is_within(0.3) and not watch.is_within(0.15)


def test_time_that_a_test_sleeps_counts() -> None:
    watch = Stopwatch()
    threading.Event().wait(0.4)
    assert watch.own_s > 0.2
    assert not watch.is_within(0.2)


@needs_counts
def test_processes_that_the_test_started_are_covered() -> None:
    watch = Stopwatch()
    with one_contested_core():
        withheld_s = watch.withheld_s
        assert withheld_s > 0.15, "four loops share a core for 0.3 s"
    assert watch.withheld_s >= withheld_s, "what ended is still counted"


@needs_counts
def test_waits_side_by_side_are_no_longer_than_the_time_that_passed() -> None:
    watch = Stopwatch()
    with one_contested_core():
        time.sleep(0.5)
        assert 0.0 < watch.withheld_s < watch.elapsed_s
        assert not watch.is_within(1e-3)
