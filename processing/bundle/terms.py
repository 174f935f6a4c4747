"""Additional parameters: corrections of image coordinates of one CCD or cone, or of whole images.

Each term is a correction of measured coordinates, linear in its parameter. Which terms make up a
set is in `self_calibration`; polynomials of whole images are in `polynomial_sets`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from processing.bundle.polynomial_sets import POLYNOMIALS

Array = NDArray[np.float64]

Kind = Literal[
    "shift-x", "shift-y", "rotation", "scale", "affinity", "shear", "perspective-x", "perspective-y"
]

UNITS: Final[Mapping[str, tuple[str, float]]] = {
    "shift-x": ("um", 1e3),
    "shift-y": ("um", 1e3),
    "rotation": ("urad", 1e6),
    "scale": ("ppm", 1e6),
    "affinity": ("ppm", 1e6),
    "shear": ("urad", 1e6),
    "perspective-x": ("ppm/mm", 1e6),
    "perspective-y": ("ppm/mm", 1e6),
    **dict.fromkeys(POLYNOMIALS, ("um", 1000.0)),
}
"""What a parameter is printed in, and how many of it make one of the internal unit (mm, rad, 1)."""


@dataclass(frozen=True)
class Part:
    """An upright rectangle of the image, mm about the principal point, that one CCD has made."""

    sensor: str
    cone: str
    x_min_mm: float
    y_min_mm: float
    x_max_mm: float
    y_max_mm: float

    @property
    def centre_mm(self) -> tuple[float, float]:
        """Middle of the rectangle, (x, y)."""
        return ((self.x_min_mm + self.x_max_mm) / 2.0, (self.y_min_mm + self.y_max_mm) / 2.0)


@dataclass(frozen=True)
class Term:
    """One additional parameter: `kind` on the CCDs `sensors` of an image made of `parts`.

    Corrections are taken about the centre of each part. `name` is unique within a camera. Of a
    polynomial the only part is the square of its grid.
    """

    name: str
    kind: str
    sensors: tuple[str, ...]
    parts: tuple[Part, ...]
    value: float = 0.0


def part_of(parts: Sequence[Part], xy_mm: Array) -> NDArray[np.int64]:
    """The part that image points belong to: where they lie deepest inside.

    In an overlap the border runs in its middle, as the seam does nominally.

    Args:
        parts: rectangles of the image, at least one.
        xy_mm: image points, shape (n, 2), mm.

    Returns:
        Index into `parts`, shape (n,).

    Example:
        Parts that overlap from 9 to 11 mm meet at 10 mm.

        >>> parts = (Part("A", "0", 0.0, 0.0, 11.0, 20.0), Part("B", "0", 9.0, 0.0, 20.0, 20.0))
        >>> part_of(parts, np.array([[9.9, 10.0], [10.1, 10.0]]))
        array([0, 1])
    """
    depth = np.stack(
        [
            np.minimum(
                np.minimum(xy_mm[:, 0] - p.x_min_mm, p.x_max_mm - xy_mm[:, 0]),
                np.minimum(xy_mm[:, 1] - p.y_min_mm, p.y_max_mm - xy_mm[:, 1]),
            )
            for p in parts
        ],
        axis=1,
    )
    return np.asarray(np.argmax(depth, axis=1))


def term_design(term: Term, xy_mm: Array) -> Array:
    """Correction that a parameter of one makes.

    Args:
        term: kind and CCDs.
        xy_mm: image points, shape (n, 2), mm.

    Returns:
        Shape (n, 2), mm; zero outside the term's CCDs.

    Example:
        A rotation of one rad moves a point 2 mm above its CCD's centre by 2 mm to the left.

        >>> part = Part("A", "0", 0.0, 0.0, 10.0, 20.0)
        >>> term_design(Term("turn", "rotation", ("A",), (part,)), np.array([[5.0, 12.0]]))
        array([[-2.,  0.]])
    """
    names = [part.sensor for part in term.parts]
    own = part_of(term.parts, xy_mm)
    chosen = np.isin(own, [names.index(s) for s in term.sensors])
    centres = np.array([part.centre_mm for part in term.parts])
    u, v = (xy_mm - centres[own]).T
    if term.kind in POLYNOMIALS:
        half = 0.5 * (term.parts[0].x_max_mm - term.parts[0].x_min_mm)
        return np.stack(POLYNOMIALS[term.kind].at(u / half, v / half), axis=1)
    one, none = np.ones_like(u), np.zeros_like(u)
    x, y = {
        "shift-x": (one, none),
        "shift-y": (none, one),
        "rotation": (-v, u),
        "scale": (u, v),
        "affinity": (u, -v),
        "shear": (v, u),
        "perspective-x": (u * u, u * v),
        "perspective-y": (u * v, v * v),
    }[term.kind]
    return np.asarray(np.stack([x, y], axis=1) * chosen[:, None])
