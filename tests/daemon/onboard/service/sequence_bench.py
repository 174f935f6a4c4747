"""An exposure sequence without processes: messages in, messages and events out."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

from daemon.onboard.flight.decisions import Decision, decision_of
from daemon.onboard.pipeline.pipeline_queue import PipelineQueue
from daemon.onboard.service.exposure_sequence import ExposureSequence
from daemon.onboard.service.message_dispatcher import MessageDispatcher
from daemon.onboard.service.messages import AppendToLog
from tests.daemon.onboard.flight.test_flight import flight


class SequenceBench:
    """The sequence of a flight; records what it sends to each process, logs and emits."""

    def __init__(self, *, has_pps: bool = True, parallel_exposures: int = 1) -> None:
        self.flight = flight(has_pps=has_pps)
        self.now_ns = 0
        self.queue = PipelineQueue(parallel_exposures)
        self.sent: dict[str, list[Any]] = defaultdict(list)
        self.logged: list[str] = []
        self.decisions: list[Decision] = []
        self.events: list[tuple[str, Any]] = []
        self.histograms: list[int] = []
        self.sequence = ExposureSequence(
            self.flight,
            self.queue,
            self._send,
            lambda event, **content: self.events.append((event, content.get("number"))),
            lambda number, _counts: self.histograms.append(number),
            lambda: self.now_ns,
        )
        self._dispatcher = MessageDispatcher()
        self._dispatcher.add(self.sequence.handlers)

    def receive(self, message: object) -> None:
        self._dispatcher.dispatch(message)

    def _send(self, name: str, message: object) -> None:
        if isinstance(message, AppendToLog):
            self.logged.append(message.message.topic)
            if (decision := decision_of(message.message)) is not None:
                self.decisions.append(decision)
        else:
            self.sent[name].append(message)
