"""While the service runs, `syntopic check` asks it and opens nothing."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.cli.check import look
from daemon.configuration.model import load
from daemon.onboard.preflight.findings import EXIT_STATUS, Finding, Outcome, failed, overall, passed
from daemon.onboard.service.departure import create_mission
from tests.daemon.onboard.monitoring.test_control_socket import Service, with_socket
from tests.daemon.onboard.service.flight_parts import Planted

pytestmark = pytest.mark.trust


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Planted]:
    made = Planted(tmp_path, monkeypatch)
    monkeypatch.setattr("daemon.onboard.preflight.trial.try_out", _nothing_is_opened)
    made.add('[watch]\nport = 0\ncontrol = "c.sock"')
    made.write()
    yield made


def flying() -> Service:
    """A service that has one head, has lost another, and waits for its receiver."""
    service = Service()
    device = {"event": "device", "device": "SUB", "fault": True, "name": "lost", "sentence": "gone"}
    passed_by = {
        "event": "device",
        "device": "SUA",
        "fault": True,
        "name": "lost",
        "sentence": "was",
    }
    back = {"event": "device", "device": "SUA", "fault": False, "name": "opened", "sentence": "is"}
    for event in (
        {"event": "bound", "kind": "head", "device": "SUA", "found": {}},
        {"event": "bound", "kind": "head", "device": "SUB", "found": {}},
        device,
        passed_by,
        back,
        {"event": "phase", "phase": "ready"},
        {"event": "status", "missing": ["no position (wait)"]},
    ):
        service.state.apply(event)
    return service


def test_the_running_service_is_asked_over_its_control_socket(planted: Planted) -> None:
    configuration, rig = load(planted.config)
    mission = create_mission(configuration, rig, planted.config)
    service = flying()
    with mission.held():
        found = with_socket(
            service,
            planted.folder / "c.sock",
            lambda: look(configuration, rig, planted.config, fire=True),
        )
    told = {(one.kind, one.name): (one.outcome, one.sentence) for one in found}
    assert told["service", mission.id] == (Outcome.PASS, "the service flies, phase ready")
    assert told["head", "SUA"][0] is Outcome.PASS
    assert told["head", "SUB"] == (Outcome.FAIL, "gone")
    assert told["arming", "missing"] == (Outcome.WAITING, "no position (wait)")
    assert told["fault", "SUB"] == (Outcome.FAIL, "gone")
    assert ("fault", "SUA") not in told, "it has passed"
    assert not service.commands, "asking is no command, and nothing goes to the log"
    assert overall(found) is Outcome.FAIL


def test_a_service_that_does_not_answer_fails_and_one_without_a_socket_is_waited_for(
    planted: Planted,
) -> None:
    configuration, rig = load(planted.config)
    mission = create_mission(configuration, rig, planted.config)
    assert not mission.is_held()
    with mission.held():
        (silent,) = look(configuration, rig, planted.config, fire=False)
        planted.service = planted.service.replace('control = "c.sock"', "")
        planted.write()
        (deaf,) = look(*load(planted.config), planted.config, fire=False)
    assert silent.outcome is Outcome.FAIL and "does not answer" in silent.sentence
    assert deaf.outcome is Outcome.WAITING and "[watch] control" in deaf.sentence
    assert mission.id in deaf.sentence


def test_the_exit_status_is_that_of_the_worst_finding() -> None:
    well, late = passed("disk", "pace"), Finding("stream", "gnss", Outcome.WAITING, "searching")
    ill, idle = failed("head", "SUA", "gone"), Finding("stream", "f", Outcome.NOT_TRIED)
    cases = (([], 0), ([well, idle], 0), ([well, late], 3), ([late, ill, well], 1))
    for findings, status in cases:
        assert EXIT_STATUS[overall(findings)] == status


def _nothing_is_opened(*_: object, **__: object) -> list[Finding]:
    raise AssertionError("devices are the running service's")
