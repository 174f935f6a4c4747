"""The executor on a cluster: TLS, versions, dead workers, and what it leaves in workers."""

from __future__ import annotations

import pickle
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import distributed
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.transfer.object_store import ObjectStoreUnavailableError
from daemon.postflight.batch import dask_executor, dask_tasks
from daemon.postflight.batch.batch_run import LOSSES_MAX, run_batch
from daemon.postflight.batch.cluster_address import (
    ClusterAddress,
    certificate_problem,
    cluster_address,
)
from daemon.postflight.batch.cluster_checks import ClusterError, check_versions, unsuitable_workers
from daemon.postflight.batch.dask_executor import DaskExecutor
from daemon.postflight.batch.dask_tasks import WorkRefused, run_on_worker
from daemon.postflight.batch.executor import (
    BatchTask,
    DataAbsentError,
    TaskDone,
    TaskFailed,
    TaskLost,
)
from tests.daemon.diverging_camera import ROOT
from tests.daemon.postflight.batch.test_cluster import free_port, wait_until_open
from tests.daemon.postflight.batch.toy_work import ToyWork, attempts_of

LOCAL = cluster_address("tcp://127.0.0.1:1", None, None, None)


def _openssl(folder: Path, *arguments: str) -> None:
    subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)


def authority(folder: Path, name: str) -> tuple[Path, Path, Path]:
    """A certificate authority, and a certificate and key it signed."""
    folder.mkdir(parents=True, exist_ok=True)
    key = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    of_authority, own = ["-subj", f"/CN={name} authority"], ["-subj", f"/CN={name}"]
    _openssl(folder, "req", "-x509", *key, *of_authority, "-keyout", "ca.key", "-out", "ca.pem")
    _openssl(folder, "req", *key, *own, "-keyout", "own.key", "-out", "own.csr")
    _openssl(
        folder, "x509", "-req", "-in", "own.csr", "-CA", "ca.pem", "-CAkey", "ca.key",
        "-CAcreateserial", "-out", "own.pem",
    )  # fmt: skip
    return folder / "ca.pem", folder / "own.pem", folder / "own.key"


@pytest.fixture(scope="module")
def encrypted(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ClusterAddress]:
    """A scheduler with TLS and two workers of `syntopic worker`."""
    folder = tmp_path_factory.mktemp("tls")
    ca, certificate, key = authority(folder, "survey")
    address = cluster_address(f"tls://127.0.0.1:{free_port()}", ca, certificate, key)
    dask = [
        str(Path(sys.executable).with_name("dask")), "scheduler", "--host", "127.0.0.1",
        "--port", address.url.rpartition(":")[2], "--protocol", "tls", "--tls-ca-file", str(ca),
        "--tls-cert", str(certificate), "--tls-key", str(key),
        "--dashboard-address", "127.0.0.1:0",
    ]  # fmt: skip
    own = [
        sys.executable, "-m", "daemon", "worker", address.url, "--processes", "2", "--tls-ca",
        str(ca), "--tls-certificate", str(certificate), "--tls-key", str(key),
    ]  # fmt: skip
    with (folder / "cluster.txt").open("wb") as log:
        parts = [
            subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log) for command in (dask, own)
        ]
    wait_until_open(address.url, parts[0])
    yield address
    parts[1].send_signal(signal.SIGINT)
    parts[1].wait(60)
    parts[0].kill()
    parts[0].wait()


@pytest.mark.trust
@pytest.mark.timeout(300)
def test_over_tls_a_poisonous_exposure_ends_as_many_processes_as_stated(
    encrypted: ClusterAddress, tmp_path: Path
) -> None:
    sentences: list[str] = []
    executor = DaskExecutor(encrypted, announce=sentences.append)
    tasks = [BatchTask(n, "killed 99" if n == 3 else "") for n in range(1, 9)]
    outcome = run_batch(executor, ToyWork(tmp_path), tasks)
    assert sorted(outcome.results) == [1, 2, 4, 5, 6, 7, 8]
    (failure,) = outcome.failures
    assert failure.exposure == 3
    assert f"quarantined after {LOSSES_MAX} attempts: its process was killed" in failure.cause
    # A busy scheduler may lose it once and not state that its process ended; an exposure that
    # waited next to it may have it stated.
    attempts = attempts_of(tmp_path, 3)
    assert attempts in (LOSSES_MAX, LOSSES_MAX + 1)
    assert LOSSES_MAX <= outcome.counts.lost_processes <= attempts
    (sentence,) = sentences
    assert sentence.startswith(f"cluster at {encrypted.url}, ") and " threads; " in sentence
    assert "dashboard" in sentence


@pytest.mark.trust
@pytest.mark.timeout(120)
def test_a_certificate_of_another_authority_is_refused(
    encrypted: ClusterAddress, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dask_executor, "CONNECT_TIMEOUT_S", 3.0)
    address = cluster_address(encrypted.url, *authority(tmp_path / "other", "unknown"))
    with pytest.raises(ClusterError, match=r"certificate.*signed by the authority of --tls-ca"):
        DaskExecutor(address).start(ToyWork(tmp_path))
    tls = ["--tls-ca", address.ca, "--tls-certificate", address.certificate, "--tls-key"]
    done = CliRunner().invoke(app, ["worker", address.url, *map(str, [*tls, address.key])])
    assert "do not accept each other's certificate" in str(done.exception)
    assert certificate_problem(encrypted) == ""
    done = CliRunner().invoke(app, ["worker", address.url, *map(str, [*tls, encrypted.key])])
    assert "cannot be used together" in str(done.exception)


