"""Weeks, dates and leap seconds in whole nanoseconds, at the boundary of each field and limit."""

from __future__ import annotations

import pytest

from drivers.timescales.gps_time import (
    DAY_NS,
    SECOND_NS,
    WEEK_NS,
    UtcFields,
    gps_from_utc,
    gps_near,
    utc_ns,
)

EPOCH = (1980, 1, 6, 0, 0, 0, 0)


def test_units_of_time_are_what_they_are_called() -> None:
    assert (SECOND_NS, DAY_NS, WEEK_NS) == (10**9, 86_400 * 10**9, 604_800 * 10**9)


@pytest.mark.parametrize(
    ("fields", "expected_ns"),
    [
        (EPOCH, 0),
        ((1980, 1, 7, 0, 0, 0, 0), DAY_NS),
        ((1981, 1, 6, 0, 0, 0, 0), 366 * DAY_NS),
        ((1980, 2, 6, 0, 0, 0, 0), 31 * DAY_NS),
        ((1980, 1, 6, 1, 0, 0, 0), 3600 * SECOND_NS),
        ((1980, 1, 6, 23, 0, 0, 0), 82_800 * SECOND_NS),
        ((1980, 1, 6, 24, 0, 0, 0), None),
        ((1980, 1, 6, 0, 1, 0, 0), 60 * SECOND_NS),
        ((1980, 1, 6, 0, 59, 0, 0), 3540 * SECOND_NS),
        ((1980, 1, 6, 0, 60, 0, 0), None),
        ((1980, 1, 6, 0, 0, 60, 0), 60 * SECOND_NS),
        ((1980, 1, 6, 0, 0, 61, 0), None),
        ((1980, 1, 6, 0, 0, 2, -7), 2 * SECOND_NS - 7),
        ((1980, 1, 6, 0, 0, 2, 7), 2 * SECOND_NS + 7),
        ((1980, 1, 6, 0, 0, 0, SECOND_NS), SECOND_NS),
        ((1980, 1, 6, 0, 0, 0, SECOND_NS + 1), None),
        ((1980, 1, 6, 0, 0, 2, -SECOND_NS), SECOND_NS),
        ((1980, 1, 6, 0, 0, 2, -SECOND_NS - 1), None),
        ((2023, 2, 29, 0, 0, 0, 0), None),
        ((0, 0, 0, 0, 0, 0, 0), None),
    ],
)
def test_a_date_becomes_nanoseconds_since_the_gps_epoch(
    fields: tuple[int, int, int, int, int, int, int], expected_ns: int | None
) -> None:
    assert utc_ns(UtcFields(*fields)) == expected_ns


@pytest.mark.parametrize(("leap", "is_one"), [(-1, False), (0, True), (99, True), (100, False)])
@pytest.mark.parametrize("tow_ms", [0, 5_000, 302_400_000, 604_799_000])
def test_leap_seconds_are_0_to_99(leap: int, is_one: bool, tow_ms: int) -> None:
    utc = 2300 * WEEK_NS + (tow_ms - leap * 1000) * 1_000_000
    expected = (utc + leap * SECOND_NS, leap) if is_one else None
    assert gps_from_utc(utc, tow_ms) == expected


@pytest.mark.parametrize(
    ("off_ns", "fits"),
    [(1_000_000, True), (1_000_001, False), (-1_000_000, True), (-1_000_001, False)],
)
def test_a_time_of_week_may_be_rounded_by_a_millisecond(off_ns: int, fits: bool) -> None:
    utc = 2300 * WEEK_NS + 7 * SECOND_NS + off_ns
    assert gps_from_utc(utc, 25_000) == ((utc + 18 * SECOND_NS, 18) if fits else None)


@pytest.mark.parametrize(
    ("tow_ms", "near_ns", "expected_ns"),
    [
        (604_799_900, 2400 * WEEK_NS + 50_000_000, 2400 * WEEK_NS - 100_000_000),
        (100, 2400 * WEEK_NS - 50_000_000, 2400 * WEEK_NS + 100_000_000),
        (1000, 2400 * WEEK_NS + 7, 2400 * WEEK_NS + SECOND_NS),
        (302_400_000, 2400 * WEEK_NS + 1, 2400 * WEEK_NS + WEEK_NS // 2),
        (302_400_000, 2400 * WEEK_NS - 1, 2399 * WEEK_NS + WEEK_NS // 2),
        (302_400_000, 2400 * WEEK_NS, 2399 * WEEK_NS + WEEK_NS // 2),
    ],
)
def test_the_nearest_instant_of_a_time_of_week(tow_ms: int, near_ns: int, expected_ns: int) -> None:
    assert gps_near(tow_ms, near_ns) == expected_ns
