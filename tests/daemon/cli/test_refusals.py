"""What a command cannot do ends in one sentence and a status, whichever package refused it."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import processing.rig
from daemon import DaemonError, cli
from daemon.cli.exit_status import ExitStatus
from daemon.postflight.adjustment.project_file import CameraSection
from drivers.contract import DeviceError
from processing.bundle.image_rows import BehindCameraError
from processing.geometry.image_proposal import ProposalError
from processing.rig import RigError

SHIPPED = Path(processing.rig.__file__).parent / "files" / "ultracam-l-mini.toml"


def status_of(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> object:
    monkeypatch.setattr(sys, "argv", ["syntopic", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return ended.value.code


def raising(error: Exception) -> object:
    def app() -> None:
        raise error

    return app


def test_a_refusal_of_the_mathematics_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    status = status_of(monkeypatch, "rigs", "propose-image", str(SHIPPED))
    assert status == ExitStatus.PROBLEM
    assert capsys.readouterr().err.splitlines() == [
        "ultracam-l-mini has a [virtual_image]; remove it to have another proposed"
    ]


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (DaemonError("no mission"), ExitStatus.PROBLEM),
        (DeviceError("no device"), ExitStatus.PROBLEM),
        (ProposalError("no rectangle"), ExitStatus.PROBLEM),
        (BehindCameraError(np.arange(3)), ExitStatus.PROBLEM),
        (RigError(["no head"]), ExitStatus.REFUSED),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Exception) else str(int(value)),
)
def test_errors_of_every_package_end_in_their_status(
    error: Exception,
    status: ExitStatus,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(cli, "app", raising(error))
    assert status_of(monkeypatch) == status
    printed = capsys.readouterr().err
    assert str(error).strip() in printed and "Traceback" not in printed


def test_values_that_a_model_refuses_are_sentences(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def app() -> None:
        CameraSection(name="c", f_mm=-900.0)

    monkeypatch.setattr(cli, "app", app)
    assert status_of(monkeypatch) == ExitStatus.PROBLEM
    printed = capsys.readouterr().err
    assert "CameraSection" in printed and "f_mm" in printed and "-900" in printed
    assert "Correct these values" in printed
    assert "pydantic" not in printed and "Traceback" not in printed


def test_a_defect_of_the_program_is_no_refusal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cli, "app", raising(ValueError("shapes differ")))
    monkeypatch.setattr(sys, "argv", ["syntopic"])
    with pytest.raises(ValueError, match="shapes differ"):
        cli.main()
