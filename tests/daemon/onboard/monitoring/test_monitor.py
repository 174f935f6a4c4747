"""`syntopic monitor` against the real watch process."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.cli.monitor import _MonitorState
from daemon.terminal.console import Console
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.page_service import Service


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    service = Service(tmp_path)
    service.emit(flight_events.mission())
    yield service
    service.end()


def test_the_state_is_printed_once_as_json_and_drawn_with_its_faults(service: Service) -> None:
    for event in (
        *flight_events.exposure(1, "refly"),
        flight_events.lost("SU02"),
        flight_events.status(triggers=1),
    ):
        service.emit(event)
    address = service.address.removeprefix("http://").rstrip("/")
    result = CliRunner().invoke(app, ["monitor", address, "--json"])
    assert result.exit_code == 0, result.output
    state = json.loads(result.stdout)
    assert [(one["number"], one["verdict"]) for one in state["exposures"]] == [(1, "refly")]
    seen = _MonitorState()
    seen.receive(state)
    console = Console(record=True, width=100)
    console.print(seen.drawn(address))
    drawn = console.export_text()
    for text in ("SIMULATED", "✖ WARNING", "SU02 does not answer", "■ refly", "clock ±25 ns"):
        assert text in drawn
