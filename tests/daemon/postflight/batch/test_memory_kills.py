"""A process that the kernel ended for memory is named so, also on another machine."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import pytest

from daemon.postflight.batch import memory_kills
from daemon.postflight.batch.batch_run import OUT_OF_MEMORY_MAX, run_batch
from daemon.postflight.batch.cluster_address import cluster_address
from daemon.postflight.batch.dask_executor import DaskExecutor
from daemon.postflight.batch.executor import BatchTask, TaskLost
from daemon.postflight.batch.local_processes import LocalProcessExecutor
from daemon.postflight.batch.memory_kills import ClusterLosses
from tests.daemon.diverging_camera import ROOT
from tests.daemon.postflight.batch.test_cluster import free_port, wait_until_open
from tests.daemon.postflight.batch.toy_work import ToyWork, attempts_of, memory_groups

A1, A2, A3, B1 = "tcp://10.0.0.1:1", "tcp://10.0.0.1:2", "tcp://10.0.0.1:3", "tcp://10.0.0.2:1"


def client_of(counts: dict[str, int], silent: tuple[str, ...] = ()) -> Any:
    """A client; `counts` are those of the machines."""

    def run(_function: object, workers: list[str], on_error: str) -> dict[str, int]:
        assert on_error == "ignore"
        asked = [one for one in workers if one not in silent]
        return {one: counts[urlsplit(one).hostname or ""] for one in asked}

    return SimpleNamespace(run=run)


def lost(number: int, worker: str) -> TaskLost:
    return TaskLost(number, "killed", f"its process was killed ({worker})", worker)


def kinds(found: list[TaskLost]) -> list[tuple[int, str]]:
    return [(one.number, one.kind) for one in found]


def test_the_count_of_the_machine_decides_and_each_rise_explains_one_worker() -> None:
    counts = {"10.0.0.1": 7, "10.0.0.2": 0}
    client, losses = client_of(counts), ClusterLosses()
    losses.note(client, [A1, A2, B1])
    losses.add(lost(1, A1))
    losses.add(lost(2, A1))  # two tasks of one worker
    losses.add(lost(3, A2))
    losses.add(lost(4, B1))
    counts["10.0.0.1"] = 8
    found = losses.decided(client, [A3, "tcp://10.0.0.2:9"])
    assert kinds(found) == [
        (1, "out-of-memory"), (2, "out-of-memory"), (3, "killed"), (4, "killed"),
    ]  # fmt: skip
    assert found[0].cause == f"the kernel killed its process: out of memory ({A1})"
    losses.add(lost(5, A3))
    assert kinds(losses.decided(client, [A2])) == [(5, "killed")]  # the rise was of another one
    assert losses.decided(client, [A2]) == []


def test_without_a_worker_of_that_machine_the_answer_is_awaited_and_then_given_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    counts = {"10.0.0.1": 0, "10.0.0.2": 0}
    client, losses = client_of(counts), ClusterLosses()
    losses.note(client, [A1, B1])
    counts["10.0.0.1"] = counts["10.0.0.2"] = 1
    losses.add(lost(1, A1))
    assert losses.decided(client, [B1]) == []  # another machine knows nothing of it
    assert losses.decided(client, [A1, B1]) == []  # the one that is gone is not asked
    assert losses.decided(client_of(counts, silent=(A2,)), [A2]) == []
    assert kinds(losses.decided(client, [A2, B1])) == [(1, "out-of-memory")]
    monkeypatch.setattr(memory_kills, "ANSWER_TIMEOUT_S", 0.0)
    losses.add(lost(2, B1))
    assert kinds(losses.decided(client, [A2])) == [(2, "killed")]


def test_a_machine_that_joined_unnoted_is_not_accused() -> None:
    client, losses = client_of({"10.0.0.1": 9}), ClusterLosses()
    losses.add(lost(1, A1))
    assert kinds(losses.decided(client, [A2])) == [(1, "killed")]


needs_groups = pytest.mark.skipif(
    memory_groups() is None, reason="control groups of memory need root"
)


@needs_groups
@pytest.mark.timeout(120)
def test_a_process_that_outgrows_its_memory_is_named_on_this_machine(tmp_path: Path) -> None:
    tasks = [BatchTask(1), BatchTask(2, "kernel 99"), BatchTask(3)]
    check_named(run_batch(LocalProcessExecutor(2), ToyWork(tmp_path), tasks), tmp_path)


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A scheduler and one worker of `syntopic worker`."""
    log_file = tmp_path_factory.mktemp("cluster") / "cluster.txt"
    url = f"tcp://127.0.0.1:{free_port()}"
    dask = [str(Path(sys.executable).with_name("dask")), "scheduler", "--host", "127.0.0.1"]
    dask += ["--port", url.rpartition(":")[2], "--dashboard-address", "127.0.0.1:0"]
    own = [sys.executable, "-m", "daemon", "worker", url, "--processes", "1"]
    with log_file.open("wb") as log:
        parts = [
            subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log) for command in (dask, own)
        ]
    wait_until_open(url, parts[0])
    yield url
    parts[1].send_signal(signal.SIGINT)
    parts[1].wait(60)
    parts[0].kill()
    parts[0].wait()


@needs_groups
@pytest.mark.timeout(240)
def test_the_only_worker_of_a_cluster_that_outgrows_its_memory_is_named(
    scheduler: str, tmp_path: Path
) -> None:
    attempts = tmp_path / "attempts"
    attempts.mkdir()
    tasks = [BatchTask(1), BatchTask(2, "kernel 99"), BatchTask(3)]
    executor = DaskExecutor(cluster_address(scheduler, None, None, None))
    began_s = time.monotonic()
    check_named(run_batch(executor, ToyWork(attempts), tasks), attempts)
    assert time.monotonic() - began_s < 150


@pytest.mark.trust
@pytest.mark.timeout(240)
def test_a_result_that_ended_with_its_worker_before_it_was_fetched_is_computed_again(
    scheduler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fetched, real = list[int](), DaskExecutor._outcome

    def late(self: DaskExecutor, number: int, future: Any) -> Any:
        if number == 1 and not fetched:
            limit_s = time.monotonic() + 60
            while not (tmp_path / "2").exists():
                assert time.monotonic() < limit_s
                time.sleep(0.05)  # until the worker has begun the task that ends it
            time.sleep(0.5)
            fetched.append(number)
        return real(self, number, future)

    monkeypatch.setattr(DaskExecutor, "_outcome", late)
    tasks = [BatchTask(1), BatchTask(2, "killed 1"), BatchTask(3)]
    executor = DaskExecutor(cluster_address(scheduler, None, None, None))
    outcome = run_batch(executor, ToyWork(tmp_path), tasks)
    assert outcome.results == {1: 10, 2: 20, 3: 30} and outcome.failures == []
    assert attempts_of(tmp_path, 1) == 2 and fetched == [1]


def check_named(outcome: Any, attempts: Path) -> None:
    assert outcome.results == {1: 10, 3: 30}
    (failure,) = outcome.failures
    assert failure.exposure == 2
    assert f"quarantined after {OUT_OF_MEMORY_MAX} attempts: the kernel killed" in failure.cause
    assert "out of memory" in failure.cause and "fewer --processes" in failure.cause
    assert attempts_of(attempts, 2) == OUT_OF_MEMORY_MAX
    for group in (memory_groups() or Path()).glob("syntopic-test-*"):
        group.rmdir()
