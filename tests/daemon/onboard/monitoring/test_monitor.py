"""`syntopic monitor` against the real watch process."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from rich.console import Console
from typer.testing import CliRunner

from daemon.cli import app
from daemon.cli.monitor import _Seen
from tests.daemon.onboard.monitoring import flown
from tests.daemon.onboard.monitoring.test_page import Service


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    service = Service(tmp_path)
    service.tell(flown.mission())
    yield service
    service.end()


def test_the_state_is_told_once_as_json_and_drawn_with_what_is_wrong(service: Service) -> None:
    for event in (*flown.exposure(1, "refly"), flown.lost("SU02"), flown.status(triggers=1)):
        service.tell(event)
    address = service.address.removeprefix("http://").rstrip("/")
    told = CliRunner().invoke(app, ["monitor", address, "--json"])
    assert told.exit_code == 0, told.output
    state = json.loads(told.stdout)
    assert [(one["number"], one["verdict"]) for one in state["exposures"]] == [(1, "refly")]
    seen = _Seen()
    seen.take(state)
    console = Console(record=True, width=100)
    console.print(seen.drawn(address))
    drawn = console.export_text()
    for text in ("SIMULATED", "✖ WARNING", "SU02 does not answer", "■ refly", "clock ±25 ns"):
        assert text in drawn
