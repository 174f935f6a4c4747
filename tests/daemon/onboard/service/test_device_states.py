"""Devices are followed by what they report; counters reach watchers when they change."""

from __future__ import annotations

from typing import Any

from daemon.onboard.capture.device_states import DeviceStates
from daemon.onboard.service.message_dispatcher import MessageDispatcher
from daemon.onboard.service.messages import BindFailed, Bound, Pong
from drivers.contract import DeviceEvent
from tests.daemon.onboard.flight.test_flight import NS, flight, fly_one


class Followed:
    """The states of devices, and what was logged and emitted of them."""

    def __init__(self) -> None:
        self.flight = flight()
        self.logged: list[DeviceEvent] = []
        self.events: list[tuple[str, Any]] = []
        self.states = DeviceStates(
            self.flight,
            self.logged.append,
            lambda event, **content: self.events.append((event, content["device"])),
        )
        self._dispatcher = MessageDispatcher()
        self._dispatcher.add(self.states.handlers)

    def receive(self, *messages: object) -> None:
        for message in messages:
            self._dispatcher.dispatch(message)


def changed(device: str, name: str) -> DeviceEvent:
    return DeviceEvent(device, name, name != "opened", "a sentence", NS)


def test_a_device_delivers_from_its_opening_until_it_is_lost() -> None:
    followed = Followed()
    followed.receive(Bound("head", "G", {"serial": "7"}), Bound("trigger", "trigger", {}))
    assert followed.states.serials == {"G": "7"} and followed.states.has_trigger
    assert not followed.states.delivering
    followed.receive(changed("G", "opened"), changed("gnss", "opened"), changed("G", "corrupt"))
    assert followed.states.delivering == {"G", "gnss"}
    followed.receive(changed("G", "silent"))
    assert followed.states.delivering == {"gnss"}
    assert [event.name for event in followed.logged] == ["opened", "opened", "corrupt", "silent"]
    assert followed.events[0] == ("bound", "G") and len(followed.events) == 6


def test_a_head_that_does_not_answer_is_not_awaited_until_it_is_opened() -> None:
    followed = Followed()
    followed.receive(BindFailed("head", "G", "no answer"))
    assert [(event.device, event.name) for event in followed.logged] == [("G", "absent")]
    fly_one(followed.flight, 1, 0.0, ("SU00", "SU10"))
    assert followed.flight.advance(NS).store
    followed.receive(changed("G", "opened"))
    fly_one(followed.flight, 2, 2.0, ("SU00", "SU10"))
    assert not followed.flight.advance(3 * NS).store


def test_counters_are_reported_when_they_change() -> None:
    followed = Followed()
    assert followed.states.changed_counters() is None
    followed.receive(Pong({"G": {"frames": 1}}), Pong({}))
    event = {"event": "counters", "devices": {"G": {"frames": 1}}}
    assert followed.states.changed_counters() == event
    followed.receive(Pong({"G": {"frames": 1}}))
    assert followed.states.changed_counters() is None
    followed.receive(Pong({"G": {"frames": 2}}))
    assert followed.states.changed_counters() is not None
