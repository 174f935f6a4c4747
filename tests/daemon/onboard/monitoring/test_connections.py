"""The table of connections: who is closed when it is full, and what takes too long."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from daemon.onboard.monitoring.web import connections as table
from daemon.onboard.monitoring.web.connections import (
    CONNECTIONS_MAX,
    CONNECTIONS_PER_SOURCE,
    IDLE_MAX_S,
    REQUEST_MAX_S,
    REQUESTS_AT_ONCE_PER_SOURCE,
    REQUESTS_BURST,
    REQUESTS_PER_S,
    ClientConnection,
    Connections,
    ConnectionUse,
    source_of,
)

pytestmark = pytest.mark.trust


class Clock:
    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s


class Links:
    """Opens connections of given addresses."""

    def __init__(self, connections: Connections) -> None:
        self.connections = connections
        self.ends: list[socket.socket] = []
        self.port = 1024

    def open(self, host: str) -> ClientConnection | None:
        ours, theirs = socket.socketpair()
        self.ends += [ours, theirs]
        self.port += 1
        if not self.connections.admit(ours, host, self.port):
            return None
        return self.connections.of((host, self.port))


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(table, "time", clock)
    return clock


@pytest.fixture
def links(clock: Clock) -> Iterator[Links]:
    links = Links(Connections(proxies=["10.0.0.200"]))
    yield links
    for end in links.ends:
        end.close()


def is_aborted(connection: ClientConnection) -> bool:
    try:
        return connection.link.recv(1, socket.MSG_DONTWAIT | socket.MSG_PEEK) == b""
    except BlockingIOError:
        return False


def opened(
    links: Links, host: str, clock: Clock, use: ConnectionUse = ConnectionUse.IDLE
) -> ClientConnection:
    clock.now_s += 0.001
    connection = links.open(host)
    assert connection is not None
    connection.enter(use)
    return connection


def test_an_address_with_too_many_connections_loses_its_oldest_idle_one(
    links: Links, clock: Clock
) -> None:
    watcher = opened(links, "10.0.0.1", clock, ConnectionUse.WATCHER)
    mine = [opened(links, "10.0.0.1", clock) for _ in range(CONNECTIONS_PER_SOURCE - 1)]
    other = opened(links, "10.0.0.2", clock)
    opened(links, "10.0.0.1", clock)
    assert [is_aborted(one) for one in (watcher, other, mine[0], mine[1])] == [
        False,
        False,
        True,
        False,
    ]
    assert links.connections.closed == 1


def test_a_full_table_closes_unknown_clients_and_no_known_one(links: Links, clock: Clock) -> None:
    operator = [opened(links, "10.0.1.1", clock) for _ in range(10)]
    for one in operator:
        one.is_authenticated = True
    unknown = [opened(links, f"10.1.{n // 250}.{n % 250}", clock) for n in range(CONNECTIONS_MAX)]
    assert not any(is_aborted(one) for one in operator)
    assert [is_aborted(one) for one in unknown[:12]] == [True] * 10 + [False] * 2
    assert not is_aborted(opened(links, "10.0.1.1", clock))


def test_when_all_are_known_a_newcomer_is_refused(links: Links, clock: Clock) -> None:
    for _ in range(CONNECTIONS_PER_SOURCE):
        opened(links, "10.0.0.1", clock).is_authenticated = True
    assert links.open("10.0.0.1") is None
    assert links.open("10.0.0.2") is not None


def test_a_proxy_has_no_limit_of_its_own(links: Links, clock: Clock) -> None:
    for _ in range(CONNECTIONS_PER_SOURCE + 5):
        opened(links, "10.0.0.200", clock)
    assert links.connections.closed == 0


def test_what_takes_too_long_is_ended(links: Links, clock: Clock) -> None:
    idle = opened(links, "10.0.0.1", clock)
    request = opened(links, "10.0.0.1", clock, ConnectionUse.REQUEST)
    watcher = opened(links, "10.0.0.1", clock, ConnectionUse.WATCHER)
    for passed_s, expected in (
        (IDLE_MAX_S - 0.1, [False, False, False]),
        (0.2, [True, False, False]),
        (REQUEST_MAX_S - IDLE_MAX_S - 0.2, [True, False, False]),
        (0.2, [True, True, False]),
        (1e6, [True, True, False]),
    ):
        clock.now_s += passed_s
        links.connections.sweep()
        assert [is_aborted(one) for one in (idle, request, watcher)] == expected


def test_requests_of_an_address_have_a_rate(links: Links, clock: Clock) -> None:
    request = links.connections.may_request
    assert sum(request("10.0.0.1") for _ in range(REQUESTS_BURST + 50)) == REQUESTS_BURST
    assert request("10.0.0.2")
    clock.now_s += 0.5
    assert sum(request("10.0.0.1") for _ in range(REQUESTS_BURST)) == REQUESTS_PER_S // 2


def test_few_requests_of_an_address_are_answered_at_once(links: Links, clock: Clock) -> None:
    busy = [
        opened(links, "10.0.0.1", clock, ConnectionUse.REQUEST)
        for _ in range(REQUESTS_AT_ONCE_PER_SOURCE)
    ]
    assert not links.connections.may_request("10.0.0.1")
    assert links.connections.may_request("10.0.0.2")
    busy[0].is_authenticated = True
    assert links.connections.may_request("10.0.0.1")


def test_places_of_watchers_are_shared_between_addresses(links: Links, clock: Clock) -> None:
    first = [
        opened(links, f"10.0.0.{host}", clock, ConnectionUse.WATCHER)
        for host in (1, 3)
        for _ in range(table.WATCHERS_MAX // 2)
    ]
    same, other = opened(links, "10.0.0.1", clock), opened(links, "10.0.0.2", clock)
    assert not links.connections.may_watch(same)
    assert links.connections.may_watch(other)
    other.enter(ConnectionUse.WATCHER)
    same.is_authenticated = True
    assert links.connections.may_watch(same)
    assert sum(map(is_aborted, first)) == 2


@pytest.mark.parametrize(
    ("host", "source"),
    [
        ("10.0.0.1", "10.0.0.1"),
        ("::ffff:10.0.0.1", "10.0.0.1"),
        ("fd00::1:2:3:4", "fd00::/64"),
        ("fe80::1%eth0", "fe80::/64"),
        ("nonsense", "nonsense"),
    ],
)
def test_an_ipv6_host_has_no_more_sources_than_one(host: str, source: str) -> None:
    assert source_of(host) == source
