"""A run finishes every exposure that can be done, whatever happens to processes and the store."""

from __future__ import annotations

import errno
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from daemon.mission.transfer.object_store import ObjectStoreUnavailableError
from daemon.postflight.batch import batch_run, local_processes
from daemon.postflight.batch.batch_run import BatchOutcome, run_batch
from daemon.postflight.batch.capacity import plan_processes
from daemon.postflight.batch.executor import (
    BatchExecutor,
    BatchTask,
    BatchWork,
    LossKind,
    TaskDone,
    TaskLost,
    TaskOutcome,
    is_out_of_memory,
)
from daemon.postflight.batch.in_process import InProcessExecutor
from daemon.postflight.batch.local_processes import LocalProcessExecutor
from tests.daemon.postflight.batch.toy_work import ToyAction, ToyWork, attempts_of

EXECUTORS: dict[str, Callable[[], BatchExecutor]] = {
    "in process": lambda: InProcessExecutor(2),
    "local processes": lambda: LocalProcessExecutor(2),
}


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch_run, "STORE_RETRIES_S", (0.01, 0.01, 0.01))
    monkeypatch.setattr(batch_run, "CLAIM_RETRY_S", 0.01)


def ran(executor: BatchExecutor, folder: Path, payloads: dict[int, str], count: int = 6):
    tasks = [BatchTask(number, payloads.get(number, "")) for number in range(1, count + 1)]
    return run_batch(executor, ToyWork(folder), tasks)


def causes(outcome: BatchOutcome) -> dict[int, str]:
    return {failure.exposure: failure.cause for failure in outcome.failures}


@pytest.mark.parametrize("kind", EXECUTORS)
def test_what_passes_is_tried_again_and_what_does_not_is_listed(kind: str, tmp_path: Path) -> None:
    payloads = {2: "bad 9", 3: "store 3", 4: "claimed 5", 5: "store 9"}
    outcome = ran(EXECUTORS[kind](), tmp_path, payloads)
    assert outcome.results == {1: 10, 3: 30, 4: 40, 6: 60}
    assert causes(outcome) == {2: "ValueError: frame 3 is damaged", 5: "Connection timed out"}
    assert [attempts_of(tmp_path, number) for number in range(1, 7)] == [1, 1, 4, 6, 4, 1]
    assert (outcome.counts.store_retries, outcome.counts.claimed_elsewhere) == (6, 5)
    assert not outcome.is_interrupted


@pytest.mark.parametrize("kind", EXECUTORS)
def test_a_full_disk_ends_the_run(kind: str, tmp_path: Path) -> None:
    # The last one is not reached before the first has failed, however late that thread gets a core.
    slow = dict.fromkeys(range(2, 41), "slow")
    outcome = ran(EXECUTORS[kind](), tmp_path, slow | {1: "full 9"}, count=40)
    found = causes(outcome)
    cure = "Free space on the disk, and run the same command again"
    assert found[1] == f"No space left on device. {cure}"
    assert found[40] == "not attempted, because of exposure 1: No space left on device"
    assert len(found) + len(outcome.results) == 40


