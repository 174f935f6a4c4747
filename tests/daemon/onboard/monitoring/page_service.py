"""The service's end of the process that serves the page, for tests."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from daemon.configuration.model import PlanSection, WatchSection
from daemon.onboard.monitoring.access.tokens import add_token
from daemon.onboard.service.messages import Answer, ServiceCommand, ServiceEvent, Stop
from daemon.onboard.service.processes import ChildProcess

WITHIN_S = 30.0


class Service:
    """The service's end of the watch process, in the hands of the test."""

    def __init__(
        self,
        folder: Path,
        *,
        port: int = 0,
        anonymous_read: bool = True,
        plan: PlanSection | None = None,
        **further: Any,
    ) -> None:
        self.token = add_token(folder / "tokens.toml", "operator", "administrator")
        tokens = folder / "tokens.toml"
        settings = WatchSection(
            port=port, tokens=tokens, announce=False, anonymous_read=anonymous_read, **further
        )
        self.child = ChildProcess(
            "watch", "daemon.onboard.monitoring.monitoring_process:main", (settings, plan), {}
        )
        self.commands: list[ServiceCommand] = []
        self.events: list[Mapping[str, Any]] = []
        self.refusal = ""
        self.address = ""
        self.until(lambda: bool(self.address))

    def emit(self, event: dict[str, Any]) -> None:
        assert self.child.try_send(ServiceEvent(event))

    def until(self, is_so: Any, within_s: float = 60.0) -> None:
        deadline = time.monotonic() + within_s
        while not is_so():
            assert time.monotonic() < deadline, "the watch process is silent"
            if self.child.connection.poll(0.05):
                self.receive(self.child.connection.recv())

    def receive(self, message: object) -> None:
        if isinstance(message, ServiceEvent):
            self.events.append(message.event)
        if isinstance(message, ServiceEvent) and message.event.get("event") == "watching":
            scheme = "https" if message.event["tls"] else "http"
            self.address = f"{scheme}://{message.event['host']}:{message.event['port']}/"
        elif isinstance(message, ServiceCommand):
            self.commands.append(message)
            refuses = self.refusal and not message.arguments["override"]
            sentence = self.refusal if refuses else "done as asked"
            self.child.send(Answer(message.number, not refuses, sentence))

    def end(self) -> None:
        self.child.send(Stop())
        self.child.end(10.0)
