"""Earth curvature and refraction: deviations of a ray in map coordinates from a straight line.

For blocks given in map coordinates and heights. In a local Cartesian system there is no curvature,
and refraction alone may be switched on.

Source: Manual of Photogrammetry (ASPRS), atmospheric refraction after the ARDC 1959 atmosphere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MEAN_EARTH_RADIUS_M = 6_371_000.0


@dataclass(frozen=True)
class RayModel:
    """Model of rays. `earth_radius_m`: coordinates are map coordinates and heights above a sphere
    of that radius; None: they are Cartesian. `refraction`: through the standard atmosphere, from
    `ground_m` above the sea."""

    earth_radius_m: float | None = None
    refraction: bool = False
    ground_m: float = 0.0

    @property
    def is_straight(self) -> bool:
        """Whether rays are straight in the object coordinates."""
        return self.earth_radius_m is None and not self.refraction


def refraction_coefficient(height_m: Array, ground_m: float) -> Array:
    """K of d(angle) = K tan(angle off the vertical).

    Args:
        height_m: cameras above the sea, shape (n,), m, not zero.
        ground_m: the ground above the sea.

    Returns:
        Shape (n,), rad.

    Source: Manual of Photogrammetry (ASPRS), atmospheric refraction after the ARDC 1959 atmosphere.

    Example:
        From 3000 m over the sea: 2410e-6 * 3 / (9 - 18 + 250), 30 urad at 45 degrees.

        >>> refraction_coefficient(np.array([3000.0]), 0.0).round(8)
        array([3.e-05])
    """
    camera, ground = height_m * 1e-3, ground_m * 1e-3
    return np.asarray(
        2410e-6
        * (
            camera / (camera**2 - 6.0 * camera + 250.0)
            - ground / (ground**2 - 6.0 * ground + 250.0) * ground / camera
        )
    )


def corrected_rays(
    ray_m: Array, station_height_m: Array, rays: RayModel
) -> tuple[Array, Array, Array]:
    """The straight ray along which the camera sees the point, and its derivatives.

    Curvature scales the map distance d of a point at height Z by 1 + Z / R and lowers the point by
    d^2 / 2R. Refraction moves its image outwards by K tan(angle).

    Args:
        ray_m: point less projection centre, (n, 3), east, north, up.
        station_height_m: (n,) of the projection centre.
        rays: model of curvature and refraction.

    Returns:
        (n, 3); by the point and by the projection centre (n, 3, 3) each. That the height of the
        projection centre changes K is left out: a millionth.

    Example:
        On a sphere of 6371 km a point 2 km away lies 2000^2 / 2R = 0.314 m below the plane.

        >>> ray_m = np.array([[2000.0, 0.0, -1000.0]])
        >>> seen, _, _ = corrected_rays(ray_m, np.array([1000.0]), RayModel(MEAN_EARTH_RADIUS_M))
        >>> seen.round(3)
        array([[ 2000.   ,     0.   , -1000.314]])
    """
    n = len(ray_m)
    seen, d_point = ray_m.copy(), np.broadcast_to(np.eye(3), (n, 3, 3)).copy()
    d_station = -d_point
    if rays.earth_radius_m is not None:
        r = rays.earth_radius_m
        wider = 1.0 + (station_height_m + ray_m[:, 2]) / r
        seen[:, :2] *= wider[:, None]
        seen[:, 2] -= np.sum(ray_m[:, :2] ** 2, axis=1) / (2.0 * r)
        d_point[:, [0, 1], [0, 1]] = wider[:, None]
        d_point[:, 2, :2] = -ray_m[:, :2] / r
        d_station = -d_point
        d_point[:, :2, 2] = ray_m[:, :2] / r
    if rays.refraction:
        k = refraction_coefficient(station_height_m, rays.ground_m)
        flat, down = np.sum(seen[:, :2] ** 2, axis=1), seen[:, 2]
        outward = 1.0 + k * (1.0 + flat / down**2)
        farther = np.zeros((n, 3, 3))
        farther[:, 2, 2] = 1.0
        for i in range(2):
            farther[:, i, 2] = -2.0 * k * flat * seen[:, i] / down**3
            for j in range(2):
                farther[:, i, j] = 2.0 * k * seen[:, i] * seen[:, j] / down**2
            farther[:, i, i] += outward
        seen[:, :2] *= outward[:, None]
        d_point, d_station = farther @ d_point, farther @ d_station
    return seen, d_point, d_station
