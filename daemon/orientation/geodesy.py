"""PROJ, and the ellipsoid of WGS 84: offsets, distances and earth-centred coordinates.

No other module imports pyproj: its classes and errors have their names here. PROJ is never allowed
to use the network: a missing grid is an error, not a download. Coordinate systems of customers are
in `daemon.orientation.georeference`.

Accuracy: `Geod` and `cart` of PROJ are exact to 1e-8 m. A plane of `east_north_m` keeps distances
and directions from its origin; at 50 km from it other lengths are wrong by less than 2e-5.

Source: Karney (2013); IOGP (2025), guidance note 7-2, 4.1.1.
"""

from __future__ import annotations

import math
from typing import Final

import pyproj

# pyproj states no types for this module.
from pyproj.network import set_network_enabled  # type: ignore[attr-defined]
from pyproj.transformer import TransformerGroup as _TransformerGroup

set_network_enabled(active=False)

CRS = pyproj.CRS
Transformer = pyproj.Transformer
TransformerGroup = _TransformerGroup
CRSError = pyproj.exceptions.CRSError
ProjError = pyproj.exceptions.ProjError

GEODETIC: Final = "EPSG:4979"
"""Latitude, longitude and ellipsoidal height, WGS 84."""
GEOGRAPHIC: Final = "EPSG:4326"
"""Latitude and longitude, WGS 84."""
ELLIPSOID: Final = pyproj.Geod(ellps="WGS84")
ECEF_FROM_GEODETIC: Final = Transformer.from_pipeline(
    "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84"
)
"""From longitude, latitude in degrees and ellipsoidal height to earth-centred metres."""
UTM_LATITUDES_DEG: Final = (-80.0, 84.0)


def metres_per_degree(latitude_deg: float, height_m: float) -> tuple[float, float]:
    """Length of one degree of latitude and of longitude at a place, metres.

    For differentials: velocities, and offsets below a kilometre. PROJ has no function for it.
    """
    e2 = ELLIPSOID.es
    latitude_rad = math.radians(latitude_deg)
    w2 = 1.0 - e2 * math.sin(latitude_rad) ** 2
    meridian_m = ELLIPSOID.a * (1.0 - e2) / w2**1.5 + height_m
    normal_m = ELLIPSOID.a / math.sqrt(w2) + height_m
    return math.radians(meridian_m), math.radians(normal_m * math.cos(latitude_rad))


def east_north_m(origin: tuple[float, float], place: tuple[float, float]) -> tuple[float, float]:
    """Where a place is in the plane about an origin, azimuthal equidistant.

    Args:
        origin: latitude and longitude, deg.
        place: latitude and longitude, deg.

    Returns:
        East and north, m, on the ellipsoid.
    """
    azimuth_deg, _, distance_m = ELLIPSOID.inv(origin[1], origin[0], place[1], place[0])
    azimuth = math.radians(azimuth_deg)
    return distance_m * math.sin(azimuth), distance_m * math.cos(azimuth)


def place_at(origin: tuple[float, float], east_m: float, north_m: float) -> tuple[float, float]:
    """Latitude and longitude, deg, of a point in the plane: the inverse of `east_north_m`."""
    azimuth_deg = math.degrees(math.atan2(east_m, north_m))
    distance_m = math.hypot(east_m, north_m)
    longitude, latitude, _ = ELLIPSOID.fwd(origin[1], origin[0], azimuth_deg, distance_m)
    return latitude, longitude


def utm_of(latitude_deg: float, longitude_deg: float) -> str | None:
    """The UTM zone of a place on WGS 84, as EPSG code; None beyond 80 S and 84 N."""
    south, north = UTM_LATITUDES_DEG
    if not south <= latitude_deg <= north:
        return None
    zone = min(int((longitude_deg + 180.0) % 360.0 // 6.0) + 1, 60)
    return f"EPSG:{32600 + zone if latitude_deg >= 0 else 32700 + zone}"
