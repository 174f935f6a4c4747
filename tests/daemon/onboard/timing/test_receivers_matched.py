"""Marks of every kind of receiver, as their drivers receive them, match their own pulses.

A flight without pictures: pulses are given, the emulated receiver stamps their strobes and sends
them over a real line, the driver reads it, and the service's own clock and matching decide.
"""

from __future__ import annotations

import queue
import socket
import threading
import time
from dataclasses import dataclass, field

import pytest

from daemon.onboard.timing.gps_clock import GpsClock
from daemon.onboard.timing.mark_matching import MarkMatcher
from daemon.onboard.timing.pulses import Cause, FiredPulse, MatchResult
from drivers.base import registry
from drivers.contract import EventMark, NavSample, Record
from sim_hw.devices.network_line import UdpLine
from sim_hw.receivers.emulated_receiver import EmulatedReceiver
from sim_hw.receivers.mavlink_autopilot import MavlinkAutopilot
from sim_hw.receivers.nmea_receiver import NmeaReceiver
from sim_hw.receivers.novatel_receiver import NovatelReceiver
from sim_hw.receivers.septentrio_receiver import SeptentrioReceiver
from sim_hw.receivers.ublox_receiver import UbloxReceiver
from sim_hw.world.world_clock import WorldClock
from tests.sim_hw.receiver_state import state_at

pytestmark = pytest.mark.realtime


PULSES = 4
LOST = 2
"""The strobe of this pulse never reaches the receiver."""
INTERVAL_NS = 1_100_000_000
STROBE_DELAY_NS = 4_000_000
RECORD_TIMEOUT_S = 20.0
SIGMA_NS = 100_000
KINDS: dict[str, type[EmulatedReceiver]] = {
    "ublox": UbloxReceiver,
    "novatel": NovatelReceiver,
    "septentrio": SeptentrioReceiver,
    "nmea": NmeaReceiver,
}
TIME_WITHIN_NS = {"ublox": 0, "novatel": 1, "septentrio": 1, "nmea": 500, "mavlink": 1_000_000}


@dataclass
class Chain:
    """One receiver, its driver, and what matching made of its marks."""

    kind: str
    receiver: EmulatedReceiver | MavlinkAutopilot
    records: queue.Queue[Record] = field(default_factory=queue.Queue)
    clock: GpsClock = field(default_factory=GpsClock)
    matches: list[tuple[EventMark, MatchResult]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.matcher = MarkMatcher(self.clock)
        driver = registry.driver_for("navigator", self.kind)
        self.navigator = driver("gnss", {"port": self.receiver.port})
        run = self.navigator.run
        self.thread = threading.Thread(target=run, args=(self.records.put,), daemon=True)

    def listen_until(self, mono_ns: int) -> None:
        """Pass on what is received, as the service does."""
        while (left_s := (mono_ns - time.monotonic_ns()) * 1e-9) > 0:
            try:
                record = self.records.get(timeout=left_s)
            except queue.Empty:
                return
            if isinstance(record, NavSample) and record.time_valid:
                self.clock.message_arrived(record.gps_ns, record.mono_ns)
            elif isinstance(record, EventMark):
                self.matches.append((record, self.matcher.mark(record)))

    def fly(self, world: WorldClock, first_ns: int) -> None:
        """Give the pulses at their times; all strobes but one reach the receiver."""
        for number in range(1, PULSES + 1):
            fired_ns = first_ns + (number - 1) * INTERVAL_NS
            strobe_ns = fired_ns + STROBE_DELAY_NS
            self.listen_until(fired_ns)
            if number != LOST:
                self.receiver.mark(world.gps_ns(strobe_ns))
            self.matcher.pulse(
                FiredPulse(number, fired_ns, SIGMA_NS, number, {"0": 0}, STROBE_DELAY_NS)
            )
        deadline = time.monotonic() + RECORD_TIMEOUT_S
        while len(self.matches) < PULSES - 1 and time.monotonic() < deadline:
            self.listen_until(time.monotonic_ns() + 50_000_000)

    def close(self) -> None:
        self.navigator.close()
        self.thread.join(5)
        self.receiver.close()


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_every_kind_of_receiver_has_its_marks_matched_to_their_own_pulses() -> None:
    world = WorldClock.from_wall_clock()
    autopilot = MavlinkAutopilot(world, state_at, line=UdpLine(("127.0.0.1", free_udp_port())))
    chains = [Chain(kind, made(world, state_at)) for kind, made in KINDS.items()]
    chains.append(Chain("mavlink", autopilot))
    for chain in chains:
        chain.thread.start()
        chain.receiver.start()
    # Two seconds of navigation first, so that the clock knows roughly where it is.
    first_ns = time.monotonic_ns() + 2_000_000_000
    flights = [threading.Thread(target=c.fly, args=(world, first_ns)) for c in chains]
    for flight in flights:
        flight.start()
    for flight in flights:
        flight.join(60)
    for chain in chains:
        chain.close()
    for chain in chains:
        kind, statistics = chain.kind, chain.navigator.statistics()
        assert len(chain.matches) == PULSES - 1, (kind, statistics)
        assert statistics["bad_messages"] == 0, kind
        for number in range(1, PULSES + 1):
            mark = chain.matcher.mark_of(number)
            if number == LOST:
                assert mark is None, (kind, "a lost mark does not take its neighbour's")
                continue
            assert mark is not None, (kind, number, chain.matches)
            strobe_ns = first_ns + (number - 1) * INTERVAL_NS + STROBE_DELAY_NS
            assert abs(mark.gps_ns - world.gps_ns(strobe_ns)) <= TIME_WITHIN_NS[kind], kind
        assert all(match.cause in (Cause.USED, Cause.PENDING) for _, match in chain.matches)
        assert not chain.clock.is_coarse
