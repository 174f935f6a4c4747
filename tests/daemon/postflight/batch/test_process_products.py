"""`syntopic process` finds by looking what is complete, and commits each product set once."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.layout import Mission
from daemon.mission.store import product_manifests
from daemon.mission.store.product_manifests import MANIFESTS, committed_keys, read_manifest
from tests.daemon.diverging_camera import ROOT, copied, flown_mission

pytestmark = pytest.mark.trust


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Mission:
    return flown_mission(tmp_path_factory.mktemp("flown"))


@pytest.fixture(scope="module")
def processed(flown: Mission, tmp_path_factory: pytest.TempPathFactory) -> Mission:
    mission = copied(flown, tmp_path_factory.mktemp("processed"))
    output = process(mission)
    assert output["complete_before"] == 0 and output["done"] == 4
    return mission


def process(mission: Mission, *options: str) -> dict[str, Any]:
    """In this process, unless the options demand another executor."""
    options = options if "--processes" in options else ("--processes", "0", *options)
    done = CliRunner().invoke(app, ["process", str(mission.path), "--json", *options])
    assert done.exit_code in (0, 1), done.output
    return json.loads(done.stdout)


def compared(mission: Mission) -> dict[int, str]:
    """The hash of each product set without durations, every byte of it checked."""
    found = {}
    for number in mission.numbers():
        (key,) = committed_keys(mission, number)
        manifest = read_manifest(mission, number, key)
        assert manifest is not None
        assert product_manifests.product_problems(mission, number, key) == []
        found[number] = manifest.compared_sha256
    return found


def test_complete_products_are_not_computed_again(processed: Mission, tmp_path: Path) -> None:
    mission = copied(processed, tmp_path)
    before = {path: path.stat().st_mtime_ns for path in mission.path.rglob("*.json")}
    output = process(mission)
    assert output["complete_before"] == 4 and output["done"] == 0
    assert [report["exposure"] for report in output["exposures"]] == [1, 2, 3, 4]
    assert all(report["duration_s"] > 0 for report in output["exposures"])
    assert {path: path.stat().st_mtime_ns for path in mission.path.rglob("*.json")} == before
    assert process(mission, "--again")["done"] == 4
    assert compared(mission) == compared(processed)


def test_the_bytes_do_not_depend_on_processes_and_threads(
    flown: Mission, processed: Mission, tmp_path: Path
) -> None:
    mission = copied(flown, tmp_path)
    output = process(mission, "--processes", "2", "--threads", "1")
    assert output["executor"] == "2 processes" and output["failures"] == []
    assert output["dashboard"] is None
    assert compared(mission) == compared(processed)


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("L2/000002/LEFT.tif", b"half"),
        ("L2/000002/quality.json", b"{}"),
        ("L2/000002/quicklook.jpg", None),
        ("L2/000002/foreign.txt", b"x"),
        ("manifests/L2/000002", None),
        ("L2/000002/RIGHT.tif", b""),
        ("L0/000002/capture.json", b"{}"),
    ],
)
def test_what_is_not_complete_or_has_other_inputs_is_computed_again(
    processed: Mission, tmp_path: Path, name: str, data: bytes | None
) -> None:
    mission = copied(processed, tmp_path)
    path = mission.path / name
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
    if data is not None:
        path.write_bytes(data)
    output = process(mission)
    assert (output["complete_before"], output["done"], output["failures"]) == (3, 1, [])
    assert compared(mission) == compared(processed)


def test_a_manifest_of_another_format_is_computed_again(processed: Mission, tmp_path: Path) -> None:
    mission = copied(processed, tmp_path)
    (key,) = committed_keys(mission, 2)
    path = mission.path / MANIFESTS / "L2/000002" / f"{key}.json"
    content = json.loads(path.read_bytes())
    path.write_text(json.dumps({**content, "format": 2}))
    assert read_manifest(mission, 2, key) is None
    assert process(mission)["done"] == 1
    assert compared(mission) == compared(processed)


def test_products_of_other_settings_are_replaced_with_their_manifest(
    processed: Mission, tmp_path: Path
) -> None:
    mission = copied(processed, tmp_path)
    (first,) = committed_keys(mission, 1)
    assert process(mission, "--interpolation", "bilinear", "--only", "1")["done"] == 1
    (second,) = committed_keys(mission, 1)
    assert first != second
    assert process(mission)["done"] == 1
    assert committed_keys(mission, 1) == [first]
    assert compared(mission) == compared(processed)


def test_a_frame_that_vanished_is_another_input(processed: Mission, tmp_path: Path) -> None:
    mission = copied(processed, tmp_path)
    (mission.level0(2) / "LEFT.tif").unlink()
    output = process(mission)
    assert output["done"] == 1
    assert "FRAME_MISSING" in output["exposures"][1]["flags"]


def test_a_second_commit_of_a_key_is_recognized(processed: Mission, tmp_path: Path) -> None:
    mission = copied(processed, tmp_path)
    (key,) = committed_keys(mission, 1)
    manifest = read_manifest(mission, 1, key)
    assert manifest is not None
    inode = (mission.path / MANIFESTS / "L2/000001" / f"{key}.json").stat().st_ino
    assert product_manifests.commit(mission, 1, manifest, {"host": "other"}) is False
    assert product_manifests.provenance_of(mission, 1, key)["host"] != "other"
    assert (mission.path / MANIFESTS / "L2/000001" / f"{key}.json").stat().st_ino == inode


def test_a_dry_run_states_what_would_be_computed(flown: Mission, processed: Mission) -> None:
    output = process(flown, "--dry-run")
    assert output["pending"] == [1, 2, 3, 4] and output["expected_s"] is None
    assert output["read_nbytes"] > 4 * 2 * 2 * 96 * 64
    assert not (flown.path / MANIFESTS).exists() and not list(flown.level2_root.iterdir())
    done = process(processed, "--dry-run", "--again")
    assert done["complete"] == [] and done["expected_s"] > 0


def test_a_file_address_is_the_folder(processed: Mission) -> None:
    arguments = ["process", f"file://{processed.path}", "--dry-run", "--json"]
    found = json.loads(CliRunner().invoke(app, arguments).stdout)
    assert found["complete"] == [1, 2, 3, 4] and found["pending"] == []
    checked = CliRunner().invoke(app, ["verify", f"file://{processed.path}", "--json"])
    assert json.loads(checked.stdout)["exposures"] == 4


def test_two_runs_at_once_leave_every_product_set_complete(tmp_path: Path) -> None:
    mission = flown_mission(tmp_path, range(1, 31))
    command = [sys.executable, "-m", "daemon", "process", str(mission.path), "--json"]
    runs = [
        subprocess.Popen([*command, "--processes", count], cwd=ROOT, stdout=subprocess.PIPE)
        for count in ("0", "2")
    ]
    outputs = [json.loads(run.communicate(timeout=200)[0]) for run in runs]
    assert [run.returncode for run in runs] == [0, 0]
    numbers = list(range(1, 31))
    for output in outputs:
        assert [report["exposure"] for report in output["exposures"]] == numbers
    assert len(compared(mission)) == 30


@pytest.mark.timeout(300)
def test_a_killed_worker_and_a_killed_command_leave_nothing_undone(
    processed: Mission, tmp_path: Path
) -> None:
    mission = flown_mission(tmp_path, range(1, 61))
    command = [sys.executable, "-m", "daemon", "process", str(mission.path), "--processes", "2"]
    run = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    limit = time.monotonic() + 150
    while len(list(mission.path.glob("L2/??????"))) < 5:
        assert time.monotonic() < limit and run.poll() is None
        time.sleep(0.02)
    os.kill(_newest_worker(mission), signal.SIGKILL)
    while len(list(mission.path.glob("L2/??????"))) < 20:
        assert time.monotonic() < limit and run.poll() is None
        time.sleep(0.02)
    run.kill()
    run.communicate(timeout=30)
    output = process(mission, "--processes", "2")
    assert output["failures"] == [] and output["complete_before"] >= 18
    assert len(output["exposures"]) == 60
    first = {number: hashed for number, hashed in compared(mission).items() if number <= 4}
    assert first == compared(processed)


def _newest_worker(mission: Mission) -> int:
    files = mission.path.glob(f"{MANIFESTS}/L2/*/*.provenance.json")
    newest = max(files, key=lambda path: path.stat().st_mtime_ns)
    return int(json.loads(newest.read_bytes())["process"])
