"""SIGINT to a command and its processes at every phase of a run on an executor."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from typer.testing import CliRunner

from benchmarks.orthomosaic import fly
from daemon.cli import app, interrupt_messages
from daemon.cli.exit_status import ExitStatus
from daemon.mission.layout import Mission
from daemon.mission.store import store
from tests.daemon.diverging_camera import ROOT, flown_mission
from tests.daemon.postflight.batch.test_cluster import cluster

__all__ = ["cluster"]

pytestmark = [pytest.mark.trust, pytest.mark.timeout(300)]

BATCH = "daemon.postflight.batch."
LOCAL = f"{BATCH}local_processes:LocalProcessExecutor."
STORE = "daemon.mission.store."
TRANSFER = "daemon.mission.transfer.transfer:"
COMMAND = """
import importlib, os, signal, sys
place, count = sys.argv[1], int(sys.argv[2])
sys.argv = ["syntopic", *sys.argv[3:]]
module, _, name = place.partition(":")
*parents, name = name.split(".")
owner = importlib.import_module(module)
for parent in parents:
    owner = getattr(owner, parent)
real, calls = getattr(owner, name), []
def interrupted(*arguments, **options):
    calls.append(arguments)
    if len(calls) == count:
        os.killpg(0, signal.SIGINT)
    return real(*arguments, **options)
setattr(owner, name, interrupted)
from daemon.cli import main
main()
"""
"""A command whose process group gets SIGINT, as by Ctrl-C, where a function is called."""


@dataclass(frozen=True)
class Phase:
    """The function at whose call, and at which of its calls, the signal comes."""

    name: str
    place: str
    count: int = 1
    options: tuple[str, ...] = ("--processes", "2")


def _in_soak(phase: Phase) -> object:
    return pytest.param(phase, marks=pytest.mark.soak, id=phase.name)


PROCESS = [
    pytest.param(Phase("in work", f"{LOCAL}submit", 2), id="in work"),
    *map(
        _in_soak,
        (
            Phase("looking", f"{BATCH}level2_sources:survey"),
            Phase("opening", f"{LOCAL}_receive", 2),
            Phase("first process", f"{LOCAL}_start_worker"),
            Phase("second process", f"{LOCAL}_start_worker", 2),
            Phase("closing", f"{LOCAL}close"),
            Phase("ending a process", f"{BATCH}local_processes:_Worker.end"),
            Phase("reports", f"{BATCH}level2_sources:FolderSource.reports"),
            Phase("files", f"{STORE}product_manifests:publish", 1, ("--processes", "0")),
            Phase("manifest", f"{STORE}product_manifests:commit", 1, ("--processes", "0")),
            Phase("threads", f"{BATCH}in_process:InProcessExecutor.close", 1, ("--processes", "0")),
        ),
    ),
]
VERIFY = [
    _in_soak(Phase("second process", f"{LOCAL}_start_worker", 2)),
    _in_soak(Phase("in work", f"{LOCAL}submit", 2)),
    _in_soak(Phase("closing", f"{LOCAL}close")),
]
DASK = f"{BATCH}dask_executor:DaskExecutor."
CLUSTER = (
    Phase("connecting", f"{DASK}_connect"),
    Phase("opening", f"{DASK}_open"),
    Phase("in work", f"{DASK}submit", 3),
    Phase("result", f"{DASK}_outcome"),
    Phase("closing", f"{DASK}close"),
)
MOSAIC = (
    Phase("second process", f"{LOCAL}_start_worker", 2),
    Phase("in work", f"{LOCAL}submit", 2),
    Phase("closing", f"{LOCAL}close"),
    Phase("files", "daemon.postflight.orthomosaic.orthomosaic:write_cog", 2),
)
COPY = [
    _in_soak(Phase("source", f"{TRANSFER}checkpoint_index", options=("--remove-source",))),
    _in_soak(Phase("files", f"{STORE}file_tree:FileTree.sha256", 2, options=("--remove-source",))),
    _in_soak(Phase("copy", f"{TRANSFER}verify", options=("--remove-source",))),
    _in_soak(Phase("removal", f"{TRANSFER}remove_sealed_source", options=("--remove-source",))),
]


def check_interrupted(phase: Phase, command: str, *arguments: str) -> None:
    """Run a command, interrupt it in a phase, and find that it ended as a person expects it.

    Raises:
        AssertionError: another status or last sentence, a traceback, or a process that stays.
    """
    child = subprocess.Popen(
        [sys.executable, "-c", COMMAND, phase.place, str(phase.count), command, *arguments],
        cwd=ROOT, env=os.environ | {"NO_COLOR": "1"}, stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    try:
        output, errors = child.communicate(timeout=120)
    finally:
        child.kill()
        child.wait()
    lines = [line for line in errors.splitlines() if line.strip()]
    assert child.returncode == ExitStatus.INTERRUPTED, (output, errors)
    assert lines[-1] == interrupt_messages.sentence_of(command), (output, errors)
    assert "Traceback" not in output + errors
    limit_s = time.monotonic() + 30.0
    while processes_of(child.pid):
        assert time.monotonic() < limit_s, f"a process stays: {processes_of(child.pid)}"
        time.sleep(0.05)


def processes_of(session: int) -> list[str]:
    """Processes of a session that are alive."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            fields = (path / "stat").read_text("utf-8").rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(fields[3]) == session and fields[0] != "Z":
            found.append(path.name)
    return found


