"""Request filters before the application: source address, cross-site requests of browsers, and rate
limits.

Tokens and roles are checked by the application, for each route.
"""

from __future__ import annotations

import ipaddress
import json
import re
import socket
from collections.abc import Awaitable, Callable, Collection, MutableMapping
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

from daemon.onboard.monitoring.server_messages import with_message
from daemon.onboard.monitoring.web.connections import (
    REQUESTS_PER_CONNECTION,
    ClientConnection,
    Connections,
    ConnectionUse,
    source_of,
)

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Application = Callable[[Scope, Receive, Send], Awaitable[None]]

CHUNK_BYTES = 65_536
"""An answer is handed over in pieces, each after the last has left: a slow reader holds no more."""
CONNECTION = "connection"
"""Key of the state of a request under which its connection is found."""
_HOST = re.compile(r"(?P<name>[A-Za-z0-9.\-_]{1,255}|\[[0-9A-Fa-f:.]{2,60}\])(?::[0-9]{1,5})?")
_DEFAULT_PORTS = {"http": ":80", "https": ":443"}


class ConnectionTracker:
    """Outermost: marks a connection as used, and bounds requests and answers on it."""

    def __init__(self, application: Application, connections: Connections) -> None:
        self._application = application
        self._connections = connections

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        connection = self._connections.of(scope.get("client"))
        if connection is None:
            await self._application(scope, receive, send)
            return
        scope.setdefault("state", {})[CONNECTION] = connection
        connection.requests += 1
        sending = _in_chunks(send, connection) if scope["type"] == "http" else send
        try:
            await self._application(scope, receive, sending)
        finally:
            connection.enter(ConnectionUse.IDLE)


def _in_chunks(send: Send, connection: ClientConnection) -> Send:
    async def send_pieces(message: Message) -> None:
        if message["type"] == "http.response.start":
            if connection.requests >= REQUESTS_PER_CONNECTION:
                headers = [*message.get("headers", ()), (b"connection", b"close")]
                message = {**message, "headers": headers}
        elif message["type"] == "http.response.body":
            body, more = message.get("body", b""), message.get("more_body", False)
            while len(body) > CHUNK_BYTES:
                await send({**message, "body": body[:CHUNK_BYTES], "more_body": True})
                body = body[CHUNK_BYTES:]
            message = {**message, "body": body, "more_body": more}
        await send(message)

    return send_pieces


class RequestFilter:
    """Checks Host, Origin and rate.

    Args:
        application: what is guarded.
        connections: the table of connections.
        hosts: names that the configuration lists.
        is_authenticated: whether a token is valid; such requests have no rate.
    """

    def __init__(
        self,
        application: Application,
        connections: Connections,
        hosts: Collection[str],
        is_authenticated: Callable[[str], bool],
    ) -> None:
        self._application = application
        self._connections = connections
        self._hosts = local_host_names() | {name.lower() for name in hosts}
        self._is_authenticated = is_authenticated

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._application(scope, receive, send)
            return
        connection: ClientConnection | None = scope.get("state", {}).get(CONNECTION)
        refusal = self._refusal(scope, connection)
        if refusal is not None:
            await _refuse(scope, send, *refusal)
            return
        if connection is not None:
            connection.enter(ConnectionUse.REQUEST)
        await self._application(scope, receive, send)

    def _refusal(self, scope: Scope, connection: ClientConnection | None) -> tuple[int, str] | None:
        headers = scope["headers"]
        hosts = [value.decode("latin-1") for name, value in headers if name == b"host"]
        origins = [value.decode("latin-1") for name, value in headers if name == b"origin"]
        if len(hosts) != 1 or not is_allowed_host(hosts[0], self._hosts):
            return 421, (
                "this host name is not served; use the address, or add the name to [watch] hosts"
            )
        if any(not is_same_origin(origin, hosts[0]) for origin in origins):
            return 403, "a page from elsewhere may not use this service"
        token = bearer_token(headers)
        if token is not None and self._is_authenticated(token):
            if connection is not None:
                connection.is_authenticated = True
            return None
        client = scope.get("client")
        source = source_of(client[0]) if client else ""
        if not self._connections.may_request(source):
            return 429, "too many requests from this address; a valid token has no such limit"
        return None


def local_host_names() -> frozenset[str]:
    """Names of this machine that need no name server: localhost and multicast DNS."""
    return frozenset({"localhost", f"{socket.gethostname()[:40]}.local".lower()})


def is_allowed_host(host: str, names: Collection[str]) -> bool:
    """Whether a Host header names this service: by an IP address, or one of `names`."""
    found = _HOST.fullmatch(host)
    if found is None:
        return False
    name = found["name"].lower().rstrip(".")
    if name in names:
        return True
    try:
        ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        return False
    return True


def is_same_origin(origin: str, host: str) -> bool:
    """Whether the page of a request has the same name and port as the request."""
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    if parts.scheme not in _DEFAULT_PORTS or parts.path or parts.query or parts.fragment:
        return False
    default = _DEFAULT_PORTS[parts.scheme]
    return parts.netloc.lower().removesuffix(default) == host.lower().removesuffix(default)


def bearer_token(headers: Collection[tuple[bytes, bytes]]) -> str | None:
    """The token of an Authorization header, or among the subprotocols of a WebSocket.

    A browser can set no other header of a WebSocket; in an address a token would end up in logs.
    """
    named = {name: value.decode("latin-1") for name, value in headers}
    found = re.fullmatch(r"[Bb]earer +(\S{1,200})", named.get(b"authorization", ""))
    if found is None:
        offered = named.get(b"sec-websocket-protocol", "")
        found = re.search(r"(?:^|,)\s*bearer\.([^\s,]{1,200})\s*(?:,|$)", offered)
    return found.group(1) if found else None


async def _refuse(scope: Scope, send: Send, status: int, detail: str) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008, "reason": detail})
        return
    title = HTTPStatus(status).phrase
    problem = {"type": "about:blank", "title": title, "status": status, "detail": detail}
    problem = with_message(problem, "detail")
    headers = [(b"content-type", b"application/problem+json"), (b"connection", b"close")]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": json.dumps(problem).encode()})
