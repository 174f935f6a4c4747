"""Connections to the page server: how many, from where, and how long each may take.

The table sits where connections are accepted, so that it also bounds unfinished TLS handshakes.
A full table closes the least useful connection; it never refuses a new one while an anonymous
connection is open, so that unknown clients cannot exclude one with a valid token.
"""

from __future__ import annotations

import asyncio
import ipaddress
import socket
import time
from collections import Counter
from collections.abc import Collection, Iterable
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

CONNECTIONS_MAX = 384
CONNECTIONS_PER_SOURCE = 64
WATCHERS_MAX = 64
REQUESTS_AT_ONCE_MAX = 64
REQUESTS_AT_ONCE_PER_SOURCE = 16
"""Anonymous requests that are being answered; a browser has six."""
REQUESTS_PER_CONNECTION = 1000
IDLE_MAX_S = 30.0
"""From the TCP handshake, or the last answer, to the end of the next request's header."""
REQUEST_MAX_S = 120.0
"""Time limit of a request and its answer: a quick look over 25 kbit/s."""
SWEEP_S = 1.0
REQUESTS_PER_S, REQUESTS_BURST = 50.0, 400
"""Anonymous requests of one source."""
SOURCES_MAX = 4096


class ConnectionUse(IntEnum):
    """What a connection is used for; the less useful is closed first."""

    IDLE = 0
    REQUEST = 1
    WATCHER = 2


@dataclass(eq=False)
class ClientConnection:
    """One TCP connection.

    Attributes:
        source: address, or /64 network for IPv6.
        is_authenticated: a valid token was presented on it.
    """

    link: socket.socket
    source: str
    since_s: float
    use: ConnectionUse = ConnectionUse.IDLE
    requests: int = 0
    is_authenticated: bool = False

    def is_open(self) -> bool:
        return self.link.fileno() >= 0

    def enter(self, use: ConnectionUse) -> None:
        self.use = use
        self.since_s = time.monotonic()

    def abort(self) -> None:
        """Both directions end; the event loop closes the socket when it notices."""
        with suppress(OSError):
            self.link.shutdown(socket.SHUT_RDWR)


class Connections:
    """The table of open connections.

    Args:
        proxies: addresses of configured proxies, which carry many clients each.
    """

    def __init__(self, proxies: Collection[str] = ()) -> None:
        self._proxies = frozenset(proxies)
        self._by_peer: dict[tuple[str, int], ClientConnection] = {}
        self._rates: dict[str, tuple[float, float]] = {}
        self.closed = 0
        """Connections that were closed to make space."""

    def admit(self, link: socket.socket, host: str, port: int) -> bool:
        """Add a new connection; False where it has to be refused."""
        self._remove_closed()
        source = source_of(host)
        if host not in self._proxies:
            same = [one for one in self._by_peer.values() if one.source == source]
            if len(same) >= CONNECTIONS_PER_SOURCE and not self._close_one(same):
                return False
        all_open = self._by_peer.values()
        if len(all_open) >= CONNECTIONS_MAX and not self._close_one(all_open):
            return False
        self._by_peer[host, port] = ClientConnection(link, source, time.monotonic())
        return True

    def of(self, peer: Any) -> ClientConnection | None:
        """The connection of a peer's (host, port)."""
        return self._by_peer.get(tuple(peer)) if peer else None

    def may_request(self, source: str) -> bool:
        """Whether an anonymous request of a source is answered now: rate, and how many at once."""
        now_s = time.monotonic()
        left, then_s = self._rates.pop(source, (float(REQUESTS_BURST), now_s))
        left = min(REQUESTS_BURST, left + (now_s - then_s) * REQUESTS_PER_S)
        if len(self._rates) >= SOURCES_MAX:
            del self._rates[next(iter(self._rates))]
        self._rates[source] = (max(0.0, left - 1.0), now_s)
        busy = [
            c
            for c in self._by_peer.values()
            if c.use is ConnectionUse.REQUEST and not c.is_authenticated
        ]
        of_source = sum(1 for one in busy if one.source == source)
        return (
            left >= 1.0
            and len(busy) < REQUESTS_AT_ONCE_MAX
            and of_source < REQUESTS_AT_ONCE_PER_SOURCE
        )

    def may_watch(self, new_connection: ClientConnection | None) -> bool:
        """Whether one more client is served; if all places are taken, another may be
        disconnected."""
        self._remove_closed()
        watchers = [one for one in self._by_peer.values() if one.use is ConnectionUse.WATCHER]
        others = [one for one in watchers if one is not new_connection]
        if len(others) < WATCHERS_MAX:
            return True
        if new_connection is None:
            return False
        if not new_connection.is_authenticated:
            count = Counter(one.source for one in others)
            others = [one for one in others if count[one.source] > count[new_connection.source] + 1]
        return self._close_one(others)

    def sweep(self) -> None:
        """End what takes too long."""
        self._remove_closed()
        now_s = time.monotonic()
        allowed_s = {ConnectionUse.IDLE: IDLE_MAX_S, ConnectionUse.REQUEST: REQUEST_MAX_S}
        for one in self._by_peer.values():
            if now_s - one.since_s > allowed_s.get(one.use, float("inf")):
                one.abort()

    async def run_sweeps(self) -> None:
        while True:
            await asyncio.sleep(SWEEP_S)
            self.sweep()

    def _close_one(self, among: Iterable[ClientConnection]) -> bool:
        """Close the least useful anonymous connection: of the source that has most, the oldest."""
        anonymous = [one for one in among if not one.is_authenticated]
        if not anonymous:
            return False
        count = Counter(one.source for one in self._by_peer.values())
        least_useful = min(anonymous, key=lambda one: (-count[one.source], one.use, one.since_s))
        least_useful.abort()
        self._by_peer = {
            peer: one for peer, one in self._by_peer.items() if one is not least_useful
        }
        self.closed += 1
        return True

    def _remove_closed(self) -> None:
        closed = [peer for peer, one in self._by_peer.items() if not one.is_open()]
        for peer in closed:
            del self._by_peer[peer]


class ListeningSocket(socket.socket):
    """A listening socket that registers every connection in the table.

    Args:
        listening: a socket that listens; it is taken over.
        connections: the table.
    """

    def __init__(self, listening: socket.socket, connections: Connections) -> None:
        super().__init__(fileno=listening.detach())
        self._connections = connections

    def accept(self) -> tuple[socket.socket, Any]:
        """As of a socket.

        Raises:
            ConnectionAbortedError: the connection was refused; the event loop continues.
        """
        link, address = super().accept()
        if not self._connections.admit(link, str(address[0]), int(address[1])):
            link.close()
            raise ConnectionAbortedError("too many connections")
        return link, address


def source_of(host: str) -> str:
    """What limits count by: an IPv4 address, or the /64 network of an IPv6 address."""
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return host
    if isinstance(address, ipaddress.IPv4Address):
        return str(address)
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return str(ipaddress.ip_network((address, 64), strict=False))
