"""MAVLink: samples and marks at GPS time, what is asked of the autopilot, and the TIMESYNC port.

Messages are packed by pymavlink; the emulated autopilot of `sim_hw` has a codec of its own.
"""

from __future__ import annotations

import math
import socket
import threading
import time
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from drivers.contract import ClockReading, DeviceError, EventMark, NavSample
from drivers.receivers.mavlink.boot_clock import GPS_EPOCH_UNIX_NS
from drivers.receivers.mavlink.decoder import (
    MavlinkDecoder,
    Timesync,
)
from drivers.receivers.mavlink.navigator import MavlinkNavigator
from drivers.receivers.message_decoder import Nav
from drivers.timescales.gps_time import SECOND_NS, WEEK_NS
from sim_hw.devices.device_loop import DeviceLine
from sim_hw.devices.network_line import TcpLine, UdpLine
from sim_hw.devices.pseudo_terminal import PseudoTerminal
from sim_hw.receivers.emulated_receiver import ReceiverState
from sim_hw.receivers.mavlink_autopilot import MavlinkAutopilot
from sim_hw.world.world_clock import WorldClock
from tests.drivers.fakes import FakeClock, FakePort, RecordingSink, running
from tests.sim_hw.receiver_state import STATE

WITHIN_S = 30.0
# 2026-11-01T10:00:00 UTC and 18 leap seconds, 100 s after the autopilot's start.
GPS_NS = 2443 * WEEK_NS + 36_018 * SECOND_NS
UNIX_US = (GPS_NS - 18 * SECOND_NS + GPS_EPOCH_UNIX_NS) // 1000
BOOT_MS = 100_000
METRES_PER_DEGREE = 111_320.0
HOUR_NS = 3600 * SECOND_NS


class Bus:
    """What is on the bus: messages of one component, packed with their sequence numbers."""

    def __init__(self, system: int = 1, component: int = 1, *, version: int = 2) -> None:
        self._packer = dialect.MAVLink(None, system, component)
        self._is_v1 = version == 1

    def pack_message(self, message: Any) -> bytes:
        packed = bytes(message.pack(self._packer, force_mavlink1=self._is_v1))
        self._packer.seq = (self._packer.seq + 1) % 256
        return packed

    def heartbeat(self, autopilot: int = 12) -> bytes:
        return self.pack_message(dialect.MAVLink_heartbeat_message(1, autopilot, 0, 0, 4, 3))

    def system_time(self, unix_us: int = UNIX_US, boot_ms: int = BOOT_MS) -> bytes:
        return self.pack_message(dialect.MAVLink_system_time_message(unix_us, boot_ms))

    def gps(self, *, fix: int = 3, ellipsoid_mm: int = 1_000_000) -> bytes:
        return self.pack_message(dialect.MAVLink_gps_raw_int_message(
            BOOT_MS * 1000, fix, 475_000_000, 85_000_000, 952_500, 80, 90, 6000, 0, 17,
            ellipsoid_mm, 20, 30, 40, 0, 0,
        ))  # fmt: skip

    def position(self, boot_ms: int = BOOT_MS, *, latitude: int = 475_000_000) -> bytes:
        return self.pack_message(dialect.MAVLink_global_position_int_message(
            boot_ms, latitude, 85_000_000, 952_500, 500_000, 6000, 300, -100, 1000,
        ))  # fmt: skip

    def attitude(self, boot_ms: int, heading_deg: float = 90.0) -> bytes:
        half = math.radians(heading_deg) / 2
        return self.pack_message(dialect.MAVLink_attitude_quaternion_message(
            boot_ms, math.cos(half), 0, 0, math.sin(half), 0, 0, 0,
        ))  # fmt: skip

    def feedback(self, time_us: int, number: int, *, flags: int = 0) -> bytes:
        return self.pack_message(dialect.MAVLink_camera_feedback_message(
            time_us, 1, 2, number, 475_000_000, 85_000_000, 952.5, 500.0, 0.0, 0.0, 10.0, 0.0,
            flags, number,
        ))  # fmt: skip

    def trigger(self, time_us: int, number: int) -> bytes:
        return self.pack_message(dialect.MAVLink_camera_trigger_message(time_us, number))


def decode(data: bytes, piece: int = 0, **settings: Any) -> tuple[MavlinkDecoder, list[Nav]]:
    decoder = MavlinkDecoder("fc", **settings)
    records: list[Nav] = []
    for at in range(0, len(data), piece or len(data) or 1):
        records += decoder.feed(data[at : at + (piece or len(data))], 77)
    return decoder, records


