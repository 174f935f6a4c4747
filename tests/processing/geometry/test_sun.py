"""The sun's elevation agrees with published computations and observations."""

from __future__ import annotations

import math
from datetime import UTC, datetime

import pytest

from processing.geometry.sun import sun_elevation_rad


@pytest.mark.parametrize(
    ("utc", "latitude_deg", "longitude_deg", "elevation_deg"),
    [
        # NREL/TP-560-34302, table A5.1: zenith 50.11162 deg with 0.01603 deg of refraction.
        (datetime(2003, 10, 17, 19, 30, 30, tzinfo=UTC), 39.742476, -105.1786, 39.8723),
        # At the June solstice the sun culminates at 90 deg less latitude plus 23.436 deg.
        (datetime(2025, 6, 21, 12, 2, 0, tzinfo=UTC), 51.4779, 0.0, 90 - 51.4779 + 23.436),
        # At the north pole in midwinter: below the horizon by the obliquity.
        (datetime(2025, 12, 21, 15, 3, 0, tzinfo=UTC), 90.0, 0.0, -23.437),
    ],
)
def test_the_elevation_is_good_to_three_hundredths_of_a_degree(
    utc: datetime, latitude_deg: float, longitude_deg: float, elevation_deg: float
) -> None:
    found = sun_elevation_rad(
        utc.timestamp(), math.radians(latitude_deg), math.radians(longitude_deg)
    )
    assert math.degrees(found) == pytest.approx(elevation_deg, abs=0.03)
