"""Each receiver's driver on the emulated receiver, over a real pseudo-terminal and a real socket.

The emulators are written from the makers' specifications and held against other programs in
tests/sim_hw; here both ends meet.
"""

from __future__ import annotations

import math
import socket
import threading
import time
from dataclasses import replace

import pytest

from drivers.contract import EventMark, NavSample
from drivers.receivers.applanix.navigator import ApplanixNavigator
from drivers.receivers.gsof.navigator import GsofNavigator
from drivers.receivers.nmea.navigator import NmeaNavigator
from drivers.receivers.novatel.navigator import NovatelNavigator
from drivers.receivers.sbg.navigator import SbgNavigator
from drivers.receivers.septentrio.navigator import SeptentrioNavigator
from drivers.receivers.streaming_navigator import StreamingNavigator
from drivers.receivers.ublox.navigator import UbloxNavigator
from drivers.receivers.vectornav.navigator import VectornavNavigator
from drivers.receivers.xsens.navigator import XsensNavigator
from sim_hw.devices.network_line import TcpLine, UdpLine
from sim_hw.devices.pseudo_terminal import PseudoTerminal
from sim_hw.receivers.applanix_receiver import ApplanixReceiver
from sim_hw.receivers.emulated_receiver import EmulatedReceiver, ReceiverState
from sim_hw.receivers.gsof_receiver import GsofReceiver
from sim_hw.receivers.nmea_receiver import NmeaReceiver
from sim_hw.receivers.novatel_receiver import NovatelReceiver
from sim_hw.receivers.sbg_receiver import SbgReceiver
from sim_hw.receivers.septentrio_receiver import SeptentrioReceiver
from sim_hw.receivers.ublox_receiver import UbloxReceiver
from sim_hw.receivers.vectornav_receiver import VectornavReceiver
from sim_hw.receivers.xsens_receiver import XsensReceiver
from sim_hw.world.world_clock import WorldClock
from tests.drivers.fakes import RecordingSink, running
from tests.sim_hw.receiver_state import NS, STATE, WEEK_NS

pytestmark = pytest.mark.realtime


WITHIN_S = 30.0
METRES_PER_DEGREE = 111_320.0
HOUR_NS = 3600 * NS

PAIRS = {
    "ublox": (UbloxReceiver, UbloxNavigator),
    "novatel": (NovatelReceiver, NovatelNavigator),
    "septentrio": (SeptentrioReceiver, SeptentrioNavigator),
    "nmea": (NmeaReceiver, NmeaNavigator),
    "sbg": (SbgReceiver, SbgNavigator),
    "vectornav": (VectornavReceiver, VectornavNavigator),
    "xsens": (XsensReceiver, XsensNavigator),
    "applanix": (ApplanixReceiver, ApplanixNavigator),
    "gsof": (GsofReceiver, GsofNavigator),
}
MARKS_WITHIN_NS = {
    "ublox": 0,
    "novatel": 1,
    "septentrio": 1,
    "nmea": 500,
    "sbg": 1000,
    "vectornav": 0,
    "xsens": 100_000,
    "applanix": 1,
    "gsof": 1,
}
"""The resolution of each protocol: NMEA and SBG resolve microseconds, Xsens 0.1 ms."""
PLACE_WITHIN_M = {
    "ublox": 0.02, "novatel": 1e-3, "septentrio": 1e-3, "nmea": 0.06, "sbg": 1e-3,
    "vectornav": 1e-3,
    "xsens": 1e-3, "applanix": 1e-3, "gsof": 1e-3,
}  # fmt: skip


