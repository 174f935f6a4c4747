"""The table of flags against the flags of reports."""

import json

import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.onboard.flight.flag_table import FLAG_TABLE
from processing.quality.report import Flag


def test_every_flag_has_an_entry_and_no_other_has() -> None:
    assert [entry.name for entry in FLAG_TABLE] == [flag.name for flag in Flag]
    for entry in FLAG_TABLE:
        assert entry.cause.endswith(".") and entry.action.endswith("."), entry


@pytest.mark.parametrize("name", ["TILT", "tilt"])
def test_explain_finds_a_flag(name: str) -> None:
    done = CliRunner().invoke(app, ["explain", name, "--json"])
    assert done.exit_code == 0
    (flag,) = json.loads(done.output)["flags"]
    assert flag["name"] == "TILT" and "Roll or pitch" in flag["cause"]


def test_explain_prints_flags_and_events_that_match() -> None:
    done = CliRunner().invoke(app, ["explain", "time"])
    assert "TIME_SIGMA" in done.output and " event" in done.output


def test_an_unknown_name_is_refused() -> None:
    assert CliRunner().invoke(app, ["explain", "no-such-thing"]).exit_code == 1
