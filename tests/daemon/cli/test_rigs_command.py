"""`syntopic rigs show` describes a rig file, and draws only into a given file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from daemon.cli import app

SHOW = ["rigs", "show", "ultracam-l-mini"]


def test_nothing_is_written_unless_a_drawing_is_requested(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, [*SHOW, "--json"])
    assert result.exit_code == 0 and json.loads(result.stdout)["drawing"] is None
    assert CliRunner().invoke(app, SHOW).exit_code == 0
    assert not list(tmp_path.iterdir())


def test_a_drawing_is_written_to_the_given_file(tmp_path: Path) -> None:
    drawing = tmp_path / "rig.svg"
    result = CliRunner().invoke(app, [*SHOW, "--drawing", str(drawing), "--json"])
    assert json.loads(result.stdout)["drawing"] == str(drawing)
    assert drawing.read_text().startswith("<svg")
