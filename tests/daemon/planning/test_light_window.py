"""When the sun is high enough, compared with a peer."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from daemon.planning.light_window import light_window

PEER_TOLERANCE_S = 90.0

CROSSINGS = [
    # latitude, longitude, limit in degrees, noon of the day, rising, setting
    (47.07, 15.43, 25.0, datetime(2026, 6, 21, 11, tzinfo=UTC), 1782020916, 1782058296),
    (47.07, 15.43, 15.0, datetime(2026, 11, 21, 11, tzinfo=UTC), 1795248865, 1795266804),
    (69.65, 18.96, 20.0, datetime(2026, 5, 1, 10, 45, tzinfo=UTC), 1777614547, 1777649686),
]
"""Unix seconds from astral 3.2, `time_at_elevation(..., with_refraction=False)`."""


@pytest.mark.parametrize(("latitude", "longitude", "limit", "noon", "rising", "setting"), CROSSINGS)
def test_the_crossings_are_those_of_a_peer(
    latitude: float, longitude: float, limit: float, noon: datetime, rising: int, setting: int
) -> None:
    at_noon = light_window(noon.timestamp(), latitude, longitude, limit)
    assert at_noon.is_light
    assert at_noon.from_unix_s is None
    assert at_noon.until_unix_s == pytest.approx(setting, abs=PEER_TOLERANCE_S)
    before = light_window(rising - 3600, latitude, longitude, limit)
    assert not before.is_light
    assert before.until_unix_s is None
    assert before.from_unix_s == pytest.approx(rising, abs=PEER_TOLERANCE_S)


def test_a_sun_that_does_not_reach_the_limit_within_a_day_has_no_window() -> None:
    midwinter = datetime(2026, 12, 21, 11, tzinfo=UTC).timestamp()
    polar_night = light_window(midwinter, 69.65, 18.96, 10.0)
    assert (polar_night.is_light, polar_night.from_unix_s) == (False, None)
    midsummer = datetime(2026, 6, 21, 11, tzinfo=UTC).timestamp()
    midnight_sun = light_window(midsummer, 80.0, 18.96, 5.0)
    assert (midnight_sun.is_light, midnight_sun.until_unix_s) == (True, None)
