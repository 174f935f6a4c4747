"""Interior orientation: measured image coordinates to ideal ones, and derivatives.

Heier et al. (2002), eq. 5.1, in two interpretations (`CameraModel.model`), plus the additional
terms (docs/explanation/mathematics/bundle.md#camera-model).
The correction is added to what was measured: ideal = measured + delta(measured).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from processing.bundle.forward_models import FORWARD, forward_derivatives, forward_ideal_mm
from processing.bundle.network import CameraModel
from processing.bundle.terms import term_design

Array = NDArray[np.float64]


def principal_distance_mm(camera: CameraModel, interior: Array) -> float:
    """Principal distance of the collinearity equations.

    Australis keeps f and carries df in the correction (+x df / f); the centred model projects with
    f - df, which is the same to first order.

    Args:
        camera: model and principal distance.
        interior: the ten, shape (10,).

    Returns:
        Principal distance, mm.

    Source: docs/explanation/mathematics/bundle.md#camera-model.
    """
    return camera.f_mm if camera.model == "australis" else camera.f_mm - float(interior[2])


def perspective_mm(camera: CameraModel, interior: Array) -> tuple[float, float, float]:
    """Principal distance and principal point of the images without their distortion.

    Australis corrects (x - xp) by (x - xp) df / f + dx0 and projects with f: together images
    of f / (1 + df / f), which f - df is to first order only.

    Args:
        camera: model, principal point and principal distance.
        interior: the ten, shape (10,).

    Returns:
        Principal distance, and x and y of the principal point in measured coordinates, mm.

    Source: docs/explanation/mathematics/bundle.md#camera-model.

    Example:
        >>> interior = np.zeros(10)
        >>> interior[:3] = 0.12, 0.0, 0.24
        >>> np.round(perspective_mm(CameraModel("C", f_mm=1.2), interior), 9).tolist()
        [1.0, -0.1, 0.0]
    """
    dx0, dy0, df = (float(value) for value in interior[:3])
    if camera.model != "australis":
        return camera.f_mm - df, camera.xp_mm - dx0, camera.yp_mm - dy0
    scale = 1.0 + df / camera.f_mm
    return camera.f_mm / scale, camera.xp_mm - dx0 / scale, camera.yp_mm - dy0 / scale


def ideal_mm(camera: CameraModel, interior: Array, terms: Array, xy_mm: Array) -> Array:
    """Ideal image coordinates of measured ones, about the principal point.

    Args:
        camera: model, principal point and principal distance.
        interior: the ten, shape (10,).
        terms: values of the additional parameters, shape (t,).
        xy_mm: measured, shape (n, 2), mm, y up.

    Returns:
        Shape (n, 2), mm.

    Source: Heier et al. (2002), eq. 5.1; docs/explanation/mathematics/bundle.md#camera-model.

    Example:
        K1 alone: K1 r^3 = 8 um outward at r = 20 mm, as in `processing.geometry.lens`.

        >>> interior = np.zeros(10)
        >>> interior[3] = 1e-6
        >>> ideal_mm(CameraModel("C", f_mm=100.0), interior, np.zeros(0), np.array([[20.0, 0.0]]))
        array([[20.008,  0.   ]])
    """
    if camera.model in FORWARD:
        return forward_ideal_mm(camera, interior, xy_mm)
    xy_mm = _placed(camera, terms, xy_mm)
    if camera.model == "australis":
        about = _about_given(camera, xy_mm)
        if not interior.any():
            return about
        return np.asarray(about + _ten(camera, about[:, 0], about[:, 1]) @ interior)
    x, y, _ = _centred(camera, interior, xy_mm)
    delta = np.einsum("nik,k->ni", _ten(camera, x, y)[:, :, 3:8], interior[3:8])
    return np.asarray(np.stack([x, y], axis=1) + delta)


def interior_derivatives(camera: CameraModel, interior: Array, terms: Array, xy_mm: Array) -> Array:
    """d(ideal) / d(the ten).

    Args:
        camera: model, principal point and principal distance.
        interior: the ten, shape (10,).
        terms: values of the additional parameters, shape (t,).
        xy_mm: measured, shape (n, 2), mm.

    Returns:
        Shape (n, 2, 10); df of the centred model acts in the projection: zero.
    """
    if camera.model in FORWARD:
        return forward_derivatives(camera, interior, xy_mm)[0]
    xy_mm = _placed(camera, terms, xy_mm)
    if camera.model == "australis":
        return _ten(camera, xy_mm[:, 0] - camera.xp_mm, xy_mm[:, 1] - camera.yp_mm)
    x, y, about = _centred(camera, interior, xy_mm)
    result = _ten(camera, x, y)
    by_place = np.eye(2) + _by_place(interior, x, y)
    result[:, :, 0] = by_place[:, :, 0] * (1.0 + interior[8])
    result[:, :, 1] = by_place[:, :, 0] * interior[9] + by_place[:, :, 1]
    result[:, :, 2] = 0.0
    result[:, :, 8] = by_place[:, :, 0] * about[:, 0, None]
    result[:, :, 9] = by_place[:, :, 0] * about[:, 1, None]
    return result


def measured_by_ideal(camera: CameraModel, interior: Array, xy_mm: Array) -> Array | None:
    """d(measured) / d(ideal), which carries residuals of ideal coordinates to measured ones.

    Ideal residuals shrink with a correction that makes the image smaller, such as a longer
    principal distance of `australis`: their sum of squares prefers it, residuals as measured do
    not.

    Args:
        camera: model, principal point and principal distance.
        interior: the ten, shape (10,).
        xy_mm: measured, shape (n, 2), mm.

    Returns:
        Shape (n, 2, 2); None for `centred`, whose published results have residuals of ideal
        coordinates.

    Source: docs/explanation/mathematics/bundle.md#residuals.
    """
    if camera.model == "centred":
        return None
    if camera.model in FORWARD:
        return np.asarray(np.linalg.inv(forward_derivatives(camera, interior, xy_mm)[1]))
    about = _about_given(camera, xy_mm)
    return _inverse(_ideal_by_measured(camera, interior, about[:, 0], about[:, 1]))


def _ideal_by_measured(camera: CameraModel, interior: Array, x: Array, y: Array) -> Array:
    """d(ideal) / d(measured) of `australis`, without the additional terms."""
    affine = np.array([[1.0 + interior[8], interior[9]], [0.0, 1.0]])
    scale = np.eye(2) * interior[2] / camera.f_mm
    return np.asarray(affine + _by_place(interior, x, y) + scale)


def _inverse(matrix: Array) -> Array:
    """Of matrices of two rows, (n, 2, 2)."""
    a, b, c, d = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 0], matrix[:, 1, 1]
    result = np.empty_like(matrix)
    result[:, 0, 0], result[:, 0, 1], result[:, 1, 0], result[:, 1, 1] = d, -b, -c, a
    result /= (a * d - b * c)[:, None, None]
    return result


def term_derivatives(camera: CameraModel, interior: Array, terms: Array, xy_mm: Array) -> Array:
    """d(ideal) / d(additional parameters).

    Args:
        camera: model, principal point and terms.
        interior: the ten, shape (10,).
        terms: values of the additional parameters, shape (t,).
        xy_mm: measured, shape (n, 2), mm.

    Returns:
        Shape (n, 2, t).
    """
    if not camera.terms:
        return np.zeros((len(xy_mm), 2, 0))
    place = _about_given(camera, xy_mm)
    moved = np.stack([term_design(term, place) for term in camera.terms], axis=2)
    xy_mm = _placed(camera, terms, xy_mm)
    if camera.model == "australis":
        x, y = xy_mm[:, 0] - camera.xp_mm, xy_mm[:, 1] - camera.yp_mm
        through = _ideal_by_measured(camera, interior, x, y)
    else:
        affine = np.array([[1.0 + interior[8], interior[9]], [0.0, 1.0]])
        x, y, _ = _centred(camera, interior, xy_mm)
        through = (np.eye(2) + _by_place(interior, x, y)) @ affine
    return np.asarray(through @ moved)


def _placed(camera: CameraModel, terms: Array, xy_mm: Array) -> Array:
    """Measured coordinates corrected by the additional parameters, which apply before the ten:
    the light passes the lens before the CCD."""
    result = xy_mm
    for value, term in zip(terms, camera.terms, strict=True):
        if value != 0.0:
            result = result + value * term_design(term, _about_given(camera, xy_mm))
    return result


def _about_given(camera: CameraModel, xy_mm: Array) -> Array:
    return np.asarray(xy_mm - np.array([camera.xp_mm, camera.yp_mm]))


def _centred(camera: CameraModel, interior: Array, xy_mm: Array) -> tuple[Array, Array, Array]:
    """Coordinates about the estimated principal point, after affinity and shear; and before."""
    about = xy_mm - np.array([camera.xp_mm, camera.yp_mm]) + interior[:2]
    return about[:, 0] * (1.0 + interior[8]) + about[:, 1] * interior[9], about[:, 1], about


def _ten(camera: CameraModel, x: Array, y: Array) -> Array:
    """The ten columns of eq. 5.1 at coordinates about the principal point, (n, 2, 10)."""
    r2 = x * x + y * y
    result = np.zeros((len(x), 2, 10))
    result[:, 0, 0] = 1.0
    result[:, 1, 1] = 1.0
    for axis, own in ((0, x), (1, y)):
        result[:, axis, 2] = own / camera.f_mm
        result[:, axis, 3] = own * r2
        result[:, axis, 4] = own * r2 * r2
        result[:, axis, 5] = own * r2 * r2 * r2
    result[:, 0, 6], result[:, 1, 6] = r2 + 2.0 * x * x, 2.0 * x * y
    result[:, 0, 7], result[:, 1, 7] = 2.0 * x * y, r2 + 2.0 * y * y
    result[:, 0, 8] = x
    result[:, 0, 9] = y
    return result


def _by_place(interior: Array, x: Array, y: Array) -> Array:
    """d(radial and decentring correction) / d(place), (n, 2, 2)."""
    k1, k2, k3, p1, p2 = interior[3:8]
    r2 = x * x + y * y
    radial = r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
    result = np.empty((len(x), 2, 2))
    cross = x * y * slope + 2.0 * y * p1 + 2.0 * x * p2
    result[:, 0, 0] = radial + x * x * slope + 6.0 * x * p1 + 2.0 * y * p2
    result[:, 0, 1] = cross
    result[:, 1, 0] = cross
    result[:, 1, 1] = radial + y * y * slope + 2.0 * x * p1 + 6.0 * y * p2
    return result
