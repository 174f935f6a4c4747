"""A command is done, or refused in a sentence that says why; nothing in between."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

import pytest

from daemon.commanding import audit_message, obey
from daemon.messages import Command


@dataclass
class FakeLine:
    runs: bool = False
    is_flown: bool = False
    done: list[Any] = field(default_factory=list)

    def trigger_once(self) -> None:
        self.done.append("once")

    def trigger_each(self, interval_s: float, count: int) -> None:
        self.done.append((interval_s, count))

    def trigger_along(self, distance_m: float) -> None:
        self.done.append(distance_m)


@dataclass
class FakeService:
    line: FakeLine = field(default_factory=FakeLine)
    is_ready: bool = True
    missing: list[str] = field(default_factory=list)
    landed: bool = False

    def absent(self) -> list[str]:
        return self.missing

    def land(self) -> None:
        self.landed = True


def give(service: FakeService, name: str, **arguments: Any) -> tuple[bool, str]:
    answer = obey(Command(7, name, arguments, "operator"), service)
    assert answer.number == 7
    return answer.done, answer.sentence


def test_the_line_is_started_and_stopped() -> None:
    service = FakeService()
    assert give(service, "stop") == (False, "the line does not run")
    assert give(service, "start")[0]
    assert service.line.runs
    assert give(service, "start") == (False, "the line runs already")
    assert give(service, "stop")[0]
    assert not service.line.runs


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
    assert give(service, name, **arguments)[0]
    assert service.line.done == [did]


@pytest.mark.parametrize("name", ["start", "trigger", "interval", "distance"])
def test_a_camera_that_is_not_ready_is_not_armed_unless_somebody_takes_it_upon_them(
    name: str,
) -> None:
    how = {"interval_s": 1.0, "distance_m": 10.0}
    done, sentence = give(FakeService(is_ready=False), name, **how)
    assert (done, "not ready" in sentence) == (False, True)
    lacking = FakeService(missing=["head SU02", "trigger"])
    done, sentence = give(lacking, name, **how)
    assert not done
    assert "head SU02, trigger" in sentence
    assert give(lacking, name, override=True, **how)[0]
    done, sentence = give(FakeService(line=FakeLine(is_flown=True)), name, **how)
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
    assert not give(service, name, **arguments)[0]
    assert service.line.done == []


def test_landing_is_never_refused() -> None:
    service = FakeService(is_ready=False, missing=["everything"])
    assert give(service, "land")[0]
    assert service.landed


def test_each_command_is_written_down_with_who_gave_it() -> None:
    command = Command(1, "start", {"override": True}, "operator")
    message = audit_message(command, obey(command, FakeService()))
    told = json.loads(message.payload)
    assert message.topic == "audit"
    assert told == {
        "arguments": {"override": True},
        "by": "operator",
        "command": "start",
        "done": True,
        "sentence": "the line runs",
    }
