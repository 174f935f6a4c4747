"""The emulated autopilot against pymavlink, message by message, and against MAVSDK, alive."""

from __future__ import annotations

import math
import socket
import struct
import time
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_hw.devices.network_line import UdpLine
from sim_hw.receivers.mavlink_autopilot import DEFAULT_HZ, MavlinkAutopilot
from sim_hw.receivers.mavlink_messages import (
    MavlinkStreamParser,
    ReceivedMessage,
    definitions,
    message,
    x25,
)
from sim_hw.world.world_clock import WorldClock
from tests.sim_hw.receiver_state import NS, START_GPS_NS, STATE, state_at

pytestmark = pytest.mark.realtime


dialect = pytest.importorskip(
    "pymavlink.dialects.v20.ardupilotmega", reason="pymavlink is absent; pip install it"
)
BOOT_NS = 754 * NS
UNIX_S = START_GPS_NS // NS - 18 + 315_964_800


@pytest.fixture
def autopilot() -> Iterator[MavlinkAutopilot]:
    """An autopilot on the test's clock: the host's monotonic clock begins at 0 with the world."""
    autopilot = MavlinkAutopilot(WorldClock(START_GPS_NS, 0), state_at, drift_ppm=0.0)
    yield autopilot
    autopilot.close()


def parsed(data: bytes) -> list[Any]:
    """Every message by pymavlink; bytes that are none are an error."""
    messages = dialect.MAVLink(None).parse_buffer(bytearray(data)) or []
    assert sum(len(m.get_msgbuf()) for m in messages) == len(data)
    return list(messages)


def parsed_values(data: bytes) -> ReceivedMessage:
    (received,) = MavlinkStreamParser().feed(data)
    return received


def answers_to(autopilot: MavlinkAutopilot, request: Any, mono_ns: int = NS) -> list[Any]:
    """What it answers to a message that pymavlink packed."""
    packed = bytes(request.pack(dialect.MAVLink(None, 255, 190)))
    return parsed(autopilot.answer(parsed_values(packed), mono_ns))


def command(number: int, *parameters: float) -> Any:
    filled = [*parameters, *[0.0] * (7 - len(parameters))]
    return dialect.MAVLink_command_long_message(1, 1, number, 0, *filled)


@pytest.mark.parametrize("name", list(definitions()))
def test_every_definition_is_that_of_pymavlink_down_to_its_checksum(name: str) -> None:
    ours, theirs = definitions()[name], dialect.mavlink_map[definitions()[name].number]
    assert (ours.name, ours.crc_extra) == (theirs.msgname, theirs.crc_extra)
    assert ours.layout.format == theirs.unpacker.format
    assert [field.name for field in ours.fields] == theirs.ordered_fieldnames


def test_the_checksum_is_the_published_one() -> None:
    assert x25(b"123456789") == 0x6F91


def test_trailing_zeros_are_cut_but_a_message_is_never_empty() -> None:
    assert len(message("TIMESYNC", 0, 1, 1, tc1=0, ts1=1)) == 12 + 9
    assert len(message("TIMESYNC", 0, 1, 1)) == 12 + 1


def test_pymavlink_reads_the_numbers_that_were_put_in(autopilot: MavlinkAutopilot) -> None:
    autopilot._set_period("HIGHRES_IMU", NS, 0)
    found = {m.get_type(): m for m in parsed(autopilot.messages_until(1_234_567))}
    assert list(found) == list(DEFAULT_HZ)
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in found.values()} == {(1, 1)}
    assert (found["HEARTBEAT"].autopilot, found["HEARTBEAT"].type) == (12, 1)
    system_time = found["SYSTEM_TIME"]
    assert system_time.time_unix_usec == UNIX_S * 1_000_000 + 1234
    assert system_time.time_boot_ms == 754_001
    position = found["GLOBAL_POSITION_INT"]
    assert (position.lat, position.lon) == (481_371_543, -115_761_243)
    assert (position.alt, position.vx, position.vy, position.vz) == (1_188_567, 6123, -1234, 57)
    assert (position.time_boot_ms, position.hdg) == (754_001, 34_860)
    gps = found["GPS_RAW_INT"]
    assert (gps.alt_ellipsoid - gps.alt, gps.h_acc, gps.v_acc, gps.vel_acc) == (46_000, 20, 30, 30)
    assert (gps.fix_type, gps.satellites_visible, gps.time_usec) == (6, 17, 754_001_234)
    q = found["ATTITUDE_QUATERNION"]
    roll, pitch, heading = angles(q.q1, q.q2, q.q3, q.q4)
    assert math.degrees(roll) == pytest.approx(STATE.roll_deg, abs=1e-4)
    assert math.degrees(pitch) == pytest.approx(STATE.pitch_deg, abs=1e-4)
    assert math.degrees(heading) % 360 == pytest.approx(STATE.heading_deg, abs=1e-4)
    imu = found["HIGHRES_IMU"]
    assert math.hypot(imu.xacc, imu.yacc, imu.zacc) == pytest.approx(9.80665, rel=1e-6)
    assert imu.zacc < -9.7


