"""Every field of a MAVLink message in the record it becomes, and each limit on and beyond it."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from drivers.contract import EventMark, NavSample
from drivers.receivers.mavlink.decoder import MavlinkDecoder
from tests.drivers.test_mavlink import BOOT_MS, UNIX_US, Bus, decode, marks, samples


def started(bus: Bus, boot_ms: int = BOOT_MS) -> bytes:
    return bus.heartbeat() + bus.system_time(UNIX_US, boot_ms)


def gps(bus: Bus, **changes: Any) -> bytes:
    fields = {
        "time_usec": 0, "fix_type": 3, "lat": 475_000_000, "lon": 85_000_000, "alt": 952_500,
        "eph": 80, "epv": 90, "vel": 6000, "cog": 0, "satellites_visible": 17,
        "alt_ellipsoid": 1_000_000, "h_acc": 20, "v_acc": 30, "vel_acc": 40, "hdg_acc": 0, "yaw": 0,
    } | changes  # fmt: skip
    return bus.pack_message(dialect.MAVLink_gps_raw_int_message(**fields))


def place(bus: Bus, boot_ms: int = BOOT_MS, **changes: Any) -> bytes:
    fields = {
        "time_boot_ms": boot_ms, "lat": 475_000_000, "lon": 85_000_000, "alt": 952_500,
        "relative_alt": 0, "vx": 6000, "vy": 300, "vz": -100, "hdg": 1000,
    } | changes  # fmt: skip
    return bus.pack_message(dialect.MAVLink_global_position_int_message(**fields))


def quaternion(bus: Bus, boot_ms: int, *values: float) -> bytes:
    message = dialect.MAVLink_attitude_quaternion_message(boot_ms, *values, 0, 0, 0)
    return bus.pack_message(message)


def angles(bus: Bus, boot_ms: int, roll: float, pitch: float, heading: float) -> bytes:
    return bus.pack_message(
        dialect.MAVLink_attitude_message(boot_ms, roll, pitch, heading, 0, 0, 0)
    )


def one(**changes: Any) -> NavSample:
    bus = Bus()
    return samples(started(bus) + gps(bus, **changes) + place(bus))[0]


@pytest.mark.parametrize(
    ("fix_type", "fix"),
    [(0, "none"), (1, "none"), (2, "2d"), (3, "3d"), (4, "3d"), (5, "3d"), (6, "3d"), (8, "3d")],
)
def test_the_fix_type_is_the_fix(fix_type: int, fix: str) -> None:
    sample = one(fix_type=fix_type)
    assert sample.fix == fix
    assert (sample.latitude_deg is not None) is (fix != "none")
    assert (sample.height_m is not None) is (fix == "3d")
    assert (sample.vertical_sigma_m is not None) is (fix == "3d")
    bus = Bus()
    assert decode(started(bus) + gps(bus, fix_type=fix_type))[0].fix == fix


def test_satellites_and_accuracies_that_are_not_reported_stay_unknown() -> None:
    sample = one()
    assert (sample.satellites, sample.speed_sigma_mps) == (17, pytest.approx(0.04))
    bare = one(satellites_visible=255, h_acc=0, v_acc=0, vel_acc=0)
    assert (bare.satellites, bare.speed_sigma_mps) == (None, None)
    assert (bare.horizontal_sigma_m, bare.vertical_sigma_m) == (None, None)
    assert (sample.sigma_source, bare.sigma_source) == ("receiver", "none")
    for field_value, known in ((254, 254), (255, None)):
        bus = Bus()
        decoder, _ = decode(started(bus) + gps(bus, satellites_visible=field_value))
        assert decoder.satellites == known


def test_sigmas_hold_what_is_flown_in_the_time_that_is_unsure() -> None:
    bus = Bus()
    decoder, (sample,) = decode(started(bus) + gps(bus) + place(bus))
    assert isinstance(sample, NavSample)
    time_s = decoder.clock.sigma_ns(BOOT_MS * 1_000_000 + 500_000) * 1e-9
    assert time_s > 0
    assert sample.horizontal_sigma_m == pytest.approx(
        math.hypot(0.02, math.hypot(60.0, 3.0) * time_s)
    )
    assert sample.vertical_sigma_m == pytest.approx(math.hypot(0.03, 1.0 * time_s))


def test_the_height_is_over_the_ellipsoid_by_what_is_reported_or_configured() -> None:
    assert one().height_m == pytest.approx(1000.0)
    assert one(alt_ellipsoid=0).height_m is None
    bus = Bus()
    data = started(bus) + gps(bus, alt_ellipsoid=0) + place(bus)
    _, (sample,) = decode(data, undulation_m=40.0)
    assert isinstance(sample, NavSample) and sample.height_m == pytest.approx(992.5)
    bus = Bus()
    _, (blind,) = decode(started(bus) + place(bus), undulation_m=40.0)
    assert isinstance(blind, NavSample)
    assert (blind.fix, blind.satellites, blind.height_m) == ("none", None, None)


@pytest.mark.parametrize(
    ("age_ms", "fix"), [(5_000, "3d"), (5_001, "dead-reckoning")], ids=["on it", "beyond"]
)
def test_a_quality_is_that_of_the_position_for_5_s(age_ms: int, fix: str) -> None:
    bus = Bus()
    sample = samples(started(bus) + gps(bus) + place(bus, BOOT_MS + age_ms))[0]
    assert sample.fix == fix
    assert (sample.satellites, sample.horizontal_sigma_m is None) == (
        (17, False) if fix == "3d" else (None, True)
    )


@pytest.mark.parametrize(
    ("changes", "is_place"),
    [
        ({"lat": 900_000_000}, True),
        ({"lat": -900_000_000}, True),
        ({"lat": 900_000_001}, False),
        ({"lon": 1_800_000_000}, True),
        ({"lon": -1_800_000_001}, False),
    ],
)
def test_a_place_lies_between_the_poles_and_within_180_degrees(
    changes: dict[str, int], is_place: bool
) -> None:
    bus = Bus()
    decoder, records = decode(started(bus) + gps(bus) + place(bus, **changes))
    assert (len(records), decoder.bad_messages) == ((1, 0) if is_place else (0, 1))


@pytest.mark.parametrize(("gap_ms", "is_known"), [(500, True), (501, False)])
def test_attitudes_are_interpolated_over_half_a_second(gap_ms: int, is_known: bool) -> None:
    bus = Bus()
    data = started(bus) + gps(bus) + bus.attitude(BOOT_MS, 80.0)
    data += place(bus, BOOT_MS + 100) + bus.attitude(BOOT_MS + gap_ms, 90.0)
    (sample,) = samples(data)
    heading = math.radians(80.0 + 10.0 * 100 / 500)
    assert sample.heading_rad == (pytest.approx(heading, abs=1e-6) if is_known else None)


@pytest.mark.parametrize(("age_ms", "count"), [(0, 1), (1, 0), (499, 0), (500, 1)])
def test_a_position_waits_for_the_next_attitude_where_they_come(age_ms: int, count: int) -> None:
    bus = Bus()
    data = started(bus) + gps(bus) + bus.attitude(BOOT_MS, 80.0) + place(bus, BOOT_MS + age_ms)
    assert len(samples(data)) == count
    assert len(samples(data + place(bus, BOOT_MS + age_ms + 600))) == 2, "the next one sends it"


def test_the_last_256_attitudes_are_known() -> None:
    bus = Bus()
    data = started(bus) + gps(bus)
    for k in range(257):
        data += bus.attitude(BOOT_MS + k, 80.0)
    forgotten, known = samples(data + place(bus, BOOT_MS) + place(bus, BOOT_MS + 1))
    assert forgotten.heading_rad is None
    assert known.heading_rad == pytest.approx(math.radians(80.0), abs=1e-6)


@pytest.mark.parametrize(
    ("norm", "is_rotation"), [(0.5, False), (0.51, True), (1.99, True), (2.0, False)]
)
def test_a_quaternion_is_a_rotation_within_half_and_twice_its_norm(
    norm: float, is_rotation: bool
) -> None:
    bus = Bus()
    quarter_turn = (norm * math.sqrt(0.5), 0.0, 0.0, norm * math.sqrt(0.5))
    exact = (norm, 0.0, 0.0, 0.0) if norm in (0.5, 2.0) else quarter_turn
    data = started(bus) + gps(bus) + quaternion(bus, BOOT_MS, *exact) + place(bus)
    decoder, (sample,) = decode(data)
    assert decoder.bad_messages == (not is_rotation)
    assert isinstance(sample, NavSample)
    heading = pytest.approx(math.pi / 2, abs=1e-6) if is_rotation else None
    assert sample.heading_rad == heading


@pytest.mark.parametrize(("later_ms", "is_read"), [(0, False), (999, False), (1000, True)])
def test_angles_are_read_from_1_s_after_the_last_quaternion(later_ms: int, is_read: bool) -> None:
    bus = Bus()
    data = started(bus) + gps(bus) + bus.attitude(BOOT_MS, 80.0)
    data += angles(bus, BOOT_MS + later_ms, 0.0, 0.0, math.radians(10.0))
    at_ms = BOOT_MS + (later_ms if is_read else 0)
    heading = math.radians(10.0 if is_read else 80.0)
    (sample,) = samples(data + place(bus, at_ms))
    assert sample.heading_rad == pytest.approx(heading, abs=1e-6)


@pytest.mark.parametrize(("angle", "is_one"), [(6.25, True), (-6.25, True), (6.2833, False)])
def test_an_angle_is_at_most_360_degrees(angle: float, is_one: bool) -> None:
    for values in ((angle, 0.0, 0.0), (0.0, angle, 0.0), (0.0, 0.0, angle)):
        bus = Bus()
        decoder, _ = decode(started(bus) + angles(bus, BOOT_MS, *values))
        assert decoder.bad_messages == (not is_one)


@pytest.mark.parametrize(("back_ms", "is_known"), [(1000, True), (1001, False)])
def test_a_clock_more_than_1_s_behind_has_started_again(back_ms: int, is_known: bool) -> None:
    bus = Bus()
    data = started(bus) + gps(bus)
    for at_ms in (0, 200, 1000):
        data += bus.attitude(BOOT_MS + at_ms, 80.0)
    data += place(bus, BOOT_MS + 1000 - back_ms)
    later = place(bus, BOOT_MS + 100)
    heading_rad = samples(data + later)[-1].heading_rad
    assert (heading_rad is not None) is is_known


def test_component_1_is_read_before_a_heartbeat_identifies_it() -> None:
    for component, lost in ((1, 0), (2, 1)):
        bus = Bus(1, component)
        decoder, _ = decode(bus.system_time(), system=1)
        assert decoder.counters["messages_of_others"] == lost
    assert (MavlinkDecoder("fc").system, MavlinkDecoder("fc").component) == (0, 1)


def test_of_several_on_the_bus_the_first_autopilot_is_read() -> None:
    camera, first, second = Bus(1, 100), Bus(1, 1), Bus(2, 1)
    decoder, _ = decode(camera.heartbeat(8) + first.heartbeat(12) + second.heartbeat(3))
    assert (decoder.system, decoder.component, decoder.autopilot) == (1, 1, 12)
    assert decoder.counters["messages_of_others"] == 2
    assert dict(decoder.seen) == {"HEARTBEAT": 1}


@pytest.mark.parametrize(("left_out", "lost"), [(0, 0), (1, 1), (5, 5), (255, 255)])
def test_messages_that_are_missing_in_the_sequence_are_counted(left_out: int, lost: int) -> None:
    bus = Bus()
    data = bus.heartbeat()
    for _ in range(left_out):
        bus.heartbeat()
    decoder, _ = decode(data + bus.heartbeat())
    assert decoder.counters["messages_lost"] == lost


def test_a_mark_has_the_accuracy_of_trigger_and_clock_and_a_count_of_32_bits() -> None:
    bus = Bus()
    data = started(bus) + bus.trigger(BOOT_MS * 1000, 7)
    decoder, (mark,) = decode(data, mark_accuracy_ns=3_000_000)
    assert isinstance(mark, EventMark)
    known = decoder.clock.gps_of_us(BOOT_MS * 1000)
    assert known is not None
    assert (mark.gps_ns, mark.accuracy_ns) == (known[0], round(math.hypot(3e6, known[1])))
    assert (mark.channel, mark.count, mark.count_bits, mark.time_valid) == (0, 7, 32, True)
    assert decoder.counters["marks"] == 1
    bus = Bus()
    decoder, (blind,) = decode(bus.heartbeat() + bus.trigger(5_000, 8))
    assert isinstance(blind, EventMark)
    assert (blind.gps_ns, blind.time_valid, blind.count) == (5_000_000, False, 8)
    assert decoder.counters["marks_without_time"] == 1
    assert blind.accuracy_ns == round(math.hypot(1e6, decoder.clock.utc_sigma_ns))
    assert marks(Bus().heartbeat()) == []


def test_refused_commands_are_stored_with_their_result() -> None:
    bus = Bus()
    data = bus.heartbeat()
    for command, result in ((203, 0), (206, 4)):
        data += bus.pack_message(dialect.MAVLink_command_ack_message(command, result))
    assert list(decode(data)[0].refusals) == [(206, 4)]


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_measurement_that_is_no_number_is_bad(value: float) -> None:
    bus = Bus()
    good = dialect.MAVLink_highres_imu_message(0, *[0.5] * 13, 0)
    bad = dialect.MAVLink_highres_imu_message(0, *[0.5] * 5, value, *[0.5] * 7, 0)
    decoder, _ = decode(bus.heartbeat() + bus.pack_message(good) + bus.pack_message(bad))
    assert (decoder.bad_messages, decoder.seen["HIGHRES_IMU"]) == (1, 1)