def samples(data: bytes) -> list[NavSample]:
    return [r for r in decode(data)[1] if isinstance(r, NavSample)]


def marks(data: bytes) -> list[EventMark]:
    return [r for r in decode(data)[1] if isinstance(r, EventMark)]


@pytest.mark.parametrize("version", [1, 2])
def test_a_position_comes_out_in_si_units_at_its_gps_time(version: int) -> None:
    bus = Bus(version=version)
    (sample,) = samples(bus.heartbeat() + bus.system_time() + bus.gps() + bus.position())
    # Within the millisecond to which the time since start is cut.
    assert abs(sample.gps_ns - GPS_NS) <= 1_000_000
    assert (sample.latitude_deg, sample.longitude_deg) == pytest.approx((47.5, 8.5), abs=1e-9)
    assert sample.velocity_ned_mps == pytest.approx((60.0, 3.0, -1.0))
    assert (sample.fix, sample.satellites, sample.leap_seconds) == ("3d", 17, 18)
    assert sample.height_m == pytest.approx(1000.0)
    assert (sample.leap_source, sample.sigma_source) == ("table", "receiver")
    # One SYSTEM_TIME does not say how it scatters: some milliseconds, at 60 m/s.
    assert 0.3 < sample.horizontal_sigma_m < 0.6
    assert 0.03 < sample.vertical_sigma_m < 0.04


def test_without_an_ellipsoidal_height_the_configured_undulation_is_added() -> None:
    bus = Bus()
    stream_bytes = bus.heartbeat() + bus.system_time() + bus.gps(ellipsoid_mm=0) + bus.position()
    (sample,) = decode(stream_bytes, undulation_m=47.0)[1]
    assert isinstance(sample, NavSample)
    assert sample.height_m == pytest.approx(999.5)


def test_attitude_is_interpolated_to_the_instant_of_the_position() -> None:
    bus = Bus()
    stream_bytes = bus.heartbeat() + bus.system_time() + bus.attitude(BOOT_MS - 20, 358.0)
    decoder = MavlinkDecoder("fc")
    assert decoder.feed(stream_bytes + bus.position(), 0) == [], (
        "the attitude after it is waited for"
    )
    (sample,) = decoder.feed(bus.attitude(BOOT_MS + 20, 2.0), 0)
    assert isinstance(sample, NavSample)
    assert sample.heading_rad is not None
    assert abs(math.remainder(sample.heading_rad, math.tau)) < 1e-6
    assert sample.roll_rad == pytest.approx(0.0, abs=1e-9)


def test_a_position_does_not_wait_for_an_attitude_that_no_longer_comes() -> None:
    bus = Bus()
    begun = bus.heartbeat() + bus.system_time() + bus.attitude(BOOT_MS - 20)
    decoded = samples(begun + bus.position(BOOT_MS) + bus.position(BOOT_MS + 100))
    assert [s.heading_rad for s in decoded] == [None]
    late = samples(begun + bus.position(BOOT_MS + 2000))
    assert [s.heading_rad for s in late] == [None]


def test_before_utc_is_known_there_is_no_sample_and_no_valid_mark() -> None:
    bus = Bus()
    decoder, records = decode(
        bus.heartbeat() + bus.system_time(0) + bus.position() + bus.trigger(100_000_000, 3)
    )
    assert [(type(r).__name__, getattr(r, "time_valid", None)) for r in records] == [
        ("EventMark", False)
    ]
    assert decoder.counters["samples_without_time"] == 1
    assert decoder.counters["marks_without_time"] == 1


def test_a_camera_feedback_is_a_mark_in_utc_with_its_own_count() -> None:
    bus = Bus()
    begun = bus.heartbeat() + bus.system_time() + bus.position()
    (mark,) = marks(begun + bus.feedback(UNIX_US + 250_000, 65_535))
    assert (mark.channel, mark.gps_ns) == (2, GPS_NS + 250_000_000)
    assert (mark.count, mark.count_bits, mark.time_valid) == (65_535, 16, True)


@pytest.mark.parametrize(("time_us", "flags"), [(0, 0), (5_000_000, 0), (UNIX_US, 4)])
def test_a_camera_feedback_without_utc_or_without_a_pulse_is_not_valid(
    time_us: int, flags: int
) -> None:
    bus = Bus()
    begun = bus.heartbeat() + bus.system_time() + bus.position()
    (mark,) = marks(begun + bus.feedback(time_us, 1, flags=flags))
    assert not mark.time_valid


