"""A page process that tests attack over its socket, and the requests of attacker and operator."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress
from pathlib import Path

from daemon.configuration.model import WatchSection
from daemon.onboard.monitoring.access.tokens import add_token
from daemon.onboard.service.messages import Answer, ServiceCommand, ServiceEvent, Stop
from daemon.onboard.service.processes import ChildProcess
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.test_watchers import resident_kb
from tests.support.stopwatch import Stopwatch

ATTACKER, OPERATOR = "127.0.0.2", "127.0.0.3"


class Page:
    """A page process, its token, and the service's end of it."""

    def __init__(self, folder: Path, **settings: object) -> None:
        self.token = add_token(folder / "tokens.toml", "operator", "operator")
        section = WatchSection(
            host="127.0.0.1", port=0, announce=False, tokens=folder / "tokens.toml", **settings
        )
        self.child = ChildProcess(
            "watch", "daemon.onboard.monitoring.monitoring_process:main", (section,), {}
        )
        assert self.child.connection.poll(60)
        self.port = int(self.child.connection.recv().event["port"])
        self.child.try_send(ServiceEvent(flight_events.mission()))
        self.commands: list[str] = []
        self._ends = threading.Event()
        self._obeying = threading.Thread(target=self._execute)
        self._obeying.start()

    def _execute(self) -> None:
        while not self._ends.is_set():
            if self.child.connection.poll(0.05):
                message = self.child.connection.recv()
                if isinstance(message, ServiceCommand):
                    self.commands.append(message.name)
                    self.child.send(Answer(message.number, True, "done as asked"))

    @property
    def resident_kb(self) -> int:
        return resident_kb(self.child.process.pid or 0)

    def connect(self, source: str = ATTACKER) -> socket.socket:
        link = socket.create_connection(("127.0.0.1", self.port), 10.0, (source, 0))
        link.settimeout(20.0)
        return link

    def request(self, request: bytes, source: str = ATTACKER) -> tuple[int, bytes]:
        """The status of the first answer, and everything until the server closes."""
        with self.connect(source) as link:
            with suppress(ConnectionError):  # refused before all of it was sent
                link.sendall(request)
            return status_of(read_all(link))

    def stop_command(self, source: str) -> tuple[int, float]:
        """An operator's command; its status and how long it took, in seconds."""
        watch = Stopwatch()
        status, _ = self.request(command(self.token), source)
        return status, watch.own_s

    def end(self) -> None:
        self._ends.set()
        self._obeying.join()
        self.child.send(Stop())
        self.child.end(10.0)


def command(token: str, *headers: str, name: str = "stop", body: bytes = b"") -> bytes:
    lines = [
        f"POST /api/v1/commands/{name} HTTP/1.1",
        "Host: 127.0.0.1",
        "Connection: close",
        *([f"Authorization: Bearer {token}"] if token else []),
        *(["Content-Type: application/json", f"Content-Length: {len(body)}"] if body else []),
        *headers,
    ]
    return "\r\n".join([*lines, "", ""]).encode() + body


def get(path: str, *headers: str, host: str = "127.0.0.1") -> bytes:
    return "\r\n".join([f"GET {path} HTTP/1.1", f"Host: {host}", *headers, "", ""]).encode()


def upgrade(query: str = "", *headers: str, host: str = "127.0.0.1") -> bytes:
    return get(
        f"/api/v1/telemetry?form=json{query}",
        *("Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"),
        *("Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==", *headers),
        host=host,
    )


def read_all(link: socket.socket) -> bytes:
    read = b""
    try:
        while piece := link.recv(65536):
            read += piece
    except (ConnectionError, TimeoutError):
        pass
    return read


def status_of(answer: bytes) -> tuple[int, bytes]:
    return (int(answer.split(b" ", 2)[1]), answer) if answer.startswith(b"HTTP/1.1 ") else (0, b"")
