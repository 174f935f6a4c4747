"""Plane similarities: shift, rotation and scale of a sensor in the layer of its cone.

This module holds the transformation only. `processing.geometry.drift` computes a sensor's
similarity at a temperature; `processing.mosaic.free_mosaic` adjusts it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Similarity:
    """target = (x_mm, y_mm) + scale * R(rotation_rad) * source; counter-clockwise, y up."""

    x_mm: float
    y_mm: float
    rotation_rad: float
    scale: float

    @property
    def matrix(self) -> Array:
        """The same as a homogeneous (3, 3) matrix."""
        c = self.scale * math.cos(self.rotation_rad)
        s = self.scale * math.sin(self.rotation_rad)
        return np.array([[c, -s, self.x_mm], [s, c, self.y_mm], [0.0, 0.0, 1.0]])


def apply_similarity(similarity: Similarity, xy_mm: Array) -> Array:
    """Carry points from the source to the target of a similarity.

    Args:
        similarity: target_from_source.
        xy_mm: source points, shape (n, 2), mm, y up.

    Returns:
        Target points, shape (n, 2), mm.

    Source: docs/explanation/mathematics/coordinates.md#similarity-and-projective-transformation.

    Example:
        A quarter turn, doubled, then shifted by (1, 0).

        >>> turned = Similarity(x_mm=1.0, y_mm=0.0, rotation_rad=math.pi / 2, scale=2.0)
        >>> apply_similarity(turned, np.array([[3.0, 0.0]])).round(6)
        array([[1., 6.]])
    """
    c = similarity.scale * math.cos(similarity.rotation_rad)
    s = similarity.scale * math.sin(similarity.rotation_rad)
    result = np.empty_like(xy_mm, dtype=np.float64)
    result[:, 0] = similarity.x_mm + c * xy_mm[:, 0] - s * xy_mm[:, 1]
    result[:, 1] = similarity.y_mm + s * xy_mm[:, 0] + c * xy_mm[:, 1]
    return result


def invert_similarity(similarity: Similarity) -> Similarity:
    """The similarity from target to source.

    Args:
        similarity: target_from_source.

    Returns:
        source_from_target.

    Example:
        >>> turned = Similarity(x_mm=1.0, y_mm=0.0, rotation_rad=math.pi / 2, scale=2.0)
        >>> apply_similarity(invert_similarity(turned), np.array([[1.0, 6.0]])).round(6) + 0.0
        array([[3., 0.]])
    """
    scale = 1.0 / similarity.scale
    c, s = math.cos(similarity.rotation_rad), math.sin(similarity.rotation_rad)
    return Similarity(
        x_mm=-scale * (c * similarity.x_mm + s * similarity.y_mm),
        y_mm=-scale * (-s * similarity.x_mm + c * similarity.y_mm),
        rotation_rad=-similarity.rotation_rad,
        scale=scale,
    )


def fit_similarity(source_mm: Array, target_mm: Array) -> Similarity:
    """The similarity that carries source points onto target points by least squares.

    Args:
        source_mm: shape (n, 2), mm, n at least 2.
        target_mm: shape (n, 2), mm, point by point.

    Returns:
        target_from_source.

    Raises:
        ValueError: fewer than two points, or all source points coincide.

    Example:
        >>> source_mm = np.array([[0.0, 0.0], [1.0, 0.0]])
        >>> found = fit_similarity(source_mm, np.array([[5.0, 5.0], [5.0, 7.0]]))
        >>> found.scale, round(math.degrees(found.rotation_rad), 6)
        (2.0, 90.0)
    """
    if len(source_mm) < 2:
        raise ValueError(f"{len(source_mm)} points; a similarity needs two")
    z = source_mm[:, 0] + 1j * source_mm[:, 1]
    w = target_mm[:, 0] + 1j * target_mm[:, 1]
    z0, w0 = z.mean(), w.mean()
    spread = float(np.sum(np.abs(z - z0) ** 2))
    if spread == 0.0:
        raise ValueError("all points coincide; a similarity needs two distinct ones")
    b = np.sum(np.conj(z - z0) * (w - w0)) / spread
    a = w0 - b * z0
    return Similarity(float(a.real), float(a.imag), float(np.angle(b)), float(abs(b)))
