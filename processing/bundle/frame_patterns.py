"""What stitching leaves in a frame: displacements common to its points, with their covariance.

A stitched image is made of sensors whose places are known with a covariance. A few patterns with
independent amplitudes of standard deviation one hold nearly all of it; in the adjustment the
amplitudes are unknowns of the image, observed as zero.

Source: docs/explanation/mathematics/bundle.md#patterns-of-stitched-images.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.terms import Part, part_of

Array = NDArray[np.float64]

MAX_PATTERNS: Final = 8
SHARE: Final = 0.99
"""Of the variance that the patterns hold, if `MAX_PATTERNS` suffice."""
_POWERS: Final = 6


@dataclass(frozen=True)
class FramePatterns:
    """Patterns of one image.

    Attributes:
        parts: rectangles of the image that its sensors made.
        coefficients: (k, parts, 6, 2) of 1, x, y, x^2, x y, y^2 (x, y in half sizes from the
            principal point), mm per unit of amplitude: place in the image less the true one.
        half_size_mm: unit of x and y.
        share: of the variance of stitching that the patterns hold.
    """

    parts: tuple[Part, ...]
    coefficients: Array
    half_size_mm: float
    share: float

    @property
    def count(self) -> int:
        """Number of patterns."""
        return len(self.coefficients)

    def at(self, xy_mm: Array) -> Array:
        """Displacements by amplitudes of one.

        Args:
            xy_mm: image points, shape (n, 2), mm.

        Returns:
            Shape (n, 2, k), mm.

        Example:
            The right half of an image is shifted by 2 um.

            >>> halves = (Part("A", "0", -9, -5, 0, 5), Part("B", "1", 0, -5, 9, 5))
            >>> shift = np.zeros((1, 2, 6, 2))
            >>> shift[0, 1, 0, 0] = 2e-3
            >>> patterns = FramePatterns(halves, shift, 9.0, 1.0)
            >>> patterns.at(np.array([[-4.0, 0.0], [4.0, 0.0]]))[:, 0, 0]
            array([0.   , 0.002])
        """
        own = part_of(self.parts, xy_mm)
        powers = monomials(xy_mm / self.half_size_mm)
        return np.asarray(np.einsum("np,knpa->nak", powers, self.coefficients[:, own]))


def monomials(uv: Array) -> Array:
    """1, u, v, u^2, u v, v^2.

    Args:
        uv: shape (n, 2).

    Returns:
        Shape (n, 6).
    """
    u, v = uv.T
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)


def patterns_of(
    parts: tuple[Part, ...],
    part: NDArray[np.int64],
    xy_mm: Array,
    factor_mm: Array,
    half_size_mm: float,
) -> FramePatterns:
    """The fewest patterns, eight at most, that hold 99 % of a covariance.

    Args:
        parts: rectangles of the image.
        part: which of them each place belongs to, shape (n,); six places or more of each part.
        xy_mm: places evenly over the parts, shape (n, 2), mm.
        factor_mm: shape (2n, r), of x and y of the first place, of the second, ...: times its own
            transpose it is the covariance.
        half_size_mm: of the image.

    Returns:
        Patterns in the order of their variance.

    Source: docs/explanation/mathematics/bundle.md#patterns-of-stitched-images.
    """
    # The covariance has the eigenvalues of this small matrix, and the factor carries its vectors.
    values, vectors = np.linalg.eigh(factor_mm.T @ factor_mm)
    values, vectors = np.clip(values[::-1], 0.0, None), vectors[:, ::-1]
    total = float(values.sum())
    held = np.cumsum(values) / max(total, 1e-300)
    count = min(int(np.searchsorted(held, SHARE)) + 1, MAX_PATTERNS) if total > 0.0 else 0
    powers = monomials(xy_mm / half_size_mm)
    coefficients = np.zeros((count, len(parts), _POWERS, 2))
    for k in range(count):
        pattern = (factor_mm @ vectors[:, k]).reshape(-1, 2)
        for p in range(len(parts)):
            own = part == p
            if own.any():
                coefficients[k, p] = np.linalg.lstsq(powers[own], pattern[own], rcond=None)[0]
    return FramePatterns(
        parts, coefficients, half_size_mm, float(held[count - 1]) if count else 1.0
    )