@pytest.mark.parametrize("kind", EXECUTORS)
def test_work_that_cannot_be_opened_is_refused(kind: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no such calibration"):
        run_batch(EXECUTORS[kind](), ToyWork(tmp_path, refuses=True), [BatchTask(1)])
    assert not list(tmp_path.iterdir())


@pytest.mark.trust
def test_killed_processes_cost_their_own_exposure_one_more_attempt(tmp_path: Path) -> None:
    payloads = {2: "killed 1", 3: "killed 2", 4: "killed 9", 5: "memory 1", 6: "memory 9"}
    outcome = ran(LocalProcessExecutor(2), tmp_path, payloads | {7: "status 1"}, count=12)
    assert sorted(outcome.results) == [1, 2, 3, 5, 7, 8, 9, 10, 11, 12]
    found = causes(outcome)
    assert "quarantined after 3 attempts: its process was killed by SIGKILL" in found[4]
    assert (
        "the last time with no other exposure in work" in found[4] and "--processes 0" in found[4]
    )
    assert "quarantined after 2 attempts: out of memory: the process could not" in found[6]
    attempts = [attempts_of(tmp_path, number) for number in range(1, 13)]
    assert attempts == [1, 2, 3, 3, 2, 2, 2, 1, 1, 1, 1, 1]
    assert outcome.counts.lost_processes == 1 + 2 + 3 + 1
    assert outcome.counts.memory_retries == 1 + 1


@pytest.mark.trust
@pytest.mark.parametrize("kind", EXECUTORS)
def test_what_finds_no_memory_next_to_another_exposure_is_computed_alone(
    kind: str, tmp_path: Path
) -> None:
    payloads = {2: "memory 1", 3: "chained 1", 4: "memory 9", 5: "chained 9"}
    outcome = ran(EXECUTORS[kind](), tmp_path, payloads)
    assert outcome.results == {1: 10, 2: 20, 3: 30, 6: 60}
    alone = ", the last time with no other exposure in work; give fewer --processes"
    found = causes(outcome)
    memory = "quarantined after 2 attempts: out of memory: the process could not allocate it"
    assert found[4].startswith(f"{memory}{alone}")
    assert found[5].startswith(f"{memory} (SU00.tif cannot be read){alone}")
    assert [attempts_of(tmp_path, number) for number in (2, 3, 4, 5)] == [2, 2, 2, 2]
    assert (outcome.counts.lost_processes, outcome.counts.memory_retries) == (0, 4)


def test_what_libraries_state_of_exhausted_memory_is_recognized() -> None:
    import cv2

    opencv = cv2.error("Failed to allocate 5 bytes")
    opencv.code = cv2.Error.StsNoMem  # type: ignore[attr-defined]  # set in C
    assert is_out_of_memory(opencv) and is_out_of_memory(OSError(errno.ENOMEM, "x"))
    other = cv2.error("Assertion failed")
    other.code = cv2.Error.StsAssert  # type: ignore[attr-defined]  # set in C
    assert not is_out_of_memory(other) and not is_out_of_memory(OSError(errno.ENOSPC, "x"))


class OneProcess:
    """One process with two tasks in work, both of which end with it: as a worker of a cluster."""

    capacity, description = 2, "one process"

    def __init__(self, kind: LossKind) -> None:
        self._kind, self._in_work, self._ended = kind, list[BatchTask](), 0

    def start(self, work: BatchWork) -> None:
        """Nothing is opened."""

    def submit(self, task: BatchTask) -> None:
        self._in_work.append(task)

    def wait(self, timeout_s: float) -> list[TaskOutcome]:
        tasks, self._in_work = self._in_work, []
        if not any(task.payload for task in tasks):
            return [TaskDone(task.number, task.number * 10) for task in tasks]
        self._ended += 1
        return [TaskLost(one.number, self._kind, "it ended", str(self._ended)) for one in tasks]

    def close(self, timeout_s: float) -> list[TaskOutcome]:
        return []


@pytest.mark.trust
@pytest.mark.parametrize(("kind", "most"), [("killed", 3), ("out-of-memory", 2)])
def test_an_exposure_that_shared_the_process_of_a_poisonous_one_is_computed(
    kind: LossKind, most: int, tmp_path: Path
) -> None:
    for poisonous in range(1, 6):
        tasks = [BatchTask(n, "poison" if n == poisonous else "") for n in range(1, 6)]
        outcome = run_batch(OneProcess(kind), ToyWork(tmp_path), tasks)
        assert outcome.results == {n: 10 * n for n in range(1, 6) if n != poisonous}
        assert [failure.exposure for failure in outcome.failures] == [poisonous]
        assert causes(outcome)[poisonous].startswith(f"quarantined after {most} attempts: it ended")
        assert outcome.counts.lost_processes == most


def test_ctrl_c_lets_what_is_in_work_finish_and_begins_nothing_more(tmp_path: Path) -> None:
    def interrupt(_counts: object) -> None:
        raise KeyboardInterrupt

    tasks = [BatchTask(1), *(BatchTask(number, "slow") for number in range(2, 30))]
    outcome = run_batch(LocalProcessExecutor(2), ToyWork(tmp_path), tasks, interrupt)
    assert outcome.is_interrupted and 1 in outcome.results
    begun = {int(path.name) for path in tmp_path.iterdir()}
    assert begun == set(outcome.results) and len(begun) < 6


def test_a_process_that_loads_the_work_is_ended_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    executor, calls = LocalProcessExecutor(1), list[float]()
    receive = executor._receive

    def interrupted(timeout_s: float) -> None:
        calls.append(timeout_s)
        if len(calls) == 1:
            raise KeyboardInterrupt
        receive(timeout_s)

    monkeypatch.setattr(executor, "_receive", interrupted)
    begun_s = time.monotonic()
    outcome = run_batch(executor, ToyWork(tmp_path, open_s=60.0), [BatchTask(1)])
    assert outcome.is_interrupted and executor.pids == ()
    assert time.monotonic() - begun_s < 4.0


def test_all_threads_in_work_have_one_time_to_finish() -> None:
    class Busy:
        def join(self, timeout_s: float) -> None:
            waits.append(timeout_s)
            time.sleep(0.05)

    executor, waits = InProcessExecutor(2), list[float]()
    executor._threads = [Busy(), Busy()]  # type: ignore[list-item]  # only what is used
    executor.close(10.0)
    assert waits[1] <= waits[0] - 0.05 < 10.0


@pytest.mark.parametrize(
    ("cores", "available_gb", "tasks", "threads", "expected"),
    [
        (64, 128.0, 1000, None, (51, 1)),
        (64, 512.0, 1000, None, (64, 1)),
        (8, 5.0, 1000, None, (2, 4)),
        (8, 0.5, 1000, None, (1, 8)),
        (8, 64.0, 3, None, (3, 2)),
        (8, 64.0, 1000, 4, (2, 4)),
    ],
)
def test_processes_are_limited_by_cores_memory_and_exposures(
    cores: int,
    available_gb: float,
    tasks: int,
    threads: int | None,
    expected: tuple[int, int],
) -> None:
    available_nbytes = int(available_gb * 1e9)
    plan = plan_processes(
        2_000_000_000, tasks, cores=cores, available_nbytes=available_nbytes, threads=threads
    )
    assert (plan.processes, plan.threads) == expected


KERNEL = """
from numba import njit

@njit(cache=True)
def doubled(x):
    return 2.0 * x
"""


@dataclass(frozen=True)
class CompilingWork(ToyWork):
    """Calls a kernel when it is opened, and notes which process did."""

    def open(self) -> ToyAction:
        sys.path.insert(0, str(self.attempts))
        module = import_module("kernel_of_a_test")
        assert module.doubled(1.5) == 3.0
        with (self.attempts / "opened").open("a") as opened:
            opened.write(f"{os.getpid()}\n")
        return super().open()


def test_a_process_that_compiled_kernels_computes_nothing(tmp_path: Path) -> None:
    (tmp_path / "kernel_of_a_test.py").write_text(KERNEL)
    executor = LocalProcessExecutor(1)
    executor.start(CompilingWork(tmp_path))
    first, second = (int(line) for line in (tmp_path / "opened").read_text().split())
    assert first != second and executor.pids == (second,)
    executor.close(5.0)
    executor = LocalProcessExecutor(1)
    executor.start(CompilingWork(tmp_path))
    assert executor.pids == (int((tmp_path / "opened").read_text().split()[-1]),)
    assert len((tmp_path / "opened").read_text().split()) == 3
    executor.close(5.0)


@dataclass(frozen=True)
class ReopenedWork(ToyWork):
    """Opens as often as stated; then its store does not answer for so many times."""

    opens: int = 1
    refusals: int = 0
    is_passing: bool = True

    def open(self) -> ToyAction:
        file = self.attempts / "opens"
        with file.open("ab") as opens:
            opens.write(b".")
        if self.opens < file.stat().st_size <= self.opens + self.refusals:
            raise ObjectStoreUnavailableError("no answer") if self.is_passing else ValueError("rig")
        return super().open()


def reopened(folder: Path, count: int, **work: Any) -> BatchOutcome:
    tasks = [BatchTask(number, "killed 1" if number == 2 else "") for number in range(1, 6)]
    return run_batch(LocalProcessExecutor(count), ReopenedWork(folder, **work), tasks)


@pytest.fixture
def reopens_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local_processes, "REOPEN_DELAYS_S", (0.1, 0.1, 0.1))


