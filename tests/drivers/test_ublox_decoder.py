"""What UBX messages mean: GPS time in whole nanoseconds, attitude, marks, leap seconds."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.contract import EventMark, NavSample
from drivers.receivers.ublox.decoder import UbxDecoder
from drivers.timescales.gps_time import WEEK_NS, UtcFields, gps_from_utc, gps_near, utc_ns
from tests.drivers.ubx_frames import (
    RECEIVER,
    UTC,
    nav_att,
    nav_eoe,
    nav_pvt,
    nav_timegps,
    nav_timels,
    tim_tm2,
)

# 2026-11-21 10:00:00 UTC, a Saturday: GPS week 2445, 6 days, 10 h and 18 leap seconds.
TEN_UTC = (2026, 11, 21, 10, 0, 0)
WEEK = 2445
ITOW = (6 * 86_400 + 10 * 3600 + 18) * 1000
GPS_NS = WEEK * WEEK_NS + ITOW * 1_000_000


def _samples(*messages: bytes) -> list[NavSample]:
    decoder = UbxDecoder("gnss")
    return [r for r in decoder.feed(b"".join(messages), 77) if isinstance(r, NavSample)]


def _marks(*messages: bytes) -> list[EventMark]:
    decoder = UbxDecoder("gnss")
    return [r for r in decoder.feed(b"".join(messages), 77) if isinstance(r, EventMark)]


# Navigation


def test_a_nav_pvt_comes_out_in_si_units_at_its_gps_time() -> None:
    (sample,) = _samples(nav_pvt(ITOW, TEN_UTC, nano=123_456))
    assert sample.gps_ns == GPS_NS + 123_456
    assert sample.time_valid
    assert sample.leap_seconds == 18
    assert (sample.latitude_deg, sample.longitude_deg, sample.height_m) == (47.5, 8.5, 1000.0)
    assert sample.velocity_ned_mps == (60.0, 3.0, -1.0)
    assert sample.horizontal_sigma_m == pytest.approx(0.8)
    assert sample.vertical_sigma_m == pytest.approx(1.2)
    assert (sample.fix, sample.satellites, sample.mono_ns) == ("3d", 17, 77)


def test_a_negative_nano_is_taken_off() -> None:
    (sample,) = _samples(nav_pvt(ITOW, TEN_UTC, nano=-422_154))
    assert sample.gps_ns == GPS_NS - 422_154


def test_gps_is_already_in_the_next_week_while_utc_is_not() -> None:
    before = (2026, 11, 21, 23, 59, 50)
    (sample,) = _samples(nav_pvt(8_000, before, nano=-5))
    assert sample.gps_ns == (WEEK + 1) * WEEK_NS + 8_000_000_000 - 5


def test_nano_may_reach_back_over_the_weeks_end() -> None:
    (sample,) = _samples(nav_pvt(0, (2026, 11, 21, 23, 59, 42), nano=-300))
    assert sample.gps_ns == (WEEK + 1) * WEEK_NS - 300


def test_time_goes_on_evenly_through_a_leap_second() -> None:
    # The one of 2016-12-31: 17 s before, 18 s after; GPS week 1930 begins on 2017-01-01.
    stamps = [(2016, 12, 31, 23, 59, 59), (2016, 12, 31, 23, 59, 60), (2017, 1, 1, 0, 0, 0)]
    messages = [nav_pvt(16_000 + 1000 * n, utc) for n, utc in enumerate(stamps)]
    samples = _samples(*messages)
    assert [s.gps_ns - 1930 * WEEK_NS for s in samples] == [
        16_000_000_000,
        17_000_000_000,
        18_000_000_000,
    ]
    assert [s.leap_seconds for s in samples] == [17, 17, 18]


def test_a_time_that_is_not_resolved_is_not_valid() -> None:
    for valid in (0b0000, 0b0001, 0b0010, 0b0011, 0b0110):
        (sample,) = _samples(nav_pvt(ITOW, TEN_UTC, valid=valid))
        assert not sample.time_valid, f"valid flags {valid:04b}"
        assert sample.leap_seconds is None


def test_a_date_that_does_not_exist_is_not_valid() -> None:
    (sample,) = _samples(nav_pvt(ITOW, (2026, 0, 0, 0, 0, 0)))
    assert not sample.time_valid


def test_fields_that_contradict_the_time_of_week_are_not_valid() -> None:
    (sample,) = _samples(nav_pvt(ITOW + 400, TEN_UTC))
    assert not sample.time_valid


def test_before_utc_is_resolved_the_week_comes_from_nav_timegps() -> None:
    unresolved = nav_pvt(ITOW + 200, TEN_UTC, valid=0b0011)
    (sample,) = _samples(nav_timegps(ITOW, -5, WEEK, leap=0, valid=0b011), unresolved)
    assert sample.time_valid
    assert sample.gps_ns == GPS_NS + 200_000_000
    assert sample.leap_seconds is None


def test_an_old_nav_timegps_gives_no_valid_time() -> None:
    unresolved = nav_pvt(ITOW + 60_000, TEN_UTC, valid=0)
    (sample,) = _samples(nav_timegps(ITOW, 0, WEEK), unresolved)
    assert not sample.time_valid


def test_a_fix_that_the_receiver_does_not_trust_is_none() -> None:
    assert _samples(nav_pvt(ITOW, TEN_UTC, flags=0))[0].fix == "none"
    fixes = [_samples(nav_pvt(ITOW, TEN_UTC, fix_type=n))[0].fix for n in range(6)]
    assert fixes == ["none", "dead-reckoning", "2d", "3d", "3d", "time"]


# Attitude


def test_attitude_is_joined_by_time_of_week() -> None:
    (sample,) = _samples(
        nav_att(ITOW - 200, 9, 9, 9), nav_att(ITOW, 1.5, -2.25, 359.0), nav_pvt(ITOW, TEN_UTC)
    )
    assert sample.roll_rad == pytest.approx(math.radians(1.5))
    assert sample.pitch_rad == pytest.approx(math.radians(-2.25))
    assert sample.heading_rad == pytest.approx(math.radians(359))


def test_attitude_of_another_epoch_is_not_used() -> None:
    (sample,) = _samples(nav_att(ITOW - 200, 9, 9, 9), nav_pvt(ITOW, TEN_UTC))
    assert sample.roll_rad is None


def test_a_receiver_that_sends_attitude_after_position_is_waited_for() -> None:
    epochs = []
    for n in range(4):
        itow, utc = ITOW + 1000 * n, (*TEN_UTC[:5], n)
        epochs.append(nav_pvt(itow, utc) + nav_att(itow, n, 0, 0) + nav_eoe(itow))
    samples = _samples(*epochs)
    assert [s.gps_ns for s in samples] == [GPS_NS + n * 10**9 for n in range(4)]
    assert [s.roll_rad for s in samples] == [None, *(math.radians(n) for n in (1, 2, 3))]


def test_a_missing_attitude_holds_a_position_back_no_longer_than_its_epoch() -> None:
    decoder = UbxDecoder("gnss")
    decoder.feed(nav_pvt(ITOW, TEN_UTC) + nav_att(ITOW, 1, 0, 0), 0)
    second = nav_pvt(ITOW + 1000, (*TEN_UTC[:5], 1))
    assert decoder.feed(second, 1) == []
    (sample,) = decoder.feed(nav_eoe(ITOW + 1000), 2)
    assert isinstance(sample, NavSample)
    assert (sample.roll_rad, sample.mono_ns) == (None, 1)


# Marks


def test_a_rising_edge_on_gnss_time_is_exact_to_the_nanosecond() -> None:
    (mark,) = _marks(tim_tm2(WEEK, 123_456_789, 987_654, count=65_535))
    assert mark.gps_ns == WEEK * WEEK_NS + 123_456_789_987_654
    assert mark.time_valid
    assert (mark.count, mark.count_bits, mark.accuracy_ns, mark.mono_ns) == (65_535, 16, 24, 77)


def test_a_message_without_a_new_rising_edge_is_no_mark() -> None:
    assert _marks(tim_tm2(WEEK, 1, 2, rising=False, falling=True)) == []


def test_both_edges_in_one_message_are_one_mark_at_the_rising_one() -> None:
    (mark,) = _marks(tim_tm2(WEEK, 5, 2, falling=True))
    assert mark.gps_ns == WEEK * WEEK_NS + 5_000_002


def test_a_mark_in_utc_is_carried_to_gps_by_the_leap_seconds() -> None:
    (mark,) = _marks(nav_timels(0, source=2, leap=18), tim_tm2(WEEK, 1000, 7, base=UTC))
    assert mark.gps_ns == WEEK * WEEK_NS + 19_000_000_007
    assert mark.time_valid


def test_a_mark_in_utc_crosses_the_weeks_end() -> None:
    (mark,) = _marks(nav_timels(0, source=2, leap=18), tim_tm2(WEEK, 604_790_000, 0, base=UTC))
    assert mark.gps_ns == (WEEK + 1) * WEEK_NS + 8_000_000_000


def test_a_mark_in_utc_without_received_leap_seconds_is_not_valid() -> None:
    (mark,) = _marks(nav_timels(0, source=0, leap=18), tim_tm2(WEEK, 1000, 7, base=UTC))
    assert not mark.time_valid


def test_a_mark_on_the_receivers_own_time_is_not_valid() -> None:
    (mark,) = _marks(tim_tm2(WEEK, 1000, 7, base=RECEIVER))
    assert not mark.time_valid


def test_a_mark_whose_time_the_receiver_does_not_vouch_for_is_not_valid() -> None:
    (mark,) = _marks(tim_tm2(WEEK, 1000, 7, time_valid=False))
    assert not mark.time_valid


def test_the_week_in_the_message_counts_not_the_current_one() -> None:
    # Navigation has passed the week's end; the mark came just before it.
    navigation = nav_timegps(100, 0, WEEK + 1)
    (mark,) = _marks(navigation, tim_tm2(WEEK, 604_799_900, 0))
    assert mark.gps_ns == (WEEK + 1) * WEEK_NS - 100_000_000
    assert mark.time_valid


def test_a_week_that_has_rolled_over_is_not_valid() -> None:
    navigation = nav_timegps(100_000, 0, WEEK)
    (mark,) = _marks(navigation, tim_tm2(WEEK - 1024, 100_000, 0))
    assert not mark.time_valid


# Leap seconds


def test_the_firmwares_default_is_no_leap_second() -> None:
    decoder = UbxDecoder("gnss")
    decoder.feed(nav_timels(0, source=0, leap=18) + nav_timegps(0, 0, WEEK, leap=18), 0)
    assert decoder.leap_seconds is None
    decoder.feed(nav_timels(0, source=2, leap=18), 0)
    assert decoder.leap_seconds == 18


# The arithmetic of time


@given(
    week=st.integers(2000, 4000),
    itow_ms=st.integers(0, 604_799_999),
    fraction_ns=st.integers(-499_999, 499_999),
    leap=st.integers(0, 30),
)
def test_gps_time_is_found_from_utc_and_time_of_week_whatever_the_leap_seconds(
    week: int, itow_ms: int, fraction_ns: int, leap: int
) -> None:
    gps_ns = week * WEEK_NS + itow_ms * 1_000_000 + fraction_ns
    assert gps_from_utc(gps_ns - leap * 10**9, itow_ms) == (gps_ns, leap)


@given(near=st.integers(0, 3000 * WEEK_NS), away=st.integers(-300_000_000, 300_000_000))
def test_the_nearest_instant_of_a_time_of_week_is_found(near: int, away: int) -> None:
    target = near // 1_000_000 * 1_000_000 + away * 1_000_000
    assert gps_near(target // 1_000_000 % 604_800_000, near) == target


def test_utc_of_the_epoch_itself_is_zero() -> None:
    assert utc_ns(UtcFields(1980, 1, 6, 0, 0, 0, 0)) == 0
    assert utc_ns(UtcFields(1980, 1, 6, 24, 0, 0, 0)) is None


# Recorded bytes that come with the tests


def test_the_recorded_m8l_gives_position_attitude_and_time_to_the_nanosecond() -> None:
    recorded = (Path(__file__).parent / "data" / "ublox-neo-m8l-excerpt.ubx").read_bytes()
    samples = [s for s in UbxDecoder("m8l").feed(recorded, 0) if isinstance(s, NavSample)]
    assert [s.gps_ns for s in samples[:2]] == [
        2299 * WEEK_NS + 228_730_000 * 10**6 - 422_154,
        2299 * WEEK_NS + 228_731_000 * 10**6 - 422_231,
    ]
    assert (samples[0].latitude_deg, samples[0].longitude_deg) == (48.7409646, 9.3117369)
    assert samples[0].roll_rad is None, "the recording begins after the attitude of this epoch"
    assert samples[1].heading_rad is not None
    assert {s.leap_seconds for s in samples} == {18}


def test_the_recorded_m8t_knows_18_leap_seconds() -> None:
    recorded = (Path(__file__).parent / "data" / "u-blox-m8t-time-excerpt.ubx").read_bytes()
    decoder = UbxDecoder("m8t")
    assert decoder.feed(recorded, 0) == []
    assert decoder.leap_seconds == 18


def test_a_mark_in_utc_without_leap_seconds_keeps_its_time_and_is_counted() -> None:
    decoder = UbxDecoder("gnss")
    (mark,) = decoder.feed(tim_tm2(WEEK, 1000, 7, base=UTC), 77)
    assert mark.gps_ns == WEEK * WEEK_NS + 1_000_000_007
    decoder.feed(tim_tm2(WEEK, 2000, 7) + tim_tm2(WEEK, 3000, 7, rising=False, falling=True), 77)
    assert (decoder.counters["marks"], decoder.counters["marks_other_edge"]) == (2, 1)
    assert decoder.other_edges == 1
    decoder.feed(tim_tm2(WEEK, 4000, 7), 77)
    assert decoder.other_edges == 0
