"""Polynomial additional parameters of whole images: Ebner's and Grün's orthogonal sets.

Both are products of one-dimensional polynomials that are orthogonal on a square grid of image
points, 3 x 3 and 5 x 5, without the six combinations that the orientation of an image compensates
over flat ground.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_OF_EBNER: Final = ((1.0,), (0.0, 1.0), (-2.0 / 3.0, 0.0, 1.0))
"""On the grid -1, 0, 1; coefficients by rising power."""

_OF_GRUEN: Final = (
    (1.0,),
    (0.0, 1.0),
    (-1.0 / 2.0, 0.0, 1.0),
    (0.0, -17.0 / 20.0, 0.0, 1.0),
    (9.0 / 70.0, 0.0, -31.0 / 28.0, 0.0, 1.0),
)
"""On the grid -1, -1/2, 0, 1/2, 1."""


class PolynomialProduct(NamedTuple):
    """A factor times the polynomials of degree `x` in x and degree `y` in y."""

    factor: float
    x: int
    y: int


class Polynomial(NamedTuple):
    """Corrections of one parameter in x and in y, and the polynomials they are products of."""

    of_x: tuple[PolynomialProduct, ...]
    of_y: tuple[PolynomialProduct, ...]
    basis: tuple[tuple[float, ...], ...]

    def at(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Corrections for a parameter of one.

        Args:
            u: image coordinates x over half the side of the grid, shape (n,).
            v: image coordinates y, likewise.

        Returns:
            In x and y, shape (n,).
        """

        def value(products: tuple[PolynomialProduct, ...]) -> Array:
            total = np.zeros_like(u)
            for factor, x, y in products:
                total += (
                    factor
                    * np.polynomial.polynomial.polyval(u, self.basis[x])
                    * (np.polynomial.polynomial.polyval(v, self.basis[y]))
                )
            return total

        return value(self.of_x), value(self.of_y)


def _ebner() -> dict[str, Polynomial]:
    one = 1.0
    parts: list[tuple[tuple[PolynomialProduct, ...], tuple[PolynomialProduct, ...]]] = [
        ((PolynomialProduct(one, 1, 0),), (PolynomialProduct(-one, 0, 1),)),
        ((PolynomialProduct(one, 0, 1),), (PolynomialProduct(one, 1, 0),)),
        ((PolynomialProduct(-2.0, 2, 0),), (PolynomialProduct(one, 1, 1),)),
        ((PolynomialProduct(one, 1, 1),), (PolynomialProduct(-2.0, 0, 2),)),
        ((PolynomialProduct(one, 0, 2),), ()),
        ((), (PolynomialProduct(one, 2, 0),)),
        ((PolynomialProduct(one, 1, 2),), ()),
        ((), (PolynomialProduct(one, 2, 1),)),
        ((PolynomialProduct(one, 2, 1),), ()),
        ((), (PolynomialProduct(one, 1, 2),)),
        ((PolynomialProduct(one, 2, 2),), ()),
        ((), (PolynomialProduct(one, 2, 2),)),
    ]
    return {f"ebner {k + 1}": Polynomial(*part, _OF_EBNER) for k, part in enumerate(parts)}


def _gruen() -> dict[str, Polynomial]:
    """a_ij and b_ij belong to degree j - 1 in x and i - 1 in y, in x and in y."""
    one, tilt = 1.0, -10.0 / 7.0
    found = {
        "a12": ((PolynomialProduct(one, 1, 0),), (PolynomialProduct(-one, 0, 1),)),
        "a21": ((PolynomialProduct(one, 0, 1),), (PolynomialProduct(one, 1, 0),)),
        "a22": ((PolynomialProduct(one, 1, 1),), (PolynomialProduct(tilt, 0, 2),)),
        "b22": ((PolynomialProduct(tilt, 2, 0),), (PolynomialProduct(one, 1, 1),)),
        "a31": ((PolynomialProduct(one, 0, 2),), ()),
        "b13": ((), (PolynomialProduct(one, 2, 0),)),
    }
    for i in range(5):
        for j in range(5):
            if i + j >= 3:
                found[f"a{i + 1}{j + 1}"] = ((PolynomialProduct(one, j, i),), ())
                found[f"b{i + 1}{j + 1}"] = ((), (PolynomialProduct(one, j, i),))
    return {f"gruen {name}": Polynomial(*part, _OF_GRUEN) for name, part in found.items()}


EBNER: Final[Mapping[str, Polynomial]] = _ebner()
"""12 parameters. Source: Ebner (1976)."""

GRUEN: Final[Mapping[str, Polynomial]] = _gruen()
"""44 parameters. Source: Grün (1978)."""

POLYNOMIALS: Final[Mapping[str, Polynomial]] = {**EBNER, **GRUEN}
