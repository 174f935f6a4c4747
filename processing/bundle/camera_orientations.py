"""Orientations of cameras from an adjustment: exposure and mounting together, with covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.bundle.adjust import Adjustment
from processing.bundle.adjustment_results import AdjustedOrientation
from processing.geometry.rotation import angles_by_rotation_vector, omega_phi_kappa, skew

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_OWN = 12
"""Unknowns of a camera: position and attitude of its exposure, offset and rotation of its head."""


def variance_factor(sigma0: float) -> float:
    """Factor on cofactors: never below one, since measured orientations keep their standard
    deviations where image points fit better than expected.

    Args:
        sigma0: a posteriori standard deviation of unit weight.

    Returns:
        The square of sigma0, at least one.
    """
    return max(1.0, sigma0) ** 2


@dataclass(frozen=True)
class CameraOrientations:
    """Orientations of n cameras.

    Attributes:
        station_m, rotation: (n, 3), (n, 3, 3), mounting applied.
        columns: (n, 12) unknowns they depend on; -1 is held.
        design: (n, 6, 12) derivatives of projection centres (m) and of rotation vectors about the
            camera's axes (rad); zero where held.
        result: the adjustment, with the cofactors of its unknowns.
    """

    station_m: Array
    rotation: Array
    columns: Indices
    design: Array
    result: Adjustment

    def covariances(self) -> Array:
        """Covariance of each camera by itself.

        Returns:
            Shape (n, 6, 6), m and rad.
        """
        own = []
        for columns, block in zip(self.columns, self.design, strict=True):
            at, design = columns[columns >= 0], block[:, columns >= 0]
            own.append(design @ self.result.cofactors[np.ix_(at, at)] @ design.T)
        factor = variance_factor(self.result.sigma0)
        return np.asarray(factor * np.array(own).reshape(-1, 6, 6))

    def covariance(self) -> Array:
        """Full covariance of all cameras.

        Returns:
            Shape (6 n, 6 n), m and rad.
        """
        jacobian = self._jacobian()
        factor = variance_factor(self.result.sigma0)
        return np.asarray(factor * jacobian @ self.result.cofactor @ jacobian.T)

    def _jacobian(self) -> Array:
        n = len(self.station_m)
        jacobian = np.zeros((6 * n, self.result.layout.columns))
        for k in range(n):
            there = self.columns[k] >= 0
            jacobian[6 * k : 6 * k + 6, self.columns[k, there]] = self.design[k][:, there]
        return jacobian


def camera_orientations(result: Adjustment) -> CameraOrientations:
    """Orientation of the camera of every image.

    Args:
        result: the adjustment.

    Returns:
        Orientations in the order of the images; delays and jitter are not applied.

    Source: docs/explanation/mathematics/bundle.md#adjustment.
    """
    images, layout, state = result.network.images, result.layout, result.state
    station = state.station[images.station].copy()
    rotation = state.attitude[images.attitude].copy()
    n = len(images.names)
    columns = np.full((n, _OWN), -1, dtype=np.int64)
    columns[:, :3] = layout.station[images.station]
    columns[:, 3:6] = layout.attitude[images.attitude]
    design = np.zeros((n, 6, _OWN))
    design[:, :3, :3] = design[:, 3:, 3:6] = np.eye(3)
    for k in np.flatnonzero(images.head >= 0):
        head, attitude = images.head[k], state.attitude[images.attitude[k]]
        turn, offset = state.head_rotation[head], state.head_offset[head]
        columns[k, 6:9], columns[k, 9:] = layout.head_offset[head], layout.head_rotation[head]
        design[k, :3, 3:6] = -attitude @ skew(offset[None])[0]
        design[k, 3:, 3:6] = turn.T
        design[k, :3, 6:9] = attitude
        design[k, 3:, 9:] = np.eye(3)
        station[k] += attitude @ offset
        rotation[k] = attitude @ turn
    design *= (columns >= 0)[:, None, :]
    return CameraOrientations(station, rotation, columns, design, result)


def adjusted_cameras(result: Adjustment) -> tuple[AdjustedOrientation, ...]:
    """Projection centre and angles of the camera of every image, with standard deviations.

    Args:
        result: the adjustment.

    Returns:
        One orientation per image, in the order of the network.
    """
    found = camera_orientations(result)
    angles = omega_phi_kappa(found.rotation)
    by_vector = angles_by_rotation_vector("XYZ", found.rotation)
    orientations = []
    for k, (name, own) in enumerate(
        zip(result.network.images.names, found.covariances(), strict=True)
    ):
        of_angles = by_vector[k] @ own[3:, 3:] @ by_vector[k].T
        orientations.append(
            AdjustedOrientation(
                name,
                found.station_m[k],
                np.sqrt(np.diag(own)[:3]),
                angles[k],
                np.sqrt(np.diag(of_angles)),
            )
        )
    return tuple(orientations)