def test_a_camera_feedback_next_to_triggers_is_no_second_mark() -> None:
    bus = Bus()
    begun = bus.heartbeat() + bus.system_time() + bus.position()
    found = marks(
        begun + bus.trigger(UNIX_US, 1) + bus.feedback(UNIX_US, 1) + bus.trigger(UNIX_US + 9, 2)
    )
    assert [(m.count, m.count_bits) for m in found] == [(1, 32), (2, 32)]


def test_a_trigger_in_utc_and_one_since_start_are_marks_at_gps_time() -> None:
    bus = Bus()
    begun = bus.heartbeat() + bus.system_time() + bus.position()
    (in_utc,) = marks(begun + bus.trigger(UNIX_US + 250_000, 7))
    assert in_utc.gps_ns == GPS_NS + 250_000_000
    (since_start,) = marks(begun + bus.trigger(BOOT_MS * 1000 + 250_000, 8))
    assert abs(since_start.gps_ns - in_utc.gps_ns) <= 1_000_000
    assert (since_start.count, since_start.count_bits, since_start.time_valid) == (8, 32, True)
    # One SYSTEM_TIME does not say how it scatters.
    assert 5_000_000 < since_start.accuracy_ns < 10_000_000


def test_a_restart_of_the_autopilot_is_noticed_and_time_goes_on() -> None:
    bus = Bus()
    before = bus.heartbeat() + bus.system_time() + bus.position()
    after = bus.system_time(UNIX_US + 60_000_000, 2_000) + bus.position(2_000)
    decoder, records = decode(before + after)
    assert decoder.counters["clock_steps"] == 1
    first, second = (r.gps_ns for r in records)
    assert abs(second - first - 60 * SECOND_NS) <= 1_000_000


def test_others_on_the_bus_are_not_taken_for_the_autopilot() -> None:
    bus, camera, other = Bus(), Bus(component=100), Bus(system=2)
    stream_bytes = camera.heartbeat(8) + other.pack_message(
        dialect.MAVLink_system_time_message(UNIX_US, 5)
    )
    stream_bytes += bus.heartbeat() + bus.system_time() + bus.position()
    stream_bytes += camera.trigger(UNIX_US, 1) + other.heartbeat() + other.position(latitude=1)
    decoder, records = decode(stream_bytes)
    assert (decoder.system, decoder.component, len(records)) == (1, 1, 1)
    assert decoder.counters["messages_of_others"] == 5
    chosen, _ = decode(bus.heartbeat() + other.heartbeat(), system=2)
    assert chosen.system == 2


def test_after_the_line_was_reopened_another_autopilot_may_be_there() -> None:
    bus, other = Bus(), Bus(system=7)
    decoder, _ = decode(bus.heartbeat() + bus.system_time())
    assert len(decoder.feed(other.heartbeat() + other.position() + bus.position(), 0)) == 1
    decoder.reset()
    assert len(decoder.feed(bus.position(), 0)) == 1, "until a heartbeat shows otherwise"
    assert len(decoder.feed(other.heartbeat() + other.position(), 0)) == 1
    assert decoder.system == 7


def test_lost_messages_are_counted_by_their_sequence() -> None:
    bus = Bus()
    stream_bytes = bus.heartbeat() + bus.system_time()
    bus.position(), bus.position()
    decoder, _ = decode(stream_bytes + bus.position())
    assert decoder.counters["messages_lost"] == 2


def test_a_signed_message_is_read() -> None:
    bus = Bus()
    bus._packer.signing.secret_key = bytes(range(32))
    bus._packer.signing.sign_outgoing = True
    (sample,) = samples(bus.heartbeat() + bus.system_time() + bus.gps() + bus.position())
    assert sample.latitude_deg == pytest.approx(47.5)


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_damage_and_noise_raise_nothing_and_cost_no_later_message(data: st.DataObject) -> None:
    bus = Bus()
    stream_bytes = (
        bus.heartbeat() + bus.system_time() + bus.gps() + bus.attitude(BOOT_MS) + bus.position()
    )
    stream = bytearray(stream_bytes)
    for _ in range(data.draw(st.integers(0, 6))):
        stream[data.draw(st.integers(0, len(stream) - 1))] = data.draw(st.integers(0, 255))
    noise = data.draw(st.binary(max_size=200))
    last = Bus()
    tail = last.heartbeat() + last.trigger(UNIX_US, 41) + last.trigger(UNIX_US, 42)
    decoder_whole, records = decode(bytes(stream) + noise + tail)
    assert [r.count for r in records[-1:] if isinstance(r, EventMark)] == [42]
    pieces, same = decode(bytes(stream) + noise + tail, data.draw(st.integers(1, 50)))
    assert same == records
    assert (pieces.frames, pieces.bad_bytes) == (decoder_whole.frames, decoder_whole.bad_bytes)
    assert decoder_whole.pending <= 300