def angles(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Roll, pitch, yaw by the rotation matrix, as pymavlink's own quaternion class has them."""
    return (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(2 * (w * y - z * x)),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )


def test_a_strobe_is_reported_with_its_own_time_and_number(autopilot: MavlinkAutopilot) -> None:
    autopilot.messages_until(0)
    for at_ms in (40, 20):
        autopilot.mark(START_GPS_NS + at_ms * 1_000_000 + 789)
    parsed_messages = parsed(autopilot.messages_until(50_000_000))
    triggers = [m for m in parsed_messages if m.get_type() == "CAMERA_TRIGGER"]
    assert [(m.time_usec, m.seq) for m in triggers] == [(754_020_000, 1), (754_040_000, 0)]
    utc = MavlinkAutopilot(WorldClock(START_GPS_NS, 0), state_at, triggers_in_utc=True)
    utc.mark(START_GPS_NS + 123_456)
    (trigger,) = [m for m in parsed(utc.messages_until(NS)) if m.get_type() == "CAMERA_TRIGGER"]
    utc.close()
    assert trigger.time_usec == UNIX_S * 1_000_000 + 123


def test_a_request_for_time_is_answered_with_its_own_stamp(autopilot: MavlinkAutopilot) -> None:
    (answer,) = answers_to(autopilot, dialect.MAVLink_timesync_message(0, 77), 2 * NS + 5)
    assert (answer.tc1, answer.ts1) == (BOOT_NS + 2 * NS + 5, 77)
    assert answers_to(autopilot, dialect.MAVLink_timesync_message(9, 77)) == []


def test_rates_are_set_by_command_and_by_stream(autopilot: MavlinkAutopilot) -> None:
    (done,) = answers_to(autopilot, command(511, 33, 20_000.0))
    assert (done.command, done.result, done.target_system) == (511, 0, 255)
    assert count(autopilot, NS, "GLOBAL_POSITION_INT") == 50
    answers_to(autopilot, command(511, 33, -1.0), 2 * NS)
    assert count(autopilot, 3 * NS, "GLOBAL_POSITION_INT") == 0
    answers_to(autopilot, dialect.MAVLink_request_data_stream_message(1, 1, 10, 25, 1), 4 * NS)
    assert count(autopilot, 4 * NS, "ATTITUDE_QUATERNION") == 25
    (refused,) = answers_to(autopilot, command(511, 999, 20_000.0))
    assert refused.result == 2
    (strange,) = answers_to(autopilot, command(511, math.nan, math.nan))
    assert strange.result == 2


def count(autopilot: MavlinkAutopilot, from_ns: int, name: str) -> int:
    """Number of messages of that kind within a second."""
    parsed_messages = b"".join(
        autopilot.messages_until(from_ns + n * 1_000_000) for n in range(1000)
    )
    return sum(m.get_type() == name for m in parsed(parsed_messages))


def test_messages_intervals_and_parameters_are_reported_on_request(
    autopilot: MavlinkAutopilot,
) -> None:
    done, version = answers_to(autopilot, command(512, 148))
    assert (done.result, version.get_type()) == (0, "AUTOPILOT_VERSION")
    _, interval = answers_to(autopilot, command(510, 33))
    assert (interval.message_id, interval.interval_us) == (33, 200_000)
    (unknown,) = answers_to(autopilot, command(176, 1))
    assert unknown.result == 3
    listed = answers_to(autopilot, dialect.MAVLink_param_request_list_message(1, 1))
    assert [p.param_index for p in listed] == list(range(listed[0].param_count))
    read = dialect.MAVLink_param_request_read_message(1, 1, b"TRIG_MODE", -1)
    assert answers_to(autopilot, read)[0].param_value == 4.0
    change = dialect.MAVLink_param_set_message(1, 1, b"TRIG_MODE", 2.0, 9)
    assert answers_to(autopilot, change)[0].param_value == 2.0
    assert answers_to(autopilot, read)[0].param_value == 2.0
    assert answers_to(autopilot, dialect.MAVLink_param_request_list_message(2, 1)) == []


def test_faults_distinguish_marks_from_navigation(autopilot: MavlinkAutopilot) -> None:
    autopilot.mark(START_GPS_NS)
    parsed_messages = autopilot.messages_until(NS)
    parts = autopilot.parts(parsed_messages)
    assert b"".join(data for _, data in parts) == parsed_messages
    assert [topic for topic, _ in parts].count("mark") == 1
    assert parts[0][0] == "mark"
    autopilot.restart_count()
    autopilot.mark(START_GPS_NS + 2 * NS)
    (trigger,) = [
        m for m in parsed(autopilot.messages_until(3 * NS)) if m.get_type() == "CAMERA_TRIGGER"
    ]
    assert trigger.seq == 0


@settings(max_examples=200, deadline=None)
@given(noise=st.binary(max_size=120), piece=st.integers(1, 40))
def test_what_a_host_writes_may_be_anything(noise: bytes, piece: int) -> None:
    listener = MavlinkStreamParser()
    # Noise that looks like a header may hold back what follows until it is whole; then it is over.
    data = noise + message("TIMESYNC", 1, 255, 1, ts1=5) + bytes(300)
    found = [m for at in range(0, len(data), piece) for m in listener.feed(data[at : at + piece])]
    assert [m.values["ts1"] for m in found if m.name == "TIMESYNC"][-1:] == [5]


def test_a_damaged_message_is_not_received() -> None:
    data = bytearray(message("TIMESYNC", 1, 255, 1, ts1=5))
    data[-1] ^= 1
    assert MavlinkStreamParser().feed(bytes(data)) == []
    assert struct.calcsize(definitions()["TIMESYNC"].layout.format) == 16


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.mark.peer
def test_mavsdk_finds_the_vehicle_and_reads_its_place_and_attitude() -> None:
    mavsdk = pytest.importorskip("mavsdk", reason="mavsdk is absent; pip install it")
    from mavsdk.plugins.telemetry import Telemetry

    port = free_udp_port()
    autopilot = MavlinkAutopilot(
        WorldClock.from_wall_clock(), state_at, line=UdpLine(("127.0.0.1", port))
    )
    autopilot.start()
    sdk = mavsdk.Mavsdk(mavsdk.Configuration.create_with_component_type(
        mavsdk.ComponentType.GROUND_STATION
    ))  # fmt: skip
    try:
        sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        deadline = time.monotonic() + 30
        while not sdk.get_systems() and time.monotonic() < deadline:
            time.sleep(0.1)
        (system,) = sdk.get_systems()
        telemetry = Telemetry(system)
        while time.monotonic() < deadline:
            place, lean = telemetry.position(), telemetry.attitude_quaternion()
            if abs(place.latitude_deg) > 1 and abs(lean.w) > 0.1:
                break
            time.sleep(0.1)
        assert place.latitude_deg == pytest.approx(STATE.latitude_deg, abs=1e-7)
        assert place.absolute_altitude_m == pytest.approx(STATE.height_m - 46.0, abs=1e-2)
        roll, pitch, heading = (math.degrees(a) for a in angles(lean.w, lean.x, lean.y, lean.z))
        assert (roll, pitch) == pytest.approx((STATE.roll_deg, STATE.pitch_deg), abs=1e-3)
        assert heading % 360 == pytest.approx(STATE.heading_deg, abs=1e-3)
    finally:
        autopilot.close()
