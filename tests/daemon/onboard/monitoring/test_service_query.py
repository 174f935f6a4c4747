"""While the service runs, `syntopic check` queries it and opens no device."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.cli.check import STATUSES, collect_results
from daemon.onboard.preflight.check_results import (
    CheckOutcome,
    CheckResult,
    failed,
    passed,
    worst_outcome,
)
from daemon.onboard.preflight.service_file import load
from daemon.onboard.service.startup import create_mission
from tests.daemon.onboard.monitoring.test_control_socket import Service, with_socket
from tests.daemon.onboard.service.flight_parts import Planted

pytestmark = pytest.mark.trust


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Planted]:
    made = Planted(tmp_path, monkeypatch)
    monkeypatch.setattr(
        "daemon.onboard.preflight.system_check.run_system_check", _nothing_is_opened
    )
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


def test_the_running_service_is_queried_over_its_control_socket(planted: Planted) -> None:
    configuration, rig = load(planted.config)
    mission = create_mission(configuration, rig, planted.config)
    service = flying()
    with mission.held():
        found = with_socket(
            service,
            planted.folder / "c.sock",
            lambda: collect_results(configuration, rig, planted.config, fire=True),
        )
    reported = {(one.kind, one.name): (one.outcome, one.sentence) for one in found}
    assert reported["service", mission.id] == (CheckOutcome.PASS, "the service flies, phase ready")
    assert reported["head", "SUA"][0] is CheckOutcome.PASS
    assert reported["head", "SUB"] == (CheckOutcome.FAIL, "gone")
    assert reported["arming", "missing"] == (CheckOutcome.WAITING, "no position (wait)")
    assert reported["fault", "SUB"] == (CheckOutcome.FAIL, "gone")
    assert ("fault", "SUA") not in reported, "it has passed"
    assert not service.commands, "asking is no command, and nothing goes to the log"
    assert worst_outcome(found) is CheckOutcome.FAIL


def test_a_service_that_does_not_answer_fails_and_one_without_a_socket_is_waited_for(
    planted: Planted,
) -> None:
    configuration, rig = load(planted.config)
    mission = create_mission(configuration, rig, planted.config)
    assert not mission.is_held()
    with mission.held():
        (silent,) = collect_results(configuration, rig, planted.config, fire=False)
        planted.service = planted.service.replace('control = "c.sock"', "")
        planted.write()
        (deaf,) = collect_results(*load(planted.config), planted.config, fire=False)
    assert silent.outcome is CheckOutcome.FAIL and "does not answer" in silent.sentence
    assert deaf.outcome is CheckOutcome.WAITING and "[watch] control" in deaf.sentence
    assert mission.id in deaf.sentence


def test_the_exit_status_is_that_of_the_worst_finding() -> None:
    well, late = (
        passed("disk", "pace"),
        CheckResult("stream", "gnss", CheckOutcome.WAITING, "searching"),
    )
    ill, idle = failed("head", "SUA", "gone"), CheckResult("stream", "f", CheckOutcome.NOT_TRIED)
    cases = (([], 0), ([well, idle], 0), ([well, late], 3), ([late, ill, well], 1))
    for results, status in cases:
        assert STATUSES[worst_outcome(results).value] == status


def _nothing_is_opened(*_: object, **__: object) -> list[CheckResult]:
    raise AssertionError("devices are the running service's")