@settings(max_examples=100, deadline=None)
@given(payload=st.binary(max_size=60), name=st.sampled_from([
    "SYSTEM_TIME", "GPS_RAW_INT", "GLOBAL_POSITION_INT", "ATTITUDE_QUATERNION", "HIGHRES_IMU",
    "CAMERA_TRIGGER", "TIMESYNC", "COMMAND_ACK",
]))  # fmt: skip
def test_a_checked_message_of_nonsense_raises_nothing(payload: bytes, name: str) -> None:
    bus = Bus()
    number = getattr(dialect, f"MAVLINK_MSG_ID_{name}")
    kind = dialect.mavlink_map[number]
    size = kind.unpacker.size
    filled = payload[:size].ljust(size, b"\x7f")
    head = bytes((len(filled), 0, 0, 1, 1, 1)) + number.to_bytes(3, "little")
    crc = dialect.x25crc(bytearray(head + filled + bytes((kind.crc_extra,)))).crc
    stream_bytes = b"\xfd" + head + filled + crc.to_bytes(2, "little")
    decoder, _ = decode(bus.heartbeat() + bus.system_time() + stream_bytes)
    assert decoder.frames == 3


# The device


def flying(gps_ns: int) -> ReceiverState:
    """North at 60 m/s, at 10 degrees at the full hour: so time shows in the place."""
    elapsed_s = ((gps_ns + HOUR_NS // 2) % HOUR_NS - HOUR_NS // 2) * 1e-9
    return replace(
        STATE,
        latitude_deg=10.0 + elapsed_s * 60.0 / METRES_PER_DEGREE,
        velocity_ned_mps=(60.0, 0.0, 0.0),
    )


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def new_line(kind: str) -> DeviceLine:
    if kind == "udp":
        return UdpLine(("127.0.0.1", free_udp_port()))
    return TcpLine() if kind == "tcp" else PseudoTerminal()


@pytest.mark.parametrize("line", ["pty", "udp", "tcp"])
def test_places_attitudes_and_triggers_of_the_emulated_autopilot_come_out_right(line: str) -> None:
    clock = WorldClock.from_wall_clock()
    autopilot = MavlinkAutopilot(clock, flying, line=new_line(line))
    navigator = MavlinkNavigator("fc", {"port": autopilot.port, "imu_hz": 20.0})
    recorder, enough = RecordingSink(), threading.Event()
    given: list[int] = []

    def watch(_: object) -> None:
        leaning = sum(isinstance(r, NavSample) and r.roll_rad is not None for r in recorder.records)
        decoded = sum(isinstance(r, EventMark) for r in recorder.records)
        if decoded == 4 and leaning >= 15:
            enough.set()

    recorder.stop = watch
    autopilot.start()
    try:
        found = navigator.bind()
        given += [clock.gps_ns(time.monotonic_ns()) + n * 200_000_003 for n in range(1, 5)]
        for at_ns in given:
            autopilot.mark(at_ns)
        with running(navigator, recorder):
            assert enough.wait(WITHIN_S), navigator.statistics()
    finally:
        autopilot.close()
    assert (found["autopilot"], found["system"]) == ("PX4", "1")
    marks = [r for r in recorder.records if isinstance(r, EventMark)]
    assert [m.count for m in marks] == [0, 1, 2, 3]
    assert max(abs(m.gps_ns - at) for m, at in zip(marks, given, strict=True)) < 1_000_000
    assert all(m.time_valid for m in marks)
    samples = [r for r in recorder.records if isinstance(r, NavSample)]
    for sample in samples:
        away_m = (sample.latitude_deg - flying(sample.gps_ns).latitude_deg) * METRES_PER_DEGREE
        assert abs(away_m) < 0.08, "a millisecond of flight, and the last digit"
        assert sample.height_m == pytest.approx(STATE.height_m, abs=2e-3)
    leaning = [s for s in samples if s.roll_rad is not None]
    for sample in leaning:
        assert sample.roll_rad == pytest.approx(math.radians(STATE.roll_deg), abs=1e-6)
        assert sample.heading_rad == pytest.approx(math.radians(STATE.heading_deg), abs=1e-6)
    statistics = navigator.statistics()
    assert (statistics["bad_messages"], statistics["refusals"]) == (0, 0)
    # Rates it sends by itself are too low: it was asked for more, and does it.
    assert statistics["requests"] >= 3
    assert autopilot.statistics()["commands"] >= 3
    assert navigator.decoder.seen["HIGHRES_IMU"] > 0


def test_the_port_for_timesync_measures_the_autopilots_clock() -> None:
    clock = WorldClock.from_wall_clock()
    autopilot = MavlinkAutopilot(clock, flying, line=new_line("udp"), drift_ppm=0.0)
    navigator = MavlinkNavigator("fc", {"port": autopilot.port, "timesync_hz": 20})
    timesyncs: list[Timesync] = []
    answered, read = threading.Event(), threading.Event()
    recorder, sent = RecordingSink(), list[int]()

    def watch(_: object) -> None:
        if sum(isinstance(r, ClockReading) for r in recorder.records) >= 5:
            read.set()

    recorder.stop = watch

    def listen(timesync: Timesync) -> None:
        timesyncs.append(timesync)
        answered.set()

    assert not navigator.send_timesync(tc1_ns=0, ts1_ns=1), "nothing is open yet"
    navigator.subscribe_timesync(listen)
    autopilot.start()
    try:
        navigator.bind()
        with running(navigator, recorder):
            for _ in range(5):
                answered.clear()
                sent.append(time.monotonic_ns())
                assert navigator.send_timesync(tc1_ns=0, ts1_ns=sent[-1])
                assert answered.wait(WITHIN_S)
            assert read.wait(WITHIN_S)
    finally:
        autopilot.close()
    readings = [r for r in recorder.records if isinstance(r, ClockReading)]
    for reading in readings:
        there_ns = autopilot.boot_ns(clock.gps_ns(reading.mono_ns))
        assert abs(reading.device_ns - there_ns) <= reading.half_width_ns
        assert reading.device == "fc"
    assert not {t.ts1_ns for t in timesyncs} <= set(sent), "the driver asks by itself, too"
    best = min(timesyncs, key=lambda t: t.mono_ns - t.ts1_ns)
    round_trip_ns = best.mono_ns - best.ts1_ns
    true_ns = autopilot.boot_ns(clock.gps_ns(best.ts1_ns + round_trip_ns // 2))
    assert abs(best.tc1_ns - true_ns) <= round_trip_ns // 2 + 1
    assert (best.system, best.component) == (1, 1)
    assert not navigator.send_timesync(tc1_ns=0, ts1_ns=1), "it is closed"


def test_binding_states_what_was_received_or_what_to_switch_on() -> None:
    clock = FakeClock()
    bus = Bus()

    def bind(stream_bytes: bytes) -> str:
        def answer(_: FakePort) -> bytes:
            clock.now_ns += 10**8 if stream_bytes else 0
            return stream_bytes

        port = FakePort(clock, answer)
        navigator = MavlinkNavigator("f", {"port": "x"}, clock=clock, open_port=lambda *_: port)
        return navigator.bind()["messages"]

    assert bind(bus.heartbeat() + bus.system_time() + bus.position()) == (
        "GLOBAL_POSITION_INT, HEARTBEAT, SYSTEM_TIME"
    )
    with pytest.raises(DeviceError, match="sent no GLOBAL_POSITION_INT"):
        bind(bus.heartbeat())
    with pytest.raises(DeviceError, match="is no MAVLink"):
        bind(b"$GNTXT,hello*00\r\n")


def test_it_announces_itself_and_requests_what_does_not_come() -> None:
    clock = FakeClock()
    bus = Bus()

    def answer(_: FakePort) -> bytes:
        clock.now_ns += 10**8
        return bus.position() if clock.now_ns > 15 * 10**9 else bus.heartbeat()

    port = FakePort(clock, answer)
    navigator = MavlinkNavigator(
        "f", {"port": "x", "silence_s": 60}, clock=clock, open_port=lambda *_: port
    )
    navigator.bind()
    stream_bytes = dialect.MAVLink(None).parse_buffer(bytearray(port.written))
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in stream_bytes} == {(1, 191)}
    names = [m.get_type() for m in stream_bytes]
    assert 13 <= names.count("HEARTBEAT") <= 16
    assert 13 <= names.count("TIMESYNC") <= 16
    requests = [m for m in stream_bytes if m.get_type() == "COMMAND_LONG"]
    assert {(m.command, m.target_system, m.target_component) for m in requests} == {(511, 1, 1)}
    assert {(m.param1, m.param2) for m in requests} == {
        (2.0, 1e6), (24.0, 1e6), (33.0, 1e5), (31.0, 2e4), (30.0, 2e4),
    }  # fmt: skip
    # Every five seconds, while they do not come; ATTITUDE once ATTITUDE_QUATERNION did not.
    assert len(requests) == 14