def flying(gps_ns: int) -> ReceiverState:
    """North at 60 m/s, at 10 degrees at the full hour: so time shows in the place."""
    elapsed_s = ((gps_ns + HOUR_NS // 2) % HOUR_NS - HOUR_NS // 2) / NS
    return replace(
        STATE,
        latitude_deg=10.0 + elapsed_s * 60.0 / METRES_PER_DEGREE,
        velocity_ned_mps=(60.0, 0.0, 0.0),
    )


def pair(kind: str, line: str, clock: WorldClock) -> tuple[EmulatedReceiver, StreamingNavigator]:
    receiver_class, navigator_class = PAIRS[kind]
    receiver: EmulatedReceiver = receiver_class(
        clock, flying, rate_hz=10.0, line=PseudoTerminal() if line == "pty" else TcpLine()
    )
    return receiver, navigator_class("gnss", {"port": receiver.port})


@pytest.mark.parametrize(("kind", "line"), [*((k, "pty") for k in PAIRS), ("septentrio", "tcp")])
def test_places_and_marks_of_the_emulated_receiver_come_out_right(kind: str, line: str) -> None:
    # A week's end lies 1.1 s ahead, so the flight goes through it.
    clock = WorldClock(2444 * WEEK_NS - 1_100_000_000, time.monotonic_ns())
    receiver, navigator = pair(kind, line, clock)
    recorder, enough = RecordingSink(), threading.Event()
    receiver.start()
    try:
        found = navigator.bind()
        first_ns = clock.gps_ns(time.monotonic_ns()) + 250_000_000
        given = [first_ns + n * 150_000_001 for n in range(5)]
        for at_ns in given:
            receiver.mark(at_ns)

        def watch(_: object) -> None:
            event_marks = [r for r in recorder.records if isinstance(r, EventMark)]
            after = [r for r in recorder.records if isinstance(r, NavSample)]
            if len(event_marks) == 5 and after and after[-1].gps_ns > given[-1] + 200_000_000:
                enough.set()

        recorder.stop = watch
        with running(navigator, recorder):
            assert enough.wait(WITHIN_S), navigator.statistics()
    finally:
        receiver.close()
    assert found["port"] == receiver.port
    marks = [r for r in recorder.records if isinstance(r, EventMark)]
    away_ns = [abs(m.gps_ns - at) for m, at in zip(marks, given, strict=True)]
    assert max(away_ns) <= MARKS_WITHIN_NS[kind]
    assert all(m.time_valid for m in marks)
    samples = [r for r in recorder.records if isinstance(r, NavSample)]
    timed = [s for s in samples if s.time_valid]
    assert len(timed) >= 6
    assert timed[-1].gps_ns >= 2444 * WEEK_NS
    for sample in timed:
        there = flying(sample.gps_ns)
        away_m = (sample.latitude_deg - there.latitude_deg) * METRES_PER_DEGREE
        assert abs(away_m) < PLACE_WITHIN_M[kind], "time and place belong together"
        assert sample.height_m == pytest.approx(STATE.height_m, abs=0.06)
        assert sample.velocity_ned_mps[0] == pytest.approx(60.0, abs=1e-2)
        assert sample.fix == "3d"
    leaning = [s for s in timed if s.roll_rad is not None]
    assert len(leaning) >= len(timed) - 2
    for sample in leaning:
        assert sample.roll_rad == pytest.approx(math.radians(STATE.roll_deg), abs=2e-5)
        assert sample.pitch_rad == pytest.approx(math.radians(STATE.pitch_deg), abs=2e-5)
        assert sample.heading_rad == pytest.approx(math.radians(STATE.heading_deg), abs=2e-5)
    assert samples[-1].leap_seconds == 18
    statistics = navigator.statistics()
    assert statistics["bad_messages"] == 0
    assert statistics["marks"] == 5


@pytest.mark.parametrize("kind", list(PAIRS))
def test_a_receiver_behind_a_noisy_line_is_received_and_its_damage_counted(kind: str) -> None:
    clock = WorldClock.from_wall_clock()
    receiver, navigator = pair(kind, "pty", clock)
    read_count = iter(range(1_000_000))

    def byte_filter(data: bytes, _mono_ns: int) -> bytes:
        """A bit of every third piece turns over."""
        if not data or next(read_count) % 3:
            return data
        at = len(data) // 2
        return data[:at] + bytes((data[at] ^ 0x10,)) + data[at + 1 :]

    receiver.byte_filter = byte_filter
    recorder, enough = RecordingSink(), threading.Event()

    def watch(_: object) -> None:
        if sum(isinstance(r, NavSample) for r in recorder.records) >= 12:
            enough.set()

    recorder.stop = watch
    receiver.start()
    try:
        with running(navigator, recorder):
            assert enough.wait(WITHIN_S), navigator.statistics()
    finally:
        receiver.close()
    assert navigator.statistics()["bad_messages"] >= 3
    for sample in (r for r in recorder.records if isinstance(r, NavSample)):
        if sample.time_valid:
            there = flying(sample.gps_ns).latitude_deg
            assert abs(sample.latitude_deg - there) * METRES_PER_DEGREE < PLACE_WITHIN_M[kind]


def test_a_receiver_that_sends_datagrams_is_received_like_one_on_a_line() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        here = probe.getsockname()
    receiver = SeptentrioReceiver(WorldClock.from_wall_clock(), flying, line=UdpLine(here))
    navigator = SeptentrioNavigator("gnss", {"port": receiver.port})
    receiver.start()
    try:
        found = navigator.bind()
    finally:
        navigator.close()
        receiver.close()
    assert found["port"] == "udpin://{}:{}".format(*here)
    assert "PVTGeodetic" in found["messages"]
