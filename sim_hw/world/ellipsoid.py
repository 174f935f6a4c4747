"""WGS 84: from the local tangent plane to geographic coordinates, by the textbook's formulas.

The emulator's own, so that the pipeline's coordinates are checked and not repeated.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]

WGS84_A_M = 6378137.0
WGS84_F = 1.0 / 298.257223563


def ecef_from_geodetic(latitude_deg: float, longitude_deg: float, height_m: float) -> Matrix:
    """Earth-centred coordinates of a WGS 84 position, m."""
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    e2 = WGS84_F * (2 - WGS84_F)
    n = WGS84_A_M / math.sqrt(1 - e2 * math.sin(latitude) ** 2)
    return np.array(
        [
            (n + height_m) * math.cos(latitude) * math.cos(longitude),
            (n + height_m) * math.cos(latitude) * math.sin(longitude),
            (n * (1 - e2) + height_m) * math.sin(latitude),
        ]
    )


def geodetic_from_ecef(ecef_m: Matrix) -> tuple[float, float, float]:
    """Latitude, longitude in degrees and height in m, below 1e-6 m near the ground."""
    x, y, z = (float(v) for v in ecef_m)
    e2 = WGS84_F * (2 - WGS84_F)
    p = math.hypot(x, y)
    latitude = math.atan2(z, p * (1 - e2))
    height = 0.0
    for _ in range(6):
        n = WGS84_A_M / math.sqrt(1 - e2 * math.sin(latitude) ** 2)
        height = p * math.cos(latitude) + z * math.sin(latitude) - WGS84_A_M**2 / n
        latitude = math.atan2(z, p * (1 - e2 * n / (n + height)))
    return math.degrees(latitude), math.degrees(math.atan2(y, x)), height


def ecef_from_enu_rotation(latitude_deg: float, longitude_deg: float) -> Matrix:
    """Columns are east, north and up in earth-centred axes."""
    la, lo = math.radians(latitude_deg), math.radians(longitude_deg)
    return np.array(
        [
            [-math.sin(lo), -math.sin(la) * math.cos(lo), math.cos(la) * math.cos(lo)],
            [math.cos(lo), -math.sin(la) * math.sin(lo), math.cos(la) * math.sin(lo)],
            [0.0, math.cos(la), math.sin(la)],
        ]
    )


def geodetic_from_enu(
    enu_m: Matrix, latitude_deg: float, longitude_deg: float, height_m: float
) -> tuple[float, float, float]:
    """WGS 84 position of a point given in the tangent system at an origin."""
    origin = ecef_from_geodetic(latitude_deg, longitude_deg, height_m)
    rotation = ecef_from_enu_rotation(latitude_deg, longitude_deg)
    return geodetic_from_ecef(origin + rotation @ enu_m)
