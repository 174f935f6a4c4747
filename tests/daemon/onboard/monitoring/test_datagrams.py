"""A client converges over a link with one third loss, delay and outages of minutes.

The link is emulated on a clock of its own: loss, delay, bandwidth with a queue, outages.
"""

from __future__ import annotations

import heapq
import itertools
import random
from dataclasses import dataclass, field

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.mavlink.datagrams import (
    DATAGRAM_MAX_BYTES,
    DatagramReceiver,
    DatagramScheduler,
)
from tests.daemon.onboard.monitoring import flight_events


@dataclass
class Relay:
    """A lossy link: datagrams are delayed or lost."""

    loss: float
    delay_s: float
    bytes_per_s: float
    outages_s: tuple[tuple[float, float], ...] = ()
    queue_bytes: int = 8000
    random: random.Random = field(default_factory=lambda: random.Random(1))
    _waiting: list[tuple[float, int, bytes]] = field(default_factory=list)
    _free_s: float = 0.0
    _count: itertools.count[int] = field(default_factory=itertools.count)
    carried: int = 0

    def put(self, data: bytes, now_s: float) -> None:
        is_out = any(a <= now_s < b for a, b in self.outages_s)
        queued = max(0.0, self._free_s - now_s) * self.bytes_per_s
        if is_out or self.random.random() < self.loss or queued > self.queue_bytes:
            return
        self._free_s = max(self._free_s, now_s) + len(data) / self.bytes_per_s
        self.carried += len(data)
        jitter_s = self.random.uniform(0, 0.1)
        heapq.heappush(
            self._waiting, (self._free_s + self.delay_s + jitter_s, next(self._count), data)
        )

    def receive(self, now_s: float) -> list[bytes]:
        out = []
        while self._waiting and self._waiting[0][0] <= now_s:
            out.append(heapq.heappop(self._waiting)[2])
        return out


def fly(relay: Relay, seconds: float, exposures: int, faults_s: dict[str, float]):
    """Fly and watch; returns state, watcher, and when each fault was seen."""
    state, sender, watcher = (
        FlightState("syntopic test"),
        DatagramScheduler(4000 * 0.9),
        DatagramReceiver(),
    )
    state.apply(flight_events.mission())
    seen: dict[str, float] = {}
    raised: set[str] = set()
    number = 0
    for tick in range(int(seconds * 10)):
        now_s = tick / 10
        if number < exposures and now_s >= 2.0 * (number + 1):
            number += 1
            for event in flight_events.exposure(number, "usable" if number % 5 == 0 else "good"):
                state.apply(event)
        if tick % 10 == 0:
            state.apply(flight_events.status(triggers=number))
        for device, at_s in faults_s.items():
            if now_s >= at_s and device not in raised:
                raised.add(device)
                state.apply(flight_events.lost(device))
        for datagram in sender.due(state, now_s):
            assert len(datagram) <= DATAGRAM_MAX_BYTES
            relay.put(datagram, now_s)
        for datagram in relay.receive(now_s):
            watcher.receive(datagram)
        for fault in watcher.faults.values():
            seen.setdefault(fault["device"], now_s)
    return state, watcher, seen


def test_a_thin_lossy_link_with_outages_ends_up_with_the_same_state() -> None:
    outages = ((60.0, 120.0), (200.0, 230.0))
    relay = Relay(loss=0.3, delay_s=0.6, bytes_per_s=4000, outages_s=outages)
    faults_s = {f"SU0{i}": at_s for i, at_s in enumerate((10.0, 45.0, 130.0, 190.0))}
    state, watcher, seen = fly(relay, 600.0, exposures=150, faults_s=faults_s)
    waits_s = {device: round(seen[device] - at_s, 1) for device, at_s in faults_s.items()}
    print(f"faults seen after {waits_s} s; {relay.carried / 600:.0f} B/s carried")
    assert max(waits_s.values()) <= 5.0
    assert watcher.brief["status"]["ledger"] == state.brief()["status"]["ledger"]
    assert watcher.brief["verdicts"] == state.brief()["verdicts"]
    assert set(watcher.faults) == {fault["id"] for fault in state.faults()}
    reported = {one["number"]: one["verdict"] for one in watcher.exposures.values()}
    assert reported == {one["number"]: one["verdict"] for one in state.exposures()}
    assert watcher.rejected_count == 0


def test_a_fault_during_an_outage_is_received_soon_after_it() -> None:
    relay = Relay(loss=0.3, delay_s=0.6, bytes_per_s=4000, outages_s=((20.0, 80.0),))
    _, _, seen = fly(relay, 100.0, exposures=30, faults_s={"SU02": 40.0})
    assert 80.0 <= seen["SU02"] <= 85.0


def test_a_late_client_receives_the_earlier_state() -> None:
    relay = Relay(loss=0.0, delay_s=0.0, bytes_per_s=1e9, outages_s=((0.0, 150.0),))
    state, watcher, _ = fly(relay, 260.0, exposures=60, faults_s={})
    assert len(watcher.exposures) == len(state.exposures()) == 60


def test_a_fault_that_is_over_disappears() -> None:
    state, sender, watcher = FlightState("x"), DatagramScheduler(1e6), DatagramReceiver()
    state.apply(flight_events.mission())
    state.apply(flight_events.lost("SU02"))
    for datagram in sender.due(state, 0.0):
        watcher.receive(datagram)
    assert list(watcher.faults) == ["device SU02"]
    state.apply(flight_events.recovered("SU02"))
    state.acknowledge("device SU02")
    for datagram in sender.due(state, 5.0):
        watcher.receive(datagram)
    assert watcher.faults == {}


@given(st.lists(st.binary(max_size=100), max_size=5))
def test_any_bytes_are_counted_and_harm_nothing(datagrams: list[bytes]) -> None:
    watcher = DatagramReceiver()
    for datagram in datagrams:
        watcher.receive(datagram)
    assert watcher.rejected_count == len(datagrams)


@pytest.mark.parametrize("bytes_per_s", [1000.0, 4000.0])
def test_the_budget_is_kept(bytes_per_s: float) -> None:
    state, sender = FlightState("x"), DatagramScheduler(bytes_per_s)
    state.apply(flight_events.mission())
    for number in range(1, 100):
        for event in flight_events.exposure(number):
            state.apply(event)
    sent = sum(len(d) for tick in range(600) for d in sender.due(state, tick / 10))
    assert sent <= bytes_per_s * 61
