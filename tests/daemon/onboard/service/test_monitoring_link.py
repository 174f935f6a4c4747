"""Events for a busy watch process are sent later, in order; nothing waits."""

from __future__ import annotations

from typing import Any, cast

import pytest

from daemon.mission.exposure import TemperatureRecord
from daemon.onboard.service.messages import ServiceEvent
from daemon.onboard.service.monitoring_link import (
    BACKLOG_MAX,
    MonitoringLink,
    present_temperatures_c,
)
from daemon.onboard.service.startup import ProcessPlan
from daemon.onboard.service.supervisor import Supervisor

PLAN = ProcessPlan("watch", "nothing:main", (), {})


class Line:
    """The line to a process, that may be full."""

    def __init__(self) -> None:
        self.is_full = False
        self.sent: list[Any] = []

    def try_send(self, _name: str, message: object) -> bool:
        assert isinstance(message, ServiceEvent)
        if message.event.get("event") == "huge":
            raise ValueError("too large")
        if not self.is_full:
            self.sent.append(message.event["number"])
        return not self.is_full

    def spawn(self, *_plan: object) -> None:
        self.sent.clear()


def link() -> tuple[MonitoringLink, Line]:
    line = Line()
    return MonitoringLink(cast(Supervisor, line), PLAN), line


def test_events_that_did_not_fit_are_sent_before_the_next_one() -> None:
    seen, line = link()
    line.is_full = True
    for number in (1, 2, 3):
        seen.emit({"event": "device", "number": number})
    assert line.sent == []
    line.is_full = False
    seen.emit({"event": "status", "number": 4})
    assert line.sent == [1, 2, 3, 4] and seen.dropped == 0


def test_what_is_held_is_bounded_and_one_that_never_fits_holds_up_nothing() -> None:
    seen, line = link()
    line.is_full = True
    for number in range(BACKLOG_MAX + 5):
        seen.emit({"event": "device", "number": number})
    line.is_full = False
    seen.emit({"event": "huge"})
    seen.emit({"event": "status", "number": -1})
    assert line.sent == [*range(6, BACKLOG_MAX + 5), -1]
    assert seen.dropped == 7


def test_a_restarted_process_receives_the_persistent_events() -> None:
    seen, line = link()
    seen.emit({"event": "mission", "number": 1})
    seen.emit({"event": "bound", "device": "SU02", "number": 2})
    seen.emit({"event": "device", "device": "SU02", "name": "opened", "number": 3})
    seen.emit({"event": "device", "device": "SU02", "name": "corrupt", "number": 4})
    seen.emit({"event": "exposure-settings", "number": 5})
    seen.emit({"event": "device", "device": "SU02", "name": "lost", "number": 6})
    seen.emit({"event": "exposure-settings", "number": 7})
    seen.emit({"event": "counters", "number": 8})
    seen.emit({"event": "counters", "number": 9})
    seen.start()
    assert line.sent == [1, 2, 6, 7, 9]


@pytest.mark.trust
def test_an_old_temperature_is_not_reported_as_the_present_one() -> None:
    readings = [
        TemperatureRecord("0", 21.5, 9_000_000_000),
        TemperatureRecord("1", 22.5, 11 * 10**9),
    ]
    assert present_temperatures_c(readings, 10.0) == {"0": 21.5, "1": None}
