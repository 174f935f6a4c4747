"""A local Cartesian frame (east, north, up) about a place on the ellipsoid, and the way back.

In it rays are straight and lengths are true: neither earth curvature nor the scale of a map
projection has to be corrected. Extent of a block: tens of kilometres.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from daemon.orientation.geodesy import ECEF_FROM_GEODETIC
from processing.geometry.rotation import rotation_from_angles

Array = NDArray[np.float64]

FRAME_FILE = "frame.json"
"""Next to a project in such a frame: its `latitude_deg` and `longitude_deg`."""


class LocalFrame:
    """East, north, up at a place of WGS 84 on the ellipsoid, metres."""

    def __init__(self, latitude_deg: float, longitude_deg: float) -> None:
        self.latitude_deg, self.longitude_deg = latitude_deg, longitude_deg
        self._axes = enu_axes(latitude_deg, longitude_deg)
        self._origin = np.array(ECEF_FROM_GEODETIC.transform(longitude_deg, latitude_deg, 0.0))

    @property
    def name(self) -> str:
        return (
            f"local Cartesian frame, x east, y north, z up at {self.latitude_deg:.7f} N "
            f"{self.longitude_deg:.7f} E on the ellipsoid of WGS 84"
        )

    def from_geodetic(self, latitude_deg: Array, longitude_deg: Array, height_m: Array) -> Array:
        """Local coordinates (n, 3) of places, heights above the ellipsoid."""
        x, y, z = ECEF_FROM_GEODETIC.transform(longitude_deg, latitude_deg, height_m)
        return np.asarray((np.stack([x, y, z], axis=-1) - self._origin) @ self._axes)

    def to_geodetic(self, local_m: Array) -> Array:
        """Latitude deg, longitude deg, ellipsoidal height m, (n, 3), of local coordinates."""
        x, y, z = (local_m @ self._axes.T + self._origin).T
        longitude, latitude, height = ECEF_FROM_GEODETIC.transform(x, y, z, direction="INVERSE")
        return np.stack([latitude, longitude, height], axis=-1)

    def local_from_enu(self, latitude_deg: float, longitude_deg: float) -> Array:
        """Rotation (3, 3) from east, north, up at another place into the frame."""
        return np.asarray(self._axes.T @ enu_axes(latitude_deg, longitude_deg))


def enu_axes(latitude_deg: float, longitude_deg: float) -> Array:
    """East, north and up as columns (3, 3), earth-centred axes."""
    longitude, latitude = math.radians(longitude_deg), math.radians(latitude_deg)
    return rotation_from_angles("ZX", [math.pi / 2 + longitude, math.pi / 2 - latitude])