@pytest.mark.parametrize("phase", PROCESS)
def test_an_interrupted_process_leaves_complete_products_and_continues(
    phase: Phase, tmp_path: Path
) -> None:
    mission = flown_mission(tmp_path, (1, 2, 3))
    check_interrupted(phase, "process", str(mission.path), *phase.options)
    assert store.verify(mission).problems == ()
    again = CliRunner().invoke(app, ["process", str(mission.path), "--processes", "0", "--json"])
    found = json.loads(again.stdout)
    assert found["done"] + found["complete_before"] == 3 and found["failures"] == []
    assert store.verify(mission).problems == ()


@pytest.mark.parametrize("phase", VERIFY)
def test_an_interrupted_verify_changes_nothing(phase: Phase, tmp_path: Path) -> None:
    mission = flown_mission(tmp_path, (1, 2, 3))
    before = {path: path.stat().st_mtime_ns for path in mission.path.rglob("L0/**/*")}
    check_interrupted(phase, "verify", str(mission.path), *phase.options)
    assert before == {path: path.stat().st_mtime_ns for path in before}


@pytest.mark.parametrize("phase", COPY)
def test_an_interrupted_transfer_has_one_complete_copy_and_continues(
    phase: Phase, tmp_path: Path
) -> None:
    mission, disk = flown_mission(tmp_path, (1, 2)), tmp_path / "disk"
    arguments = ("transfer", str(mission.path), str(disk), *phase.options)
    check_interrupted(phase, *arguments)
    assert mission.path.exists()
    assert CliRunner().invoke(app, arguments).exit_code == 0
    assert not mission.path.exists()
    assert store.verify(Mission.open(disk / mission.id)).problems == ()


@pytest.mark.soak
def test_a_run_on_a_cluster_that_is_interrupted_leaves_complete_products_and_continues(
    cluster: tuple[str, subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    for phase in CLUSTER:
        mission = flown_mission(tmp_path / phase.name, (1, 2, 3, 4))
        check_interrupted(phase, "process", str(mission.path), "--scheduler", cluster[0])
        assert store.verify(mission).problems == ()
        arguments = ["process", str(mission.path), "--scheduler", cluster[0], "--json"]
        found = json.loads(CliRunner().invoke(app, arguments).stdout)
        assert found["done"] + found["complete_before"] == 4 and found["failures"] == []


@pytest.mark.soak
def test_an_interrupted_orthomosaic_has_no_result_and_continues(tmp_path: Path) -> None:
    flown, out = fly(tmp_path, width_px=1182, exposures=2), tmp_path / "ortho"
    arguments = (
        "orthomosaic", str(flown.mission), "--out", str(out), "--processes", "2", "--json",
        "--trajectory", str(flown.folder / "trajectory.csv"), "--ground-height", "100",
    )  # fmt: skip
    for phase in MOSAIC:
        check_interrupted(phase, *arguments)
        assert not out.exists()
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0 and json.loads(done.stdout)["tiles_computed"] == 0
    assert (out / "pan-16.tif").is_file()
