"""Commands, obeyed or refused, are on the disk at once."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from daemon.mission.log.flight_log import FlightLog, LogReader, read
from daemon.mission.log.log_records import Message
from daemon.onboard.service.command_execution import CommandHandlers
from daemon.onboard.service.message_dispatcher import MessageDispatcher
from daemon.onboard.service.messages import Answer, AppendToLog, CommandRefused, ServiceCommand
from daemon.onboard.storage.writer import _Writer
from tests.daemon.onboard.service.test_command_execution import FakeService

pytestmark = pytest.mark.trust


class Flight(FakeService):
    """Takes commands as the service does, and remembers what it sends to whom."""

    def __init__(self) -> None:
        super().__init__()
        self.sent: list[tuple[str, AppendToLog]] = []
        self.answers: list[Answer] = []
        self.events: list[dict[str, Any]] = []
        commands = CommandHandlers(
            self,
            self.answers.append,
            lambda *sent: self.sent.append(sent),
            lambda event, **content: self.events.append({"event": event, **content}),
        )
        self._dispatcher = MessageDispatcher()
        self._dispatcher.add(commands.handlers)

    def receive(self, message: object) -> None:
        self._dispatcher.dispatch(message)


def synced(folder: Path) -> list[Message]:
    """The messages of a log up to its last byte known to be on the disk."""
    (path,) = folder.glob("*.mcap")
    reader: LogReader = read(path)
    messages = list(reader)
    assert reader.bad_checkpoints == 0
    return messages


def test_a_command_and_a_refusal_are_in_the_flight_log_and_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight = Flight()
    flight.receive(ServiceCommand(1, "trigger", {}, "anna", "operator", "10.0.0.9"))
    flight.receive(ServiceCommand(2, "acknowledge", {"fault": "x"}, "eva", "administrator", "unix"))
    flight.receive(CommandRefused("land", "unknown", "none", "10.0.0.66", "no", 7))
    assert [answer.done for answer in flight.answers] == [True, False]
    assert [(one["event"], one["name"]) for one in flight.events] == [
        ("command", "trigger"),
        ("command", "acknowledge"),
        ("command-refused", "land"),
    ]
    log = FlightLog.create(tmp_path)
    writing = _Writer(None, SimpleNamespace(log=log), {})
    syncs = []
    really_sync = log.sync
    monkeypatch.setattr(log, "sync", lambda: (syncs.append(1), really_sync()))
    writing.handle(AppendToLog(Message("raw/gnss", 1, b"x")))
    assert not syncs, "what devices send is synced once a second"
    for i, (process, order) in enumerate(flight.sent, start=1):
        assert process == "writer"
        writing.handle(order)
        assert len(syncs) == i
    reported = [json.loads(one.payload) for one in synced(tmp_path) if one.topic == "audit"]
    assert [(one["by"], one["role"], one["address"], one["done"]) for one in reported] == [
        ("anna", "operator", "10.0.0.9", True),
        ("eva", "administrator", "unix", False),
        ("unknown", "none", "10.0.0.66", False),
    ]
    assert reported[2]["refused"] is True and reported[2]["count"] == 7
