"""A cluster computes the same bytes, whatever dies; without TLS it stays on this machine."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.configuration.model import ConfigurationError
from daemon.mission.layout import Mission
from daemon.mission.store.product_manifests import committed_keys, product_problems, read_manifest
from daemon.postflight.batch.cluster_address import cluster_address
from tests.daemon.diverging_camera import ROOT, flown_mission

pytestmark = pytest.mark.trust

IN_FLIGHT = """
import sys
import daemon.onboard.pipeline.worker, daemon.onboard.service.service, daemon.cli.run
import daemon.cli.process, daemon.postflight.batch.local_processes
print([name for name in sys.modules if name.partition(".")[0] in ("dask", "distributed")])
"""


@pytest.mark.parametrize(
    ("url", "sentence"),
    [
        ("tcp://10.0.0.5:8786", "without TLS.*--scheduler tls://10.0.0.5:8786 with --tls-ca"),
        ("tcp://camera.example:8786", "without TLS"),
        ("tls://10.0.0.5:8786", "needs --tls-ca FILE"),
        ("http://127.0.0.1:8786", "is no address"),
        ("tcp://127.0.0.1", "is no address"),
        ("tcp://127.0.0.1:none", "is no address"),
    ],
)
def test_a_cluster_off_this_machine_needs_tls(url: str, sentence: str) -> None:
    with pytest.raises(ConfigurationError, match=sentence):
        cluster_address(url, None, None, None)


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "[::1]", "127.8.0.1"])
def test_loopback_needs_no_tls(host: str) -> None:
    assert cluster_address(f"tcp://{host}:8786", None, None, None).is_loopback


def test_nothing_of_dask_is_imported_in_flight() -> None:
    done = subprocess.run(
        [sys.executable, "-c", IN_FLIGHT], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stdout.strip() == "[]"


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def wait_until_open(url: str, process: subprocess.Popen[bytes]) -> None:
    """Until a scheduler listens, however late the machine gives it a core."""
    limit_s = time.monotonic() + 240.0
    while True:
        try:
            socket.create_connection(("127.0.0.1", int(url.rpartition(":")[2]))).close()
            return
        except ConnectionRefusedError:
            assert process.poll() is None and time.monotonic() < limit_s
            time.sleep(0.2)


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """The address of a scheduler, and the command whose two workers joined it."""
    url = f"tcp://127.0.0.1:{free_port()}"
    options = ["--host", "127.0.0.1", "--port", url.rpartition(":")[2]]
    dask = [str(Path(sys.executable).with_name("dask")), "scheduler", *options]
    own = [sys.executable, "-m", "daemon", "worker", url, "--processes", "2"]
    with (tmp_path / "cluster.txt").open("wb") as log:
        quiet = ["--dashboard-address", "127.0.0.1:0"]
        parts = [
            subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)
            for command in ([*dask, *quiet], own)
        ]
    wait_until_open(url, parts[0])
    yield url, parts[1]
    parts[1].send_signal(signal.SIGINT)
    assert parts[1].wait(60) == 130
    parts[0].kill()
    parts[0].wait()


def hashes(mission: Mission) -> list[str]:
    found = []
    for number in mission.numbers():
        (key,) = committed_keys(mission, number)
        manifest = read_manifest(mission, number, key)
        assert manifest is not None and product_problems(mission, number, key) == []
        found.append(manifest.compared_sha256)
    return found


@pytest.mark.timeout(300)
def test_a_cluster_whose_workers_are_killed_makes_the_same_bytes(
    cluster: tuple[str, subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    url, _ = cluster
    mission = flown_mission(tmp_path / "flown", range(1, 31))
    other = Mission.open(Path(shutil.copytree(mission.path, tmp_path / "other" / mission.id)))
    command = [sys.executable, "-m", "daemon", "process", "--json"]
    run = subprocess.Popen(
        [*command, str(mission.path), "--scheduler", url], cwd=ROOT, stdout=subprocess.PIPE
    )
    limit = time.monotonic() + 120
    while len(list(mission.level2_root.iterdir())) < 5:
        assert time.monotonic() < limit and run.poll() is None
        time.sleep(0.02)
    newest = max(
        mission.path.glob("manifests/L2/*/*.provenance.json"), key=lambda p: p.stat().st_mtime_ns
    )
    os.kill(int(json.loads(newest.read_bytes())["process"]), signal.SIGKILL)
    output = json.loads(run.communicate(timeout=200)[0])
    assert run.returncode == 0 and output["failures"] == []
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/status", output["dashboard"])
    assert [report["exposure"] for report in output["exposures"]] == list(range(1, 31))
    plain = [*command, str(other.path), "--processes", "0"]
    subprocess.run(plain, cwd=ROOT, stdout=subprocess.DEVNULL, check=True)
    assert hashes(mission) == hashes(other)


def test_a_task_submitted_while_the_scheduler_is_away_is_submitted_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from daemon.postflight.batch.dask_executor import DaskExecutor
    from daemon.postflight.batch.executor import BatchTask, TaskLost

    executor = DaskExecutor(cluster_address("tcp://127.0.0.1:1", None, None, None))
    monkeypatch.setattr(executor, "_reconnect", list)
    executor.submit(BatchTask(7))
    assert executor.wait(0.0) == [TaskLost(7, "scheduler", "the scheduler died")]


def test_without_a_scheduler_the_sentence_names_how_to_start_one() -> None:
    url = f"tcp://127.0.0.1:{free_port()}"
    command = [sys.executable, "-m", "daemon", "worker", url, "--processes", "1", "--wait", "1"]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=100, check=False
    )
    assert done.returncode == 1 and "Start one: dask scheduler --host 127.0.0.1" in done.stderr
