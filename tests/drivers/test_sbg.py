"""sbgECom logs: time stamps tied to GPS time, events, and every way in which a clock is not
valid."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.contract import EventMark, NavSample
from drivers.receivers.message_decoder import Nav
from drivers.receivers.sbg.decoder import SbgDecoder
from drivers.receivers.sbg.framing import crc
from sim_hw.receivers import sbg_messages as sbg
from sim_hw.receivers.emulated_receiver import ReceiverAccuracy
from tests.sim_hw.receiver_state import NS, START_GPS_NS, STATE, WEEK_NS

SECOND_US = 1_000_000
UTC = sbg.utc_time(0, START_GPS_NS, 18)
MONO_NS = 5 * NS


def nav(stamp_us: int, status: int = sbg.NOMINAL_SOLUTION) -> bytes:
    return sbg.ekf_nav(stamp_us, STATE, ReceiverAccuracy(), status)


def euler(stamp_us: int, status: int = sbg.NOMINAL_SOLUTION) -> bytes:
    return sbg.ekf_euler(stamp_us, STATE, ReceiverAccuracy(), status)


def decode(*pieces: bytes, decoder: SbgDecoder | None = None) -> tuple[SbgDecoder, list[Nav]]:
    decoder = decoder or SbgDecoder("ins")
    return decoder, [r for piece in pieces for r in decoder.feed(piece, MONO_NS)]


def marks(*pieces: bytes) -> list[EventMark]:
    return [r for r in decode(*pieces)[1] if isinstance(r, EventMark)]


def samples(*pieces: bytes) -> list[NavSample]:
    return [r for r in decode(*pieces)[1] if isinstance(r, NavSample)]


def test_the_crc_is_the_published_one_of_its_kind() -> None:
    # CRC-16/KERMIT in the catalogue of parametrised CRC algorithms: check value 0x2189.
    assert crc(b"123456789") == sbg.crc16(b"123456789") == 0x2189


def test_a_solution_comes_out_in_si_units_and_above_the_ellipsoid() -> None:
    decoder, (sample,) = decode(UTC, sbg.gps1_pos(0, START_GPS_NS, STATE, ReceiverAccuracy(), 19),
                                euler(250_000), nav(250_000))  # fmt: skip
    assert isinstance(sample, NavSample)
    assert sample.gps_ns == START_GPS_NS + 250_000_000
    assert (sample.latitude_deg, sample.longitude_deg) == (STATE.latitude_deg, STATE.longitude_deg)
    assert sample.height_m == pytest.approx(STATE.height_m, abs=1e-6)
    assert sample.velocity_ned_mps == pytest.approx(STATE.velocity_ned_mps, abs=1e-5)
    assert sample.roll_rad == pytest.approx(math.radians(STATE.roll_deg))
    assert sample.pitch_rad == pytest.approx(math.radians(STATE.pitch_deg))
    assert sample.heading_rad == pytest.approx(math.radians(STATE.heading_deg))
    assert sample.horizontal_sigma_m == pytest.approx(0.02)
    assert sample.vertical_sigma_m == pytest.approx(0.03)
    assert sample.speed_sigma_mps == pytest.approx(0.03)
    assert (sample.fix, sample.satellites, sample.leap_seconds) == ("3d", 19, 18)
    assert sample.time_valid
    assert decoder.leap_seconds == 18


def test_a_quaternion_is_the_attitude_of_its_angles() -> None:
    roll, pitch, yaw = (math.radians(a) / 2 for a in (30.0, -20.0, 100.0))
    w = math.cos(roll) * math.cos(pitch) * math.cos(yaw) + math.sin(roll) * math.sin(
        pitch
    ) * math.sin(yaw)
    x = math.sin(roll) * math.cos(pitch) * math.cos(yaw) - math.cos(roll) * math.sin(
        pitch
    ) * math.sin(yaw)
    y = math.cos(roll) * math.sin(pitch) * math.cos(yaw) + math.sin(roll) * math.cos(
        pitch
    ) * math.sin(yaw)
    z = math.cos(roll) * math.cos(pitch) * math.sin(yaw) - math.sin(roll) * math.sin(
        pitch
    ) * math.cos(yaw)
    body = struct.pack("<7fI", w, x, y, z, 0.1, 0.1, 0.1, sbg.NOMINAL_SOLUTION)
    (sample,) = samples(UTC, sbg.frame(sbg.EKF_QUAT, 0, body), nav(0))
    angles = (sample.roll_rad, sample.pitch_rad, sample.heading_rad)
    assert angles == pytest.approx([math.radians(a) for a in (30.0, -20.0, 100.0)], abs=1e-6)
    decoder, records = decode(UTC, sbg.frame(sbg.EKF_QUAT, 0, struct.pack("<7fI", *[0.1] * 7, 4)))
    assert (records, decoder.bad_messages) == ([], 1)


def test_attitude_and_position_of_one_stamp_are_one_sample_in_either_order() -> None:
    first = samples(UTC, euler(0), nav(0), nav(100_000), euler(100_000), nav(200_000), nav(300_000))
    assert [s.gps_ns - START_GPS_NS for s in first] == [0, 100_000_000, 200_000_000]
    assert [s.roll_rad is None for s in first] == [False, False, True]


@pytest.mark.parametrize(
    ("status", "fix", "has_heading"),
    [
        (sbg.NOMINAL_SOLUTION, "3d", True),
        (sbg.NOMINAL_SOLUTION & ~(1 << 11), "dead-reckoning", True),
        (sbg.NOMINAL_SOLUTION & ~(1 << 11) | 1 << 15, "3d", True),
        (sbg.NOMINAL_SOLUTION & ~(1 << 7), "dead-reckoning", True),
        (sbg.NOMINAL_SOLUTION & ~(1 << 5), "3d", False),
        (sbg.NOMINAL_SOLUTION & ~0xF | 3, "dead-reckoning", True),
        (sbg.NOMINAL_SOLUTION & ~0xF | 2, "none", True),
        (0, "none", False),
    ],
)
def test_the_solution_status_is_the_fix(status: int, fix: str, has_heading: bool) -> None:
    (sample,) = samples(UTC, euler(0, status), nav(0, status))
    assert sample.fix == fix
    assert (sample.heading_rad is not None) == has_heading
    assert (sample.latitude_deg is None) == (fix == "none")
    assert (sample.roll_rad is None) == (status == 0)


def test_an_event_is_a_mark_at_gps_time_on_its_pin() -> None:
    (mark,) = marks(UTC, nav(0), sbg.event(300_123, channel=2))
    assert (mark.channel, mark.gps_ns) == (2, START_GPS_NS + 300_123_000)
    assert (mark.time_valid, mark.count_bits, mark.accuracy_ns) == (True, 0, 1000)


def test_up_to_five_events_of_one_log_are_as_many_marks() -> None:
    found = marks(UTC, sbg.event(1_000, (2_000, 4_500, 7_000, 65_535)))
    assert [m.gps_ns - START_GPS_NS for m in found] == [
        1_000_000, 3_000_000, 5_500_000, 8_000_000, 66_535_000,
    ]  # fmt: skip


def test_events_that_came_too_fast_are_counted_as_lost() -> None:
    assert decode(UTC, sbg.event(1_000, status=1))[0].counters["marks_overflow"] == 1


def test_a_repeated_event_is_one_mark() -> None:
    decoder, records = decode(UTC, sbg.event(1_000), sbg.event(1_000), sbg.event(3_001))
    assert len(records) == 2
    assert decoder.counters["marks_duplicate"] == 1


@pytest.mark.parametrize(
    ("clock", "utc_status", "count", "is_valid"),
    [
        (sbg.CLOCK_VALID, sbg.UTC_VALID, 1, True),
        (sbg.CLOCK_VALID, sbg.UTC_NO_LEAP_SECONDS, 1, True),
        (sbg.CLOCK_STEERING, sbg.UTC_VALID, 1, False),
        (sbg.CLOCK_FREE_RUNNING, sbg.UTC_VALID, 1, False),
        (0, sbg.UTC_VALID, 1, False),
        (sbg.CLOCK_VALID, sbg.UTC_INVALID, 0, False),
    ],
)
def test_a_mark_before_the_clock_is_valid_is_not_valid(
    clock: int, utc_status: int, count: int, is_valid: bool
) -> None:
    utc = sbg.utc_time(0, START_GPS_NS, 18, clock, utc_status)
    decoder, records = decode(utc, euler(0), nav(0), sbg.event(1_000))
    found = [r for r in records if isinstance(r, EventMark)]
    assert [m.time_valid for m in found] == [is_valid] * count
    assert [r.time_valid for r in records if isinstance(r, NavSample)] == [is_valid] * count
    assert decoder.counters["marks_without_time"] == 1 - count
    assert decoder.leap_seconds == (18 if utc_status == sbg.UTC_VALID else None)


def test_leap_seconds_of_the_firmwares_default_change_no_gps_time() -> None:
    utc = sbg.utc_time(0, START_GPS_NS, 16, utc_status=sbg.UTC_NO_LEAP_SECONDS)
    assert [m.gps_ns for m in marks(utc, sbg.event(0))] == [START_GPS_NS]


def test_time_stamps_wrap_after_71_minutes() -> None:
    last = (1 << 32) - 200_000
    found = marks(sbg.utc_time(last, START_GPS_NS, 18), sbg.event(300_000))
    assert [m.gps_ns - START_GPS_NS for m in found] == [500_000_000]


def test_a_week_ends_between_utc_and_event() -> None:
    before = sbg.utc_time(0, START_GPS_NS // WEEK_NS * WEEK_NS - 100_000_000, 18)
    (mark,) = marks(before, sbg.event(250_000))
    assert mark.gps_ns == START_GPS_NS // WEEK_NS * WEEK_NS + 150_000_000


def test_utc_that_is_old_gives_no_time_not_even_a_wrap_later() -> None:
    decoder = SbgDecoder("ins")
    decoder.feed(UTC, MONO_NS)
    for later_s, stamp_us in ((6, 6 * SECOND_US), (4295, 32_704)):
        assert decoder.feed(sbg.event(stamp_us), MONO_NS + later_s * NS) == []
    assert decoder.feed(sbg.event(6 * SECOND_US), MONO_NS + NS) == []
    assert decoder.counters["marks_without_time"] == 3


def test_a_unit_that_was_restarted_has_no_time_until_its_next_utc() -> None:
    before = sbg.utc_time(20 * SECOND_US, START_GPS_NS, 18)
    decoder, records = decode(before, sbg.event(20 * SECOND_US), sbg.event(18 * SECOND_US))
    assert len(records) == 1
    assert (decoder.counters["restarts"], decoder.counters["marks_without_time"]) == (1, 1)
    assert len(decoder.feed(sbg.utc_time(19 * SECOND_US, START_GPS_NS + NS, 18), MONO_NS)) == 0
    assert len(decoder.feed(sbg.event(19 * SECOND_US), MONO_NS)) == 1


def test_a_mark_an_hour_from_navigation_is_not_valid() -> None:
    decoder, _ = decode(UTC, euler(0), nav(0))
    far = sbg.utc_time(SECOND_US, START_GPS_NS - 1024 * WEEK_NS, 18)
    (mark,) = decode(far, sbg.event(SECOND_US), decoder=decoder)[1]
    assert isinstance(mark, EventMark)
    assert not mark.time_valid
    assert decoder.counters["marks_far"] == 1


def test_logs_of_later_firmware_are_longer_and_shorter_ones_are_bad() -> None:
    longer = sbg.frame(sbg.EKF_NAV, 0, nav(0)[10:-3] + b"\0\0\0\0")
    assert len(samples(UTC, euler(0), longer)) == 1
    decoder, records = decode(UTC, sbg.frame(sbg.EKF_NAV, 0, nav(0)[10:-4]))
    assert (records, decoder.bad_messages) == ([], 1)


@pytest.mark.parametrize("place", [(91.0, 0.0), (0.0, 361.0), (math.nan, 0.0), (math.inf, 0.0)])
def test_a_position_that_is_none_is_a_bad_log(place: tuple[float, float]) -> None:
    wrong = replace(STATE, latitude_deg=place[0], longitude_deg=place[1])
    decoder, records = decode(UTC, euler(0), sbg.ekf_nav(0, wrong, ReceiverAccuracy()))
    assert (records, decoder.bad_messages) == ([], 1)


def test_cut_and_damaged_frames_cost_only_themselves() -> None:
    damaged = bytearray(sbg.event(1_000))
    damaged[10] ^= 1
    decoder, records = decode(UTC, bytes(damaged) + sbg.event(5_000)[:9] + sbg.event(9_000) * 2)
    assert [r.gps_ns - START_GPS_NS for r in records] == [9_000_000]
    assert decoder.bad_messages >= 1
    assert decoder.bad_bytes >= len(damaged)
    wrong_end = sbg.event(20_000)[:-1] + b"\x34"
    assert (
        decoder.feed(wrong_end + sbg.event(30_000), MONO_NS)[0].gps_ns == START_GPS_NS + 30_000_000
    )


def test_other_classes_and_logs_are_left() -> None:
    fast_imu = bytearray(sbg.frame(0, 0, b"\0" * 24))
    fast_imu[3] = 1
    fast_imu[-3:-1] = struct.pack("<H", crc(bytes(fast_imu[2:-3])))
    decoder, records = decode(bytes(fast_imu), sbg.frame(45, 0, bytes(10)))
    assert (records, decoder.frames, decoder.bad_messages) == ([], 2, 0)


@settings(max_examples=100, deadline=None)
@given(data=st.binary(max_size=300), cut=st.integers(1, 40))
def test_noise_raises_nothing_and_costs_no_later_log(data: bytes, cut: int) -> None:
    decoder = SbgDecoder("ins")
    stream = data + UTC + UTC + sbg.event(1_000) + sbg.event(1_000)
    records = [
        r for at in range(0, len(stream), cut) for r in decoder.feed(stream[at : at + cut], 0)
    ]
    assert [r.gps_ns for r in records if isinstance(r, EventMark)][-1:] == [
        START_GPS_NS + 1_000_000
    ]


def test_an_unknown_number_of_satellites_is_absent_and_of_another_log_is_not_taken() -> None:
    unknown = sbg.gps1_pos(0, START_GPS_NS, STATE, ReceiverAccuracy(), 255)
    assert [s.satellites for s in samples(UTC, unknown, euler(0), nav(0))] == [None]
    known = sbg.gps1_pos(0, START_GPS_NS, STATE, ReceiverAccuracy(), 7)
    assert [s.satellites for s in samples(UTC, known, unknown, euler(0), nav(0))] == [7]


def test_the_poles_are_places_and_what_is_beyond_them_is_none() -> None:
    def at(latitude: float, longitude: float) -> bytes:
        state = replace(STATE, latitude_deg=latitude, longitude_deg=longitude)
        return sbg.ekf_nav(0, state, ReceiverAccuracy())

    for place in ((90.0, 0.0), (-90.0, 360.0)):
        (sample,) = samples(UTC, euler(0), at(*place))
        assert (sample.latitude_deg, sample.longitude_deg) == place
    for place in ((90.0001, 0.0), (0.0, 360.0001)):
        decoder, records = decode(UTC, euler(0), at(*place))
        assert (records, decoder.bad_messages) == ([], 1)
