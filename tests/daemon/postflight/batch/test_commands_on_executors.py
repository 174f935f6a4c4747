"""Commands after landing write the same bytes in this process, in processes and on a cluster."""

from __future__ import annotations

import json
import pickle
import shutil
import subprocess
from collections.abc import Iterator

import pytest
from typer.testing import CliRunner

from benchmarks.orthomosaic import OrthoFlight, fly
from daemon.cli import app
from daemon.mission.store.level0 import RasterError
from daemon.postflight.batch import in_process
from daemon.postflight.batch.executor import BatchTask, BatchWork, TaskOutcome
from daemon.postflight.batch.in_process import InProcessExecutor
from daemon.postflight.orthomosaic import orthomosaic_work
from daemon.postflight.triangulation import matching_work
from tests.daemon.postflight.batch.test_cluster import cluster

pytestmark = [pytest.mark.trust, pytest.mark.timeout(300)]

__all__ = ["cluster"]

COMMANDS = {
    "orient": (["orient"], "export/orientation"),
    "pictures": (["export", "pictures", "--as", "tiff"], "export/tiff"),
    "triangulate": (["triangulate"], "export/triangulation"),
    "orthomosaic": (
        ["orthomosaic", "--ground-height", "440", "--gsd", "0.3"], "export/orthomosaic",
    ),
}  # fmt: skip
NOT_COMPARED = ("report.json", "report.html")
"""They have the time of the computation."""


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> OrthoFlight:
    return fly(tmp_path_factory.mktemp("block"), width_px=1182, exposures=2)


def written(flown: OrthoFlight, options: list[str]) -> Iterator[dict[str, bytes]]:
    """Files that each command writes with these options, by name."""
    for words, folder in COMMANDS.values():
        result = flown.mission / folder
        trajectory = ["--trajectory", str(flown.folder / "trajectory.csv")]
        done = CliRunner().invoke(
            app, [*words, str(flown.mission), *trajectory, *options, "--json"]
        )
        assert done.exit_code == 0, (words, done.output, done.exception)
        assert not json.loads(done.stdout).get("failures")
        found = {
            str(path.relative_to(result)): path.read_bytes()
            for path in sorted(result.rglob("*"))
            if path.is_file() and path.name not in NOT_COMPARED
        }
        shutil.rmtree(result)
        yield found


class OtherProcess(InProcessExecutor):
    """Gets and returns what another process would, by pickle."""

    def start(self, work: BatchWork) -> None:
        super().start(pickle.loads(pickle.dumps(work)))

    def submit(self, task: BatchTask) -> None:
        super().submit(pickle.loads(pickle.dumps(task)))

    def wait(self, timeout_s: float) -> list[TaskOutcome]:
        return list(pickle.loads(pickle.dumps(super().wait(timeout_s))))


def test_bytes_are_the_same_from_what_another_process_gets(
    flown: OrthoFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = list(written(flown, ["--processes", "0"]))
    assert all(len(files) >= 4 for files in own)
    monkeypatch.setattr(in_process, "InProcessExecutor", OtherProcess)
    assert list(written(flown, ["--processes", "0", "--threads", "1"])) == own


@pytest.mark.soak
def test_bytes_do_not_depend_on_the_executor(
    flown: OrthoFlight, cluster: tuple[str, subprocess.Popen[bytes]]
) -> None:
    own = list(written(flown, ["--processes", "0"]))
    for options in (["--processes", "2"], ["--scheduler", cluster[0]]):
        assert list(written(flown, options)) == own


def test_what_cannot_be_computed_ends_the_command_with_its_cause(
    flown: OrthoFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    trajectory = ["--trajectory", str(flown.folder / "trajectory.csv")]

    def damaged(*_args: object, **_options: object) -> None:
        raise RasterError("pan.tif is cut short")

    for command, module, function in (
        ("triangulate", matching_work, "match_image"),
        ("orthomosaic", orthomosaic_work, "cells_of"),
        ("orthomosaic", orthomosaic_work, "store_tile"),
    ):
        with monkeypatch.context() as patched:
            patched.setattr(module, function, damaged)
            done = CliRunner().invoke(app, [command, str(flown.mission), *trajectory])
        assert done.exit_code != 0, command
        assert "pan.tif is cut short" in f"{done.output} {done.exception}"
    assert not (flown.mission / "export/orthomosaic").exists()