@pytest.mark.trust
@pytest.mark.timeout(120)
def test_workers_that_die_while_they_load_the_work_are_named(
    encrypted: ClusterAddress, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Opening:
        def result(self, timeout: float) -> object:
            raise distributed.KilledWorker("open", "tcp://a", 3)

    monkeypatch.setattr(distributed.Client, "submit", lambda *_args, **_options: Opening())
    executor = DaskExecutor(encrypted)
    try:
        with pytest.raises(ClusterError, match="died while they loaded the work"):
            executor.start(ToyWork(tmp_path))
    finally:
        executor.close(1.0)


def test_a_worker_without_the_data_is_set_aside_as_long_as_others_have_it(tmp_path: Path) -> None:
    absent = DataAbsentError("worker on b has no folder /m. Mount that of the command there.")
    for answers, is_open in (([WorkRefused(absent, "tcp://b"), None], True), ([None], True), (
        [WorkRefused(absent, "tcp://b"), WorkRefused(absent, "tcp://a")], False,
    ), ([WorkRefused(ValueError("no calibration"), "tcp://b"), None], False)):  # fmt: skip
        given, asked, sentences = iter(answers), list[Any](), list[str]()

        def submit(*_arguments: Any, pure: bool, workers: Any, given=given, asked=asked) -> Any:
            asked.append(workers)
            return SimpleNamespace(result=lambda timeout: next(given))

        executor = DaskExecutor(LOCAL, announce=sentences.append)
        executor._suitable = {"tcp://a": "", "tcp://b": ""}
        client = cast(Any, SimpleNamespace(submit=submit))
        if is_open:
            executor._open(client)
            assert asked == [None, ["tcp://a"]][: len(answers)]
            assert len(sentences) == len(answers) - 1
        else:
            refused = answers[0]
            assert isinstance(refused, WorkRefused)
            with pytest.raises(type(refused.error)):
                executor._open(client)


def client_with(**packages: str) -> Any:
    """A client of a scheduler and one worker, which has other versions."""
    own = {"dask": "1", "distributed": "2", "msgpack": "3", "cloudpickle": "4", "python": "3.11.7"}
    sides = {
        "client": {"packages": own},
        "scheduler": {"packages": own | {"python": "3.11.2.final.0"}},
        "workers": {"tcp://a": {"packages": own | packages}},
    }
    return SimpleNamespace(
        run_on_scheduler=lambda function, name: function(name),
        get_versions=lambda check: sides,
    )


def test_versions_that_do_not_match_are_refused_with_both() -> None:
    check_versions(client_with())
    for name, version, text in (
        ("distributed", "9", "worker tcp://a has distributed 9, this command 2"),
        ("python", "3.12.1", "worker tcp://a has python 3.12.1, this command 3.11.7"),
    ):
        with pytest.raises(ClusterError, match=f"{text}. Install the same versions"):
            check_versions(client_with(**{name: version}))
    client = client_with()
    client.run_on_scheduler = lambda _function, _name: "0.0.1"
    with pytest.raises(ClusterError, match=r"the scheduler has syntopic 0.0.1"):
        check_versions(client)


def test_a_run_without_workers_ends_with_what_it_waited_for() -> None:
    client = SimpleNamespace(
        status="running", nthreads=lambda: {"tcp://a": 1}, close=lambda timeout: None
    )
    executor = DaskExecutor(LOCAL, away_timeout_s=0.0)
    executor._client = cast(Any, client)
    assert executor.wait(0.0) == [] and executor.capacity == 2
    client.nthreads = dict
    executor._counted_s = 0.0
    with pytest.raises(ClusterError, match=r"all workers left tcp://127.0.0.1:1.*within 0 s"):
        executor.wait(0.0)
    assert executor.capacity == 0


def test_a_worker_has_only_the_last_works_open(tmp_path: Path) -> None:
    works = [pickle.dumps(ToyWork(tmp_path, threads=n)) for n in (1, 2, 3)]
    dask_tasks._actions.clear()
    for work in works:
        for _ in range(2):
            assert isinstance(run_on_worker(work, BatchTask(1)), TaskDone)
    assert len(dask_tasks._actions) == dask_tasks.WORKS_MAX


def test_processes_of_this_machine_do_not_go_with_a_cluster(tmp_path: Path) -> None:
    command = ["process", str(tmp_path), "--scheduler", "tcp://127.0.0.1:1", "--processes", "999"]
    done = CliRunner().invoke(app, command)
    assert done.exit_code != 0
    assert "Leave it out, and give it to: syntopic worker" in f"{done.output} {done.exception}"


def joining_client(**about: Any) -> Any:
    """A client whose cluster gets a second worker; `about` is that worker's description."""
    own = {"dask": "1", "distributed": "2", "msgpack": "3", "cloudpickle": "4", "python": "3.11.7"}
    packages = own | about.pop("packages", {})
    workers = {
        "tcp://good": {"nthreads": 1, "memory_limit": 10_000},
        "tcp://late": {"nthreads": 1, "memory_limit": 10_000} | about,
    }
    return SimpleNamespace(
        status="running",
        nthreads=lambda: dict.fromkeys(workers, 1),
        run=lambda _function, workers, on_error: dict.fromkeys(workers, 0),
        scheduler_info=lambda: {"workers": workers},
        get_versions=lambda check: {
            "client": {"packages": own},
            "workers": {"tcp://good": {"packages": own}, "tcp://late": {"packages": packages}},
        },
    )


@pytest.mark.parametrize(
    ("about", "sentence"),
    [
        ({"memory_limit": 10}, "worker tcp://late declares 0.0 GB for 1 exposures at a time"),
        ({"packages": {"dask": "9"}}, "worker tcp://late has dask 9, this command 1"),
    ],
)
def test_a_worker_that_joins_later_and_does_not_suit_is_set_aside(
    about: dict[str, Any], sentence: str
) -> None:
    sentences: list[str] = []
    executor = DaskExecutor(LOCAL, announce=sentences.append)
    executor._client = joining_client(**about)
    executor._task_nbytes, executor._suitable = 1000, {"tcp://good": ""}
    assert executor.capacity == dask_executor.QUEUED_FACTOR
    assert executor._permitted() == ["tcp://good"]
    (found,) = sentences
    assert found.startswith(sentence) and found.endswith("It gets no exposures of this run.")
    executor._count_threads()
    assert len(sentences) == 1
    suits = DaskExecutor(LOCAL, announce=sentences.append)
    suits._client = joining_client()
    suits._task_nbytes, suits._suitable = 1000, {"tcp://good": ""}
    assert suits.capacity == 2 * dask_executor.QUEUED_FACTOR and suits._permitted() is None
    assert len(sentences) == 1


def test_a_worker_that_does_not_answer_is_checked_again() -> None:
    client = joining_client()
    assert unsuitable_workers(client, ["tcp://late", "tcp://gone"], 1) == {"tcp://late": ""}


def refused_by(executor: DaskExecutor, error: Exception, worker: str) -> list[Any]:
    future = SimpleNamespace(result=lambda timeout: WorkRefused(error, worker))
    executor._futures[7] = cast(Any, future)
    return executor._outcome(7, future)


def test_a_later_worker_that_cannot_load_the_work_does_not_end_the_run() -> None:
    sentences: list[str] = []
    executor = DaskExecutor(LOCAL, announce=sentences.append)
    executor._suitable = {"tcp://good": "", "tcp://late": ""}
    passing = ObjectStoreUnavailableError("s3://survey: no answer")
    assert refused_by(executor, passing, "tcp://late") == [TaskFailed(7, passing)]
    assert executor._permitted() is None and not sentences
    (lost,) = refused_by(executor, ValueError("numba 1 instead of 2"), "tcp://late")
    assert isinstance(lost, TaskLost) and lost.kind == "scheduler"
    assert executor._permitted() == ["tcp://good"]
    assert "tcp://late cannot load the work: ValueError: numba 1 instead of 2" in sentences[0]
    with pytest.raises(ClusterError, match="cannot load the work"):
        refused_by(executor, ValueError("numba 1"), "")


def test_exposures_whose_permitted_workers_left_are_submitted_again() -> None:
    cancelled: list[Any] = []
    client = joining_client(memory_limit=10)
    client.cancel = cancelled.extend
    executor = DaskExecutor(LOCAL)
    executor._client, executor._task_nbytes = client, 1000
    pending = cast(Any, SimpleNamespace(status="pending"))
    executor._futures = {1: pending, 2: pending, 3: pending}
    executor._restricted = {
        1: frozenset({"tcp://gone"}), 2: frozenset({"tcp://good"}), 3: frozenset(),
    }  # fmt: skip
    executor._count_threads()
    assert cancelled == [pending] and sorted(executor._futures) == [2, 3]
    assert [one.number for one in executor._unsent] == [1]


@pytest.mark.trust
@pytest.mark.timeout(120)
def test_exposures_go_only_to_workers_that_suit(encrypted: ClusterAddress, tmp_path: Path) -> None:
    executor = DaskExecutor(encrypted)
    executor.start(ToyWork(tmp_path))
    try:
        for name in list(executor._suitable)[1:]:
            executor._set_aside(name, "for the test.")
        assert executor.capacity == dask_executor.QUEUED_FACTOR
        executor.submit(BatchTask(1))
        assert executor.wait(30.0) == [TaskDone(1, 10)]
        executor._set_aside(next(iter(executor._suitable)), "for the test.")
        executor.submit(BatchTask(2))
        (lost,) = executor.wait(5.0)
        assert isinstance(lost, TaskLost) and lost.kind == "scheduler" and executor.capacity == 0
    finally:
        executor.close(1.0)
