"""What is done with requests and answers on their way to and from the application."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator

import pytest

from daemon.onboard.monitoring.web.connections import (
    REQUESTS_PER_CONNECTION,
    ClientConnection,
    Connections,
    ConnectionUse,
)
from daemon.onboard.monitoring.web.request_filter import (
    CHUNK_BYTES,
    ConnectionTracker,
    Message,
    Receive,
    Scope,
    Send,
)

pytestmark = pytest.mark.trust
PEER = ("10.0.0.1", 1024)


@pytest.fixture
def connections() -> Iterator[Connections]:
    ours, theirs = socket.socketpair()
    table = Connections()
    assert table.admit(ours, *PEER)
    yield table
    ours.close()
    theirs.close()


def answered(connections: Connections, body: bytes) -> list[Message]:
    """What an application's answer becomes on its way out."""
    sent: list[Message] = []

    async def application(_scope: Scope, _receive: Receive, send: Send) -> None:
        one = connections.of(PEER)
        assert one is not None
        one.enter(ConnectionUse.REQUEST)
        await send({"type": "http.response.start", "status": 200, "headers": [(b"a", b"b")]})
        await send({"type": "http.response.body", "body": body})

    async def receive() -> Message:
        raise AssertionError("nothing is read")

    async def send(message: Message) -> None:
        sent.append(message)

    scope: Scope = {"type": "http", "client": PEER}
    asyncio.run(ConnectionTracker(application, connections)(scope, receive, send))
    return sent


@pytest.mark.parametrize("size", [0, 1, CHUNK_BYTES, CHUNK_BYTES + 1, 3 * CHUNK_BYTES])
def test_an_answer_leaves_in_pieces(connections: Connections, size: int) -> None:
    body = bytes(k % 251 for k in range(size))
    pieces = answered(connections, body)[1:]
    assert b"".join(one["body"] for one in pieces) == body
    assert max(len(one["body"]) for one in pieces) <= CHUNK_BYTES
    assert [one["more_body"] for one in pieces] == [True] * (len(pieces) - 1) + [False]


def test_a_connection_ends_after_many_requests_and_is_idle_after_each(
    connections: Connections,
) -> None:
    closes = []
    for _ in range(REQUESTS_PER_CONNECTION):
        start = answered(connections, b"")[0]
        closes.append((b"connection", b"close") in start["headers"])
        one = connections.of(PEER)
        assert isinstance(one, ClientConnection) and one.use is ConnectionUse.IDLE
    assert closes == [False] * (REQUESTS_PER_CONNECTION - 1) + [True]
