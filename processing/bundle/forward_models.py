"""Camera models that distort ideal coordinates: Brown as OpenCV has it, and its fisheye model.

Ideal coordinates of measured ones follow by inversion. Image coordinates are mm with y up; the
models themselves have y down, as in OpenCV.

Source: docs/explanation/mathematics/bundle.md#forward-models; OpenCV, calib3d and fisheye.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.network import CameraModel, NetworkError

Array = NDArray[np.float64]

FORWARD: Final = ("opencv", "fisheye")
_FLIP: Final = np.diag([1.0, -1.0])
_ITERATIONS: Final = 50
_CONVERGED: Final = 1e-14


def forward_ideal_mm(camera: CameraModel, interior: Array, xy_mm: Array) -> Array:
    """Ideal image coordinates of measured ones.

    Args:
        camera: of a forward model.
        interior: dx0, dy0, df mm; k1, k2, k3, p1, p2 of the model; b1, b2; shape (10,).
        xy_mm: measured, shape (n, 2), mm, y up.

    Returns:
        Shape (n, 2), mm, about the principal point.

    Raises:
        NetworkError: a point where the distortion cannot be inverted.

    Source: docs/explanation/mathematics/bundle.md#forward-models.

    Example:
        K1 = 0.1 at r = 0.2: 0.2 (1 + 0.1 0.2^2) = 0.2008 is measured, times 100 mm.

        >>> interior = np.zeros(10)
        >>> interior[3] = 0.1
        >>> camera = CameraModel("C", f_mm=100.0, model="opencv")
        >>> forward_ideal_mm(camera, interior, np.array([[20.08, 0.0]])).round(9) + 0.0
        array([[20.,  0.]])
    """
    c = camera.f_mm - float(interior[2])
    found = _undistorted(camera, interior, _normalised(camera, interior, xy_mm)[0])
    return np.asarray(found * [c, -c])


def forward_measured_mm(camera: CameraModel, interior: Array, directions: Array) -> Array:
    """Measured image coordinates of directions.

    Args:
        camera: of a forward model.
        interior: shape (10,).
        directions: ideal coordinates over the principal distance, shape (n, 2), y up.

    Returns:
        Shape (n, 2), mm.

    Source: docs/explanation/mathematics/bundle.md#forward-models.
    """
    c = camera.f_mm - float(interior[2])
    found = c * _distorted(camera, interior, directions @ _FLIP) @ _FLIP
    x = (found[:, 0] - found[:, 1] * interior[9]) / (1.0 + interior[8])
    about = np.stack([x, found[:, 1]], axis=1)
    return np.asarray(about + np.array([camera.xp_mm, camera.yp_mm]) - interior[:2])


def forward_derivatives(camera: CameraModel, interior: Array, xy_mm: Array) -> tuple[Array, Array]:
    """Derivatives of ideal coordinates.

    Args:
        camera: of a forward model.
        interior: shape (10,).
        xy_mm: measured, shape (n, 2), mm.

    Returns:
        By the ten, shape (n, 2, 10), and by the measured coordinates, shape (n, 2, 2).
    """
    c = camera.f_mm - float(interior[2])
    m, about = _normalised(camera, interior, xy_mm)
    x = _undistorted(camera, interior, m)
    by_place, by_parameter = _distortion_derivatives(camera, interior, x)
    inverse = np.linalg.inv(by_place)
    affine = np.array([[1.0 + interior[8], interior[9]], [0.0, 1.0]])
    to_ideal = c * _FLIP @ inverse
    by_measured = to_ideal @ (_FLIP @ affine / c)
    result = np.zeros((len(x), 2, 10))
    result[:, :, 0:2] = by_measured
    result[:, :, 2] = -(x @ _FLIP) + np.einsum("nij,nj->ni", to_ideal, m) / c
    result[:, :, 3:8] = -to_ideal @ by_parameter
    result[:, :, 8] = to_ideal[:, :, 0] * about[:, 0, None] / c
    result[:, :, 9] = to_ideal[:, :, 0] * about[:, 1, None] / c
    return result, by_measured


def _normalised(camera: CameraModel, interior: Array, xy_mm: Array) -> tuple[Array, Array]:
    """Measured coordinates over the principal distance, y down; and about the principal point."""
    c = camera.f_mm - float(interior[2])
    about = xy_mm - np.array([camera.xp_mm, camera.yp_mm]) + interior[:2]
    x = about[:, 0] * (1.0 + interior[8]) + about[:, 1] * interior[9]
    return np.stack([x, -about[:, 1]], axis=1) / c, about


def _undistorted(camera: CameraModel, interior: Array, m: Array) -> Array:
    x = m.copy() if camera.model == "opencv" else _fisheye_start(interior, m)
    for _ in range(_ITERATIONS):
        off = m - _distorted(camera, interior, x)
        by_place, _ = _distortion_derivatives(camera, interior, x)
        with np.errstate(all="ignore"):
            determinant = np.linalg.det(by_place)
            good = determinant > 1e-6
            step = np.zeros_like(x)
            step[good] = np.linalg.solve(by_place[good], off[good][:, :, None])[:, :, 0]
        x = x + step
        if np.abs(step).max(initial=0.0) < _CONVERGED:
            break
    off = np.abs(m - _distorted(camera, interior, x)).max(axis=1)
    lost = ~(off < 1e-9) | ~(np.linalg.det(_distortion_derivatives(camera, interior, x)[0]) > 0.0)
    if lost.any():
        raise NetworkError(
            [
                f"camera {camera.name}: {int(lost.sum())} image points lie where its distortion "
                "cannot be inverted; check its parameters"
            ]
        )
    return x


def _fisheye_start(interior: Array, m: Array) -> Array:
    """By the angle alone: solves the polynomial in the angle."""
    measured = np.linalg.norm(m, axis=1)
    theta = np.minimum(measured, 1.5)
    for _ in range(_ITERATIONS):
        value, slope = _angle_polynomial(interior, theta)
        theta = np.clip(theta - (value - measured) / np.maximum(slope, 0.1), 0.0, 1.56)
    scale = np.tan(theta) / np.where(measured > 0.0, measured, 1.0)
    return np.asarray(m * np.where(measured > 1e-12, scale, 1.0)[:, None])


def _angle_polynomial(interior: Array, theta: Array) -> tuple[Array, Array]:
    """theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + p1 theta^8) and its slope."""
    t = theta * theta
    k = (*interior[3:6], interior[6])
    value = theta * (1.0 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3]))))
    slope = 1.0 + t * (3.0 * k[0] + t * (5.0 * k[1] + t * (7.0 * k[2] + t * 9.0 * k[3])))
    return value, slope


def _distorted(camera: CameraModel, interior: Array, x: Array) -> Array:
    u, v = x.T
    r2 = u * u + v * v
    if camera.model == "fisheye":
        r = np.sqrt(r2)
        value, _ = _angle_polynomial(interior, np.arctan(r))
        ratio = np.where(r > 1e-9, value / np.where(r > 1e-9, r, 1.0), 1.0)
        return np.asarray(x * ratio[:, None])
    k1, k2, k3, p1, p2 = interior[3:8]
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u),
            v * radial + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v,
        ],
        axis=1,
    )


def _distortion_derivatives(camera: CameraModel, interior: Array, x: Array) -> tuple[Array, Array]:
    """Of distorted coordinates by ideal ones, (n, 2, 2), and by k1, k2, k3, p1, p2, (n, 2, 5)."""
    u, v = x.T
    r2 = u * u + v * v
    by_place, by_parameter = np.zeros((len(x), 2, 2)), np.zeros((len(x), 2, 5))
    if camera.model == "fisheye":
        r = np.sqrt(r2)
        theta = np.arctan(r)
        value, slope = _angle_polynomial(interior, theta)
        small = r < 1e-9
        safe = np.where(small, 1.0, r)
        ratio = np.where(small, 1.0, value / safe)
        change = np.where(small, 0.0, (slope / (1.0 + r2) - ratio) / safe**2)
        by_place[:] = ratio[:, None, None] * np.eye(2)
        by_place += change[:, None, None] * x[:, :, None] * x[:, None, :]
        for k, power in enumerate((3, 5, 7, 9)):
            by_parameter[:, :, k] = x * np.where(small, 0.0, theta**power / safe)[:, None]
        return by_place, by_parameter
    k1, k2, k3, p1, p2 = interior[3:8]
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
    by_place[:, 0, 0] = radial + u * u * slope + 2.0 * p1 * v + 6.0 * p2 * u
    by_place[:, 1, 1] = radial + v * v * slope + 6.0 * p1 * v + 2.0 * p2 * u
    by_place[:, 0, 1] = by_place[:, 1, 0] = u * v * slope + 2.0 * p1 * u + 2.0 * p2 * v
    for k in range(3):
        by_parameter[:, :, k] = x * (r2 ** (k + 1))[:, None]
    by_parameter[:, 0, 3], by_parameter[:, 1, 3] = 2.0 * u * v, r2 + 2.0 * v * v
    by_parameter[:, 0, 4], by_parameter[:, 1, 4] = r2 + 2.0 * u * u, 2.0 * u * v
    return by_place, by_parameter
