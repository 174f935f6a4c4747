"""Plane projective transformations: a layer's way into the virtual image plane.

Matrices (3, 3) act on homogeneous points (x, y, 1) in mm; lens distortion is not projective and
lives in `processing.geometry.lens`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def apply_projective(target_from_source: Array, xy: Array) -> Array:
    """Carry points by a homography.

    Args:
        target_from_source: shape (3, 3), acts on (x, y, 1).
        xy: source points, shape (n, 2), any consistent unit.

    Returns:
        Target points, shape (n, 2), in the unit of `xy`.

    Source: docs/explanation/mathematics/coordinates.md#similarity-and-projective-transformation.

    Example:
        The denominator is 1 + 0.1 x: at x = 10 everything shrinks by half.

        >>> homography = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.1, 0.0, 1.0]])
        >>> apply_projective(homography, np.array([[10.0, 4.0]]))
        array([[5., 2.]])
    """
    h = target_from_source
    x, y = xy[:, 0], xy[:, 1]
    w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
    result = np.empty((len(xy), 2))
    result[:, 0] = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / w
    result[:, 1] = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / w
    return result


def projective_jacobian(target_from_source: Array, xy: Array) -> Array:
    """d(target) / d(source) of a homography.

    Args:
        target_from_source: shape (3, 3), acts on (x, y, 1).
        xy: source points, shape (n, 2), any consistent unit.

    Returns:
        Shape (n, 2, 2), target coordinate by source coordinate.

    Example:
        >>> homography = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.1, 0.0, 1.0]])
        >>> projective_jacobian(homography, np.array([[10.0, 4.0]])).round(3)
        array([[[ 0.25,  0.  ],
                [-0.1 ,  0.5 ]]])
    """
    h = target_from_source
    x, y = xy[:, 0], xy[:, 1]
    w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
    u = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / w
    v = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / w
    jacobian = np.empty((2, 2, len(xy)))
    jacobian[0, 0] = (h[0, 0] - u * h[2, 0]) / w
    jacobian[0, 1] = (h[0, 1] - u * h[2, 1]) / w
    jacobian[1, 0] = (h[1, 0] - v * h[2, 0]) / w
    jacobian[1, 1] = (h[1, 1] - v * h[2, 1]) / w
    return jacobian.transpose(2, 0, 1)


def chained_jacobian(outer: Array, inner: Array) -> Array:
    """Derivatives of two transformations, one after the other: the product of each point's two.

    As sums over all points at a time, which for thousands of small matrices `@` is not.

    Args:
        outer: of the second transformation, shape (n, 2, 2).
        inner: of the first one, shape (n, 2, 2).

    Returns:
        Shape (n, 2, 2), target coordinate by source coordinate.

    Example:
        >>> turn = np.array([[[0.0, -1.0], [1.0, 0.0]]])
        >>> chained_jacobian(turn, 2.0 * turn)
        array([[[-2., -0.],
                [ 0., -2.]]])
    """
    product = np.empty((2, 2, len(outer)))
    for i in range(2):
        for j in range(2):
            np.multiply(outer[:, i, 0], inner[:, 0, j], out=product[i, j])
            product[i, j] += outer[:, i, 1] * inner[:, 1, j]
    return product.transpose(2, 0, 1)


def rotation_homography(master_from_cone: Array, f_cone_mm: float, f_master_mm: float) -> Array:
    """The homography a pure rotation makes between two image planes, K_master R K_cone^-1.

    An image point is the vector (x, y, -f) in camera axes x right, y forward, z up.

    Args:
        master_from_cone: rotation matrix (3, 3).
        f_cone_mm: principal distance of the source plane.
        f_master_mm: principal distance of the target plane.

    Returns:
        target_from_source (3, 3), mm, with element [2, 2] equal to one.

    Source: Ladstädter et al. (2010), "epipolar transformation" of the platform calibration;
    docs/explanation/mathematics/coordinates.md#similarity-and-projective-transformation.

    Example:
        A head turned by phi = 0.1 rad: its axis meets the master's plane at -f tan(phi).

        >>> from processing.geometry.rotation import rotation_matrix
        >>> homography = rotation_homography(rotation_matrix(0.0, 0.1, 0.0), 100.0, 100.0)
        >>> apply_projective(homography, np.array([[0.0, 0.0]])).round(4) + 0.0
        array([[-10.0335,   0.    ]])
    """
    master = np.diag([f_master_mm, f_master_mm, -1.0])
    cone = np.diag([1.0, 1.0, -f_cone_mm])
    # (x, y, -f) = cone @ (x, y, 1); the target point is f_master * (X, Y) / -Z.
    homography = master @ master_from_cone @ cone
    return np.asarray(homography / homography[2, 2])
