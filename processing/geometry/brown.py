"""Brown's distortion in the form of computer vision, converted to the lens correction.

Makers of small cameras state measured = f(ideal); a rig file holds ideal = measured + delta. The
correction is fitted once; the fit returns its largest error.

Source: docs/explanation/mathematics/lens.md#from-browns-model; Brown (1971); Heier et al. (2002),
eq. 5.1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.lens import lens_correction
from processing.rig import Lens

Array = NDArray[np.float64]

_GRID: Final = 41
_GRID_OVERSIZE: Final = 1.02
"""The fit reaches a little past the frame: no extrapolation at its corners."""


@dataclass(frozen=True)
class Brown:
    """measured = ideal (1 + k1 r2 + k2 r4 + k3 r6) + tangential, in units of the focal length,
    x right, y down; the principal point in pixels (column, row).

    Tangential: x by 2 p1 x y + p2 (r2 + 2 x2), y by p1 (r2 + 2 y2) + 2 p2 x y.
    """

    f_px: float
    principal_point_px: tuple[float, float]
    k1: float
    k2: float
    k3: float
    p1: float
    p2: float


def measured_from_ideal_brown(brown: Brown, xy: Array) -> Array:
    """Distort ideal points by Brown's model.

    Args:
        brown: coefficients.
        xy: ideal points in units of the focal length, shape (n, 2), x right, y down.

    Returns:
        Measured points, shape (n, 2), same unit and axes.

    Example:
        Barrel distortion: at r = 0.5 the radius shrinks by k1 r^2 = 2.5 %.

        >>> brown = Brown(1000.0, (499.5, 499.5), k1=-0.1, k2=0.0, k3=0.0, p1=0.0, p2=0.0)
        >>> measured_from_ideal_brown(brown, np.array([[0.5, 0.0], [0.3, 0.4]]))
        array([[0.4875, 0.    ],
               [0.2925, 0.39  ]])
    """
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (brown.k1 + r2 * (brown.k2 + r2 * brown.k3))
    return np.column_stack(
        [
            x * radial + 2.0 * brown.p1 * x * y + brown.p2 * (r2 + 2.0 * x * x),
            y * radial + brown.p1 * (r2 + 2.0 * y * y) + 2.0 * brown.p2 * x * y,
        ]
    )


def lens_from_brown(
    brown: Brown, *, width_px: int, height_px: int, pitch_mm: float, f_number: float, serial: str
) -> tuple[Lens, float]:
    """The lens of eq. 5.1 that undoes Brown's distortion best.

    Args:
        brown: the distortion to undo.
        width_px: columns of the frame.
        height_px: rows of the frame.
        pitch_mm: pixel pitch; with `brown.f_px` it gives the principal distance.
        f_number: copied into the lens.
        serial: copied into the lens.

    Returns:
        The lens about Brown's principal point, and the largest error of the fit over the frame, px.

    Raises:
        ValueError: a distortion that folds the frame over.

    Example:
        >>> brown = Brown(1000.0, (499.5, 499.5), k1=-0.1, k2=0.0, k3=0.0, p1=0.0, p2=0.0)
        >>> lens, worst_px = lens_from_brown(
        ...     brown, width_px=1000, height_px=1000, pitch_mm=0.005, f_number=4.0, serial=""
        ... )
        >>> lens.f_mm, worst_px < 0.01
        (5.0, True)
    """

    def measured_px(ideal: Array) -> Array:
        measured = measured_from_ideal_brown(brown, ideal) * brown.f_px
        return np.asarray(measured + np.array(brown.principal_point_px))

    return lens_from_distortion(
        measured_px, brown.f_px, brown.principal_point_px, (width_px, height_px), pitch_mm,
        f_number=f_number, serial=serial,
    )  # fmt: skip


def lens_from_distortion(
    measured_px: Callable[[Array], Array],
    f_px: float,
    centre_px: tuple[float, float],
    size_px: tuple[int, int],
    pitch_mm: float,
    *,
    f_number: float,
    serial: str,
    is_affine: bool = False,
    reach: float = 1.15,
) -> tuple[Lens, float]:
    """The lens of eq. 5.1 that undoes a distortion best.

    Args:
        measured_px: pixels (column, row), shape (n, 2), of ideal points in units of the focal
            length, shape (n, 2), x right, y down.
        f_px: focal length.
        centre_px: principal point, column and row.
        size_px: columns and rows of the frame.
        pitch_mm: pixel pitch; with `f_px` it gives the principal distance.
        f_number: copied into the lens.
        serial: copied into the lens.
        is_affine: whether affinity, shear and a change of the focal length are fitted, too.
        reach: of the ideal points, in half frames; what falls outside of the frame is left out.

    Returns:
        The lens about the principal point, and the largest error of the fit over the frame, px.

    Raises:
        ValueError: a distortion that cannot be undone within a pixel.

    Source: docs/explanation/mathematics/lens.md#from-browns-model; Heier et al. (2002), eq. 5.1.
    """
    f_mm = f_px * pitch_mm
    centre, (width_px, height_px) = centre_px, size_px
    half = _GRID_OVERSIZE * max(
        centre[0], centre[1], width_px - 1 - centre[0], height_px - 1 - centre[1], 1.0
    )
    axis = np.linspace(-reach * half, reach * half, _GRID) / f_px
    ideal = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    at = measured_px(ideal)
    measured = (at - np.array(centre)) / f_px
    inside = (
        (at[:, 0] >= -0.02 * width_px)
        & (at[:, 0] <= 1.02 * width_px)
        & (at[:, 1] >= -0.02 * height_px)
        & (at[:, 1] <= 1.02 * height_px)
    )
    up = np.array([f_mm, -f_mm])
    m, delta = measured[inside] * up, (ideal - measured)[inside] * up
    lens = Lens(f_mm=f_mm, f_number=f_number, serial=serial)
    terms = ("k1", "k2", "k3", "p1", "p2", *(("b1", "b2", "df_mm") if is_affine else ()))
    columns = [lens_correction(_with(lens, {term: 1.0}), m).ravel() for term in terms]
    design = np.stack(columns, axis=1)
    size = np.linalg.norm(design, axis=0)
    solution, *_ = np.linalg.lstsq(design / size, delta.ravel(), rcond=None)
    values = (float(value) for value in solution / size)
    lens = _with(lens, dict(zip(terms, values, strict=True)))
    worst_px = float(np.abs(lens_correction(lens, m) - delta).max()) / pitch_mm
    if not math.isfinite(worst_px) or worst_px > 1.0:
        raise ValueError(f"the distortion cannot be undone within a pixel ({worst_px:.2g} px left)")
    return lens, worst_px


def _with(lens: Lens, values: Mapping[str, float]) -> Lens:
    changed: dict[str, Any] = dict(values)
    return replace(lens, **changed)
