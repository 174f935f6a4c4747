"""A command is executed, or refused with a reason."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pytest

from daemon.onboard.flight.arming import MissingPrerequisite
from daemon.onboard.service.command_execution import (
    audit_message,
    execute,
    refusal_event,
    refusal_message,
)
from daemon.onboard.service.messages import CommandRefused, ServiceCommand

pytestmark = pytest.mark.trust


@dataclass
class FakeLine:
    is_running: bool = False
    is_flown: bool = False
    done: list[Any] = field(default_factory=list)

    def trigger_once(self) -> None:
        self.done.append("once")

    def trigger_at_interval(self, interval_s: float, count: int) -> None:
        self.done.append((interval_s, count))

    def trigger_at_distance(self, distance_m: float) -> None:
        self.done.append(distance_m)


@dataclass
class FakeLanded:
    is_entered: bool = False
    running: str = ""
    requests: list[tuple[str, str | None, str]] = field(default_factory=list)
    audited: list[Mapping[str, Any]] = field(default_factory=list)

    def request(self, action: str, folder: str | None, by: str) -> str | None:
        self.requests.append((action, folder, by))
        return None if self.is_entered else "the flight has not ended; land first"

    def audit(self, content: Mapping[str, Any]) -> None:
        self.audited.append(content)


@dataclass
class FakeService:
    line: FakeLine = field(default_factory=FakeLine)
    is_ready: bool = True
    missing: list[MissingPrerequisite] = field(default_factory=list)
    has_landed: bool = False
    overrides: list[tuple[str, list[str], str]] = field(default_factory=list)
    armed: int = 0
    faults: set[str] = field(default_factory=set)
    exposed: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    continues: bool = False
    landed: FakeLanded = field(default_factory=FakeLanded)

    @property
    def preflight(self) -> FakeService:
        return self

    def missing_prerequisites(self) -> Sequence[MissingPrerequisite]:
        return self.missing

    def arm(self) -> None:
        self.armed += 1

    def override(self, by: str, missing: Sequence[MissingPrerequisite], reason: str = "") -> None:
        self.overrides.append((by, [item.name for item in missing], reason))

    def acknowledge(self, fault: str) -> bool:
        return fault in self.faults

    @property
    def exposure(self) -> FakeService:
        return self

    @property
    def mirror(self) -> FakeService:
        return self

    def release(self, label: str) -> str | None:
        self.line.done.append(f"release {label}")
        return None if label == "mirror" else f"there is no disk {label!r}"

    def accept(self, label: str) -> str | None:
        self.line.done.append(f"accept {label}")
        return None if label == "mirror" else f"there is no disk {label!r}"

    def command(self, wanted: Mapping[str, Any], by: str) -> str | None:
        if wanted.get("gain_db", 0) > 12:
            return "gain_db is too much"
        self.exposed.append((by, dict(wanted)))
        return None

    def land(self, *, new_mission: bool = False) -> None:
        self.has_landed, self.continues = True, new_mission


KERNELS = MissingPrerequisite(
    "arming-kernels", "kernels are not loaded", "wait", may_be_overridden=False
)


def send(service: FakeService, name: str, **arguments: Any) -> tuple[bool, str]:
    answer = execute(ServiceCommand(7, name, arguments, "operator"), service)
    assert answer.number == 7
    return answer.done, answer.sentence


def test_the_line_is_started_and_stopped() -> None:
    service = FakeService()
    assert send(service, "stop") == (False, "the line does not run")
    assert send(service, "start")[0]
    assert service.line.is_running
    assert send(service, "start") == (False, "the line runs already")
    assert send(service, "stop")[0]
    assert not service.line.is_running


@pytest.mark.parametrize(
    ("name", "arguments", "did"),
    [
        ("trigger", {}, "once"),
        ("interval", {"interval_s": 2.5, "count": 4}, (2.5, 4)),
        ("interval", {"interval_s": 2}, (2.0, 0)),
        ("distance", {"distance_m": 80}, 80.0),
    ],
)
def test_exposures_are_asked_for(name: str, arguments: dict[str, Any], did: Any) -> None:
    service = FakeService()
    assert send(service, name, **arguments)[0]
    assert service.line.done == [did]


@pytest.mark.parametrize("name", ["arm", "start", "trigger", "interval", "distance"])
def test_a_camera_that_is_not_ready_is_not_armed_unless_somebody_takes_it_upon_them(
    name: str,
) -> None:
    how = {"interval_s": 1.0, "distance_m": 10.0}
    done, sentence = send(FakeService(is_ready=False), name, **how)
    assert (done, "not ready" in sentence) == (False, True)
    head = MissingPrerequisite("arming-device", "no head SU02", "check its cable")
    not_overridable = FakeService(missing=[head])
    done, sentence = send(not_overridable, name, **how)
    assert not done
    assert "no head SU02 (check its cable); override to fly without" in sentence
    assert (not_overridable.overrides, not_overridable.armed) == ([], 0)
    assert send(not_overridable, name, override=True, reason="no need of it", **how)[0]
    assert not_overridable.armed == 1
    assert not_overridable.overrides == [("operator", ["arming-device"], "no need of it")]
    done, sentence = send(FakeService(line=FakeLine(is_flown=True)), name, **how)
    assert (done, "is flown" in sentence) == (False, True)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("interval", {}),
        ("interval", {"interval_s": 0}),
        ("interval", {"interval_s": float("nan")}),
        ("interval", {"interval_s": True}),
        ("interval", {"interval_s": 1.0, "count": -1}),
        ("distance", {"distance_m": -5}),
        ("format-the-disk", {}),
    ],
)
def test_what_makes_no_sense_is_refused(name: str, arguments: dict[str, Any]) -> None:
    service = FakeService()
    assert not send(service, name, **arguments)[0]
    assert service.line.done == []


def test_nobody_can_take_upon_them_that_kernels_compile_in_flight() -> None:
    service = FakeService(missing=[KERNELS])
    done, sentence = send(service, "start", override=True)
    assert (done, "override to fly" in sentence, service.overrides) == (False, False, [])


def test_only_a_fault_that_is_listed_can_be_acknowledged() -> None:
    service = FakeService(faults={"device SU02"})
    assert send(service, "acknowledge", fault="device SU02")[0]
    assert not send(service, "acknowledge", fault="device SU03")[0]


def test_a_new_mission_closes_this_one_unless_its_line_still_runs() -> None:
    service = FakeService()
    service.line.is_running = True
    assert send(service, "new-mission") == (False, "the line runs; stop it first")
    assert not service.has_landed
    service.line.is_running = False
    assert send(service, "new-mission")[0]
    assert (service.has_landed, service.continues) == (True, True)
    service = FakeService()
    assert send(service, "land")[0]
    assert not service.continues


def test_exposure_settings_are_handed_on_with_who_wants_them() -> None:
    service = FakeService()
    assert send(service, "exposure", gain_db=3.0, of="pan")[0]
    assert service.exposed == [("operator", {"gain_db": 3.0, "of": "pan"})]
    assert send(service, "exposure", gain_db=30.0) == (False, "gain_db is too much")


def test_landing_is_never_refused() -> None:
    service = FakeService(is_ready=False, missing=[KERNELS])
    assert send(service, "land")[0]
    assert service.has_landed


def test_each_command_is_written_down_with_who_gave_it() -> None:
    command = ServiceCommand(1, "start", {"override": True}, "anna", "operator", "10.0.0.9")
    message = audit_message(command, execute(command, FakeService()))
    content = json.loads(message.payload)
    assert message.topic == "audit"
    assert content == {
        "address": "10.0.0.9",
        "arguments": {"override": True},
        "by": "anna",
        "role": "operator",
        "command": "start",
        "done": True,
        "sentence": "the line runs",
    }


def test_a_disk_is_released_and_accepted_by_its_name() -> None:
    service = FakeService()
    assert send(service, "release-disk", disk="mirror")[0]
    assert send(service, "accept-disk", disk="mirror")[0]
    assert send(service, "release-disk") == (False, "there is no disk ''")
    assert send(service, "accept-disk", disk="other") == (False, "there is no disk 'other'")
    assert service.line.done == ["release mirror", "accept mirror", "release ", "accept other"]


def test_a_refused_command_is_written_down_with_role_address_and_count() -> None:
    refused = CommandRefused("land", "pilot", "observer", "10.0.0.9", "land needs operator", 3)
    message = refusal_message(refused)
    assert (message.topic, json.loads(message.payload)["done"]) == ("audit", False)
    content = json.loads(message.payload)
    assert (content["command"], content["by"], content["role"]) == ("land", "pilot", "observer")
    assert (content["address"], content["count"]) == ("10.0.0.9", 3)
    assert refusal_event(refused)["event"] == "command-refused"
