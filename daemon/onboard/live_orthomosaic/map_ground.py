"""The ground under the live orthomosaic: a height model, or a plane through tie points.

Heights are above the ellipsoid.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from daemon.planning.relief import TerrainRelief

Array = NDArray[np.float64]

POINTS_MIN: Final = 30
"""Fewer tie points give the height of the plan's ground."""
TILT_MAX: Final = 0.2
"""A steeper plane shows points of a narrow strip, not the ground; it is taken as level."""
_ROUNDS: Final = 3


class MapGround(Protocol):
    """Heights of the ground."""

    def heights_m(self, latitude_deg: Array, longitude_deg: Array) -> Array:
        """Heights above the ellipsoid at places, of any shape; for a model a regular grid."""
        ...

    def as_json(self) -> dict[str, Any]:
        """What it is, as JSON types."""
        ...


@dataclass(frozen=True)
class ModelGround:
    """A height model; where it has no data, the level ground of the plan.

    `uncovered` is the share of tie points there; None before any is compared.
    """

    relief: TerrainRelief
    uncovered: float | None = field(default=None, compare=False)

    def heights_m(self, latitude_deg: Array, longitude_deg: Array) -> Array:
        places = np.stack([np.atleast_2d(latitude_deg), np.atleast_2d(longitude_deg)], axis=-1)
        found = self.relief(places) + self.relief.ground_height_m
        return np.asarray(found.reshape(np.shape(latitude_deg)))

    def as_json(self) -> dict[str, Any]:
        share = self.uncovered
        return {"kind": "height model", "uncovered": None if share is None else round(share, 3)}


@dataclass(frozen=True)
class PlaneGround:
    """A plane: height at a place, and what a degree of latitude and longitude adds.

    `relief_rms_m` is the RMS of the tie points about it; None if it is that of the plan.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float
    per_degree: tuple[float, float] = (0.0, 0.0)
    relief_rms_m: float | None = None

    def heights_m(self, latitude_deg: Array, longitude_deg: Array) -> Array:
        north = np.asarray(latitude_deg) - self.latitude_deg
        east = (np.asarray(longitude_deg) - self.longitude_deg + 180.0) % 360.0 - 180.0
        return self.height_m + self.per_degree[0] * north + self.per_degree[1] * east

    def as_json(self) -> dict[str, Any]:
        source = "plan" if self.relief_rms_m is None else "tie points"
        return {
            "kind": "plane",
            "source": source,
            "height_m": round(self.height_m, 2),
            "relief_rms_m": None if self.relief_rms_m is None else round(self.relief_rms_m, 2),
        }


def plane_through(geodetic: Array, metres_per_degree: tuple[float, float]) -> PlaneGround | None:
    """The plane through tie points, robust against the few that are wrong.

    Args:
        geodetic: (n, 3) latitude and longitude, deg, and height, m.
        metres_per_degree: of latitude and of longitude.

    Returns:
        The plane; None with fewer than `POINTS_MIN` points.
    """
    if len(geodetic) < POINTS_MIN:
        return None
    middle = np.median(geodetic, axis=0)
    offsets = (geodetic - middle)[:, :2] * np.array(metres_per_degree)
    height = geodetic[:, 2] - middle[2]
    design = np.column_stack([np.ones(len(offsets)), offsets])
    # Points of one place do not determine a tilt: it is held as by a spread of 100 m.
    hold = np.diag([0.0, 1e2, 1e2]) ** 2
    used = np.ones(len(height), bool)
    plane = np.zeros(3)
    for _ in range(_ROUNDS):
        a, h = design[used], height[used]
        plane = np.linalg.solve(a.T @ a + hold, a.T @ h)
        residuals = height - design @ plane
        limit = 3.0 * 1.4826 * float(np.median(np.abs(residuals))) + 1e-6
        used = np.abs(residuals) <= limit
    if float(np.hypot(*plane[1:])) > TILT_MAX:
        plane = np.array([float(np.median(height)), 0.0, 0.0])
    rms = float(np.sqrt(np.mean((height - design @ plane)[used] ** 2))) if used.any() else 0.0
    per = (float(plane[1] * metres_per_degree[0]), float(plane[2] * metres_per_degree[1]))
    return PlaneGround(float(middle[0]), float(middle[1]), float(middle[2] + plane[0]), per, rms)
