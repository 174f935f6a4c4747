"""OpenCV's rational distortion (eight coefficients), and its conversion to a model of ours.

The rational model is not adjusted: over a frame its six radial coefficients are hardly separable.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.camera_conversion import ConvertedCamera, fitted_camera, frame_grid
from processing.bundle.network import CameraModel, NetworkError

Array = NDArray[np.float64]

_ITERATIONS: Final = 50
_CONVERGED: Final = 1e-14
_FLIP: Final = np.array([1.0, -1.0])


def rational_distorted(coefficients: Array, ideal: Array) -> tuple[Array, Array]:
    """Distort normalised coordinates.

    Args:
        coefficients: k1, k2, p1, p2, k3, k4, k5, k6 as OpenCV orders them, shape (8,).
        ideal: over the principal distance, y down, shape (n, 2).

    Returns:
        Distorted coordinates, shape (n, 2), and their derivatives by the ideal ones, shape
        (n, 2, 2).

    Source: OpenCV, calib3d, projectPoints; docs/explanation/mathematics/bundle.md#forward-models.

    Example:
        At r = 1 with k1 = 0.2 and k4 = 0.5: (1 + 0.2) / (1 + 0.5) = 0.8.

        >>> k = np.array([0.2, 0, 0, 0, 0, 0.5, 0, 0])
        >>> rational_distorted(k, np.array([[1.0, 0.0]]))[0].round(9)
        array([[0.8, 0. ]])
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    u, v = ideal.T
    r2 = u * u + v * v
    above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = above / below
    slope_above = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)
    slope_below = k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6)
    slope = 2.0 * (slope_above - radial * slope_below) / below
    distorted = np.stack(
        [
            u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u),
            v * radial + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v,
        ],
        axis=1,
    )
    by_ideal = np.empty((len(u), 2, 2))
    by_ideal[:, 0, 0] = radial + u * u * slope + 2.0 * p1 * v + 6.0 * p2 * u
    by_ideal[:, 1, 1] = radial + v * v * slope + 6.0 * p1 * v + 2.0 * p2 * u
    by_ideal[:, 0, 1] = by_ideal[:, 1, 0] = u * v * slope + 2.0 * p1 * u + 2.0 * p2 * v
    return distorted, by_ideal


def rational_undistorted(coefficients: Array, distorted: Array) -> Array:
    """Ideal coordinates of distorted ones.

    Args:
        coefficients: shape (8,), as of `rational_distorted`.
        distorted: over the principal distance, y down, shape (n, 2).

    Returns:
        Shape (n, 2).

    Raises:
        NetworkError: coordinates where the distortion cannot be inverted.
    """
    x = distorted.copy()
    for _ in range(_ITERATIONS):
        found, by_ideal = rational_distorted(coefficients, x)
        good = np.linalg.det(by_ideal) > 1e-6
        step = np.zeros_like(x)
        off = (distorted - found)[good]
        step[good] = np.linalg.solve(by_ideal[good], off[:, :, None])[:, :, 0]
        x = x + step
        if np.abs(step).max(initial=0.0) < _CONVERGED:
            break
    found, by_ideal = rational_distorted(coefficients, x)
    lost = ~(np.abs(distorted - found).max(axis=1) < 1e-9) | ~(np.linalg.det(by_ideal) > 0.0)
    if lost.any():
        raise NetworkError(
            [
                f"the rational distortion cannot be inverted at {int(lost.sum())} of {len(x)} "
                "places of the frame; check its coefficients and the frame's size"
            ]
        )
    return x


def camera_of_rational(
    camera: CameraModel, coefficients: Array, half_size_mm: tuple[float, float]
) -> ConvertedCamera:
    """A camera of the model of `camera` that has OpenCV's rational distortion as well as it can.

    Args:
        camera: name, f, principal point and model of the result.
        coefficients: k1, k2, p1, p2, k3, k4, k5, k6, shape (8,).
        half_size_mm: half width and half height of the frame.

    Returns:
        The camera with the residuals of a grid over the frame.

    Raises:
        NetworkError: a distortion that cannot be inverted over the frame.

    Source: docs/explanation/mathematics/bundle.md#forward-models.
    """
    measured = frame_grid(camera, half_size_mm)
    about = (measured - np.array([camera.xp_mm, camera.yp_mm])) * _FLIP / camera.f_mm
    wanted = rational_undistorted(coefficients, about) * _FLIP
    return fitted_camera(camera, measured, wanted)
