"""The clocks of the emulated world."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_hw.world.world_clock import (
    FreeRunningClock,
    WorldClock,
    gps_ns_from_unix_ns,
    gps_week_and_tow_ns,
    unix_ns_from_gps_ns,
)

DAY_NS = 86_400 * 1_000_000_000


def test_a_known_utc_instant_has_its_published_week_and_time_of_week() -> None:
    unix_ns = round(datetime(2026, 11, 1, 10, tzinfo=UTC).timestamp()) * 1_000_000_000
    assert gps_week_and_tow_ns(gps_ns_from_unix_ns(unix_ns)) == (2443, 36_018 * 1_000_000_000)
    assert unix_ns_from_gps_ns(gps_ns_from_unix_ns(unix_ns)) == unix_ns


def test_a_world_starting_now_is_in_this_week() -> None:
    clock = WorldClock.from_wall_clock()
    now = datetime.now(UTC) - datetime(1980, 1, 6, tzinfo=UTC)
    assert clock.gps_ns_at_start / 1e9 == pytest.approx(now.total_seconds() + 18, abs=5.0)


@given(st.integers(0, 10**19), st.integers(0, 10**17), st.integers(0, 10**17))
def test_gps_and_monotonic_time_convert_into_each_other_exactly(
    gps_ns: int, start_ns: int, mono_ns: int
) -> None:
    clock = WorldClock(gps_ns, start_ns)
    assert clock.mono_ns(clock.gps_ns(mono_ns)) == mono_ns


def test_a_device_clock_of_20_ppm_gains_1728_ms_a_day_to_the_nanosecond() -> None:
    clock = FreeRunningClock(offset_ns=7, drift_ppm=20.0)
    assert clock.device_ns(DAY_NS) - clock.device_ns(0) == DAY_NS + 1_728_000_000
    year_ns = 365 * DAY_NS
    assert clock.device_ns(year_ns + 50_000) - clock.device_ns(year_ns) == 50_001