@pytest.mark.trust
def test_a_store_that_does_not_answer_a_replacement_process_does_not_end_the_run(
    tmp_path: Path, reopens_soon: None
) -> None:
    outcome = reopened(tmp_path, 1, refusals=3)
    assert sorted(outcome.results) == [1, 2, 3, 4, 5] and not outcome.failures
    assert attempts_of(tmp_path, "opens") == 1 + 3 + 1


@pytest.mark.trust
@pytest.mark.parametrize(
    ("refusals", "is_passing", "sentence"),
    [(99, True, "after 4 attempts: no answer"), (99, False, "cannot load the work: ValueError")],
)
def test_work_that_no_later_process_can_load_leaves_results_and_failures(
    tmp_path: Path, reopens_soon: None, refusals: int, is_passing: bool, sentence: str
) -> None:
    outcome = reopened(tmp_path, 1, refusals=refusals, is_passing=is_passing)
    assert outcome.results == {1: 10}
    found = causes(outcome)
    assert sorted(found) == [2, 3, 4, 5] and outcome.counts.failed == 4
    assert all(cause.startswith("not computed: ") and sentence in cause for cause in found.values())


@pytest.mark.trust
def test_a_process_that_cannot_load_the_work_leaves_it_to_the_others(
    tmp_path: Path, reopens_soon: None
) -> None:
    tasks = [BatchTask(number, "slow") for number in range(1, 9)]
    outcome = run_batch(LocalProcessExecutor(2), ReopenedWork(tmp_path, refusals=99), tasks)
    assert len(outcome.results) == 8 and not outcome.failures
    assert attempts_of(tmp_path, "opens") > 2
