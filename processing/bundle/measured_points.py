"""Ground points from measured image points of adjusted images, with what they are uncertain by.

Each point is intersected by itself; what several share through their images is in their gains.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.initial_values import intersect
from processing.geometry.rotation import skew

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_ITERATIONS: Final = 4


@dataclass(frozen=True)
class MeasuredPoint:
    """A point of least squares.

    Attributes:
        xyz_m: (3,).
        gain: (3, 6 n), derivatives by projection centres (m) and rotation vectors about the
            camera's axes (rad), three and three by image.
        noise: (3, 3), covariance by the image measurements alone, m^2.
        residual_mm: (m, 2), measured minus computed.
    """

    xyz_m: Array
    gain: Array
    noise: Array
    residual_mm: Array

    def covariance(self, orientations: Array) -> Array:
        """Covariance with that of the orientations.

        Args:
            orientations: (6 n, 6 n), m and rad.

        Returns:
            Shape (3, 3), m^2.
        """
        return np.asarray(self.gain @ orientations @ self.gain.T + self.noise)


def measured_point(
    f_mm: float,
    station_m: Array,
    rotation: Array,
    image: Indices,
    xy_mm: Array,
    sigma_mm: Array,
) -> MeasuredPoint | None:
    """Intersect one point.

    Args:
        f_mm: principal distance.
        station_m: (n, 3) projection centres.
        rotation: (n, 3, 3) object from camera.
        image: (m,), image of each measurement.
        xy_mm: (m, 2) image coordinates, y up.
        sigma_mm: (m,) standard deviations.

    Returns:
        The point; None with fewer than two images, parallel rays, or a point behind a camera.

    Source: collinearity equations, docs/explanation/mathematics/orthomosaic.md#ground-pixels.

    Example:
        >>> station = np.array([[0.0, 0.0, 100.0], [60.0, 0.0, 100.0]])
        >>> xy = np.array([[30.0, 0.0], [-30.0, 0.0]])
        >>> found = measured_point(
        ...     100.0, station, np.tile(np.eye(3), (2, 1, 1)), np.array([0, 1]), xy, np.ones(2)
        ... )
        >>> np.round(found.xyz_m, 9).tolist()
        [30.0, 0.0, 0.0]
    """
    if len(np.unique(image)) < 2:
        return None
    ray = np.column_stack([xy_mm, np.full(len(xy_mm), -f_mm)])
    direction = np.einsum("nij,nj->ni", rotation[image], ray)
    xyz = intersect(1, np.zeros(len(image), np.int64), station_m[image], direction)[0][0]
    weight = 1.0 / np.repeat(sigma_mm, 2) ** 2
    for _ in range(_ITERATIONS):
        if not np.isfinite(xyz).all():
            return None
        computed, by_point, by_image = _equations(f_mm, station_m[image], rotation[image], xyz)
        if not np.isfinite(computed).all():
            return None
        misclosure = (xy_mm - computed).ravel()
        normal = by_point.T @ (weight[:, None] * by_point)
        if not np.linalg.cond(normal) < 1e15:
            return None
        inverse = np.asarray(np.linalg.inv(normal))
        onto = inverse @ by_point.T * weight
        xyz = xyz + onto @ misclosure
    gain = np.zeros((3, 6 * len(station_m)))
    for k, one in enumerate(image.tolist()):
        gain[:, 6 * one : 6 * one + 6] -= onto[:, 2 * k : 2 * k + 2] @ by_image[k]
    computed, _, _ = _equations(f_mm, station_m[image], rotation[image], xyz)
    return MeasuredPoint(np.asarray(xyz), gain, np.asarray(inverse), np.asarray(xy_mm - computed))


def projected_mm(f_mm: float, station_m: Array, rotation: Array, xyz_m: Array) -> Array:
    """Image coordinates of a point in images, y up.

    Args:
        f_mm: principal distance.
        station_m: (m, 3).
        rotation: (m, 3, 3) object from camera.
        xyz_m: (3,).

    Returns:
        Shape (m, 2), mm; NaN where the point is behind the camera.

    Source: collinearity equations.
    """
    u = np.einsum("nji,nj->ni", rotation, xyz_m - station_m)
    u[u[:, 2] >= 0.0] = np.nan
    return np.asarray(-f_mm * u[:, :2] / u[:, 2:])


def _equations(
    f_mm: float, station_m: Array, rotation: Array, xyz: Array
) -> tuple[Array, Array, Array]:
    """Computed coordinates (m, 2), derivatives by the point (2 m, 3) and by orientations
    (m, 2, 6)."""
    u = np.einsum("nji,nj->ni", rotation, xyz - station_m)
    scale = -f_mm / u[:, 2]
    d = np.zeros((len(u), 2, 3))
    d[:, 0, 0] = d[:, 1, 1] = scale
    d[:, :, 2] = -scale[:, None] * u[:, :2] / u[:, 2:]
    turned = d @ rotation.transpose(0, 2, 1)
    by_image = np.concatenate([-turned, d @ skew(u)], axis=2)
    computed = scale[:, None] * u[:, :2]
    computed[u[:, 2] >= 0.0] = np.nan
    return computed, turned.reshape(-1, 3), by_image
