"""Admission of a WebSocket client that watches: the same for every stream."""

from __future__ import annotations

from typing import Final, Protocol

from fastapi import WebSocket
from starlette.requests import HTTPConnection

from daemon.onboard.monitoring.web.connections import (
    WATCHERS_MAX,
    ClientConnection,
    Connections,
    ConnectionUse,
)
from daemon.onboard.monitoring.web.request_filter import CONNECTION

SUBPROTOCOL: Final = "syntopic.v1"


class WatchAccess(Protocol):
    """Decides who may read; implemented by the application."""

    connections: Connections

    def may_watch(self, http: HTTPConnection) -> bool: ...


async def admit_watcher(socket: WebSocket, access: WatchAccess) -> bool:
    """Accept a client that may read while there is room, or close its socket with the reason.

    Args:
        socket: not accepted yet.
        access: authorizes and counts readers.

    Returns:
        Whether the socket is accepted.
    """
    if "token" in socket.query_params:
        await socket.close(1008, "a token belongs into a header, not into the address")
        return False
    if not access.may_watch(socket):
        await socket.close(1008, "a token is needed")
        return False
    connection = connection_of(socket)
    if not access.connections.may_watch(connection):
        await socket.close(1013, f"too many clients: {WATCHERS_MAX}")
        return False
    if connection is not None:
        connection.enter(ConnectionUse.WATCHER)
    offered = socket.scope.get("subprotocols", [])
    await socket.accept(SUBPROTOCOL if SUBPROTOCOL in offered else None)
    return True


def connection_of(http: HTTPConnection) -> ClientConnection | None:
    """The TCP connection a request came on; None in tests without a server."""
    found = http.scope.get("state", {}).get(CONNECTION)
    return found if isinstance(found, ClientConnection) else None
