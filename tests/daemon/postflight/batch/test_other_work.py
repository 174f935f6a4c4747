"""`verify` on executors: the same findings, and an exposure that nobody could read is a problem."""

from __future__ import annotations

import errno
import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.layout import Mission
from daemon.mission.verification.verification import verify
from daemon.postflight.batch import verification_work
from daemon.postflight.batch.in_process import InProcessExecutor
from daemon.postflight.batch.verification_work import verified_by
from tests.daemon.diverging_camera import copied, flown_mission


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Mission:
    return flown_mission(tmp_path_factory.mktemp("flown"))


@pytest.mark.trust
def test_processes_find_what_threads_find(flown: Mission, tmp_path: Path) -> None:
    mission = copied(flown, tmp_path)
    frame = mission.level0(2) / "LEFT.tif"
    frame.chmod(0o644)
    frame.write_bytes(frame.read_bytes()[:-1] + b"x")
    (mission.level0(3) / "RIGHT.tif").unlink()
    expected = verify(mission)
    assert len(expected.problems) >= 2
    done = CliRunner().invoke(app, ["verify", str(mission.path), "--processes", "2", "--json"])
    assert done.exit_code == 1
    assert json.loads(done.stdout) == json.loads(json.dumps(asdict(expected)))
    good = CliRunner().invoke(app, ["verify", str(flown.path), "--processes", "1"])
    assert good.exit_code == 0 and "nothing is wrong" in good.stdout


def test_an_exposure_that_no_process_can_read_is_a_problem(
    flown: Mission, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = verification_work.check_exposure

    def refused(expected: Any, step: Any) -> Any:
        if expected.number == 2:
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(expected.folder))
        return real(expected, step)

    monkeypatch.setattr(verification_work, "check_exposure", refused)
    report = verify(flown, check_all=verified_by(InProcessExecutor(2)))
    unread = [problem for problem in report.problems if "could not be verified" in problem]
    assert len(unread) == 1 and unread[0].startswith("exposure 2: could not be verified: ")
    assert not report.is_intact


def test_processes_do_not_go_with_a_store() -> None:
    pytest.importorskip("obstore", reason="pip install 'syntopic[stores]'")
    done = CliRunner().invoke(app, ["verify", "s3://survey/mission", "--processes", "2"])
    assert "are for mission folders" in f"{done.output} {done.exception}"
