"""The lens correction of a cone: the ten parameters of Australis, and the grid of residuals,
where the rig file holds one.

Points are mm in the layer, origin at the calibrated principal point; the direction is part of
each function's name.

Source: docs/explanation/mathematics/lens.md#ten-parameters; Heier et al. (2002), eq. 5.1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from processing.geometry.residual_grid import grid_of_lens
from processing.rig import Lens

Array = NDArray[np.float64]

_INVERSION_TOLERANCE_MM = 1e-10
_INVERSION_STEPS = 25


def lens_correction(lens: Lens, measured_mm: Array) -> Array:
    """The correction (dx, dy) of eq. 5.1, and that of the grid where the lens has one.

    The equation divides by z = -f, so the df term is +x df / f.

    Args:
        lens: the ten parameters and the grid.
        measured_mm: measured points about the principal point, shape (n, 2), mm, y up.

    Returns:
        Corrections to be added to measured points, shape (n, 2), mm.

    Source: docs/explanation/mathematics/lens.md#ten-parameters; Heier et al. (2002), eq. 5.1.

    Example:
        K1 alone: K1 r^3 = 1e-6 * 20^3 = 8 um outward at r = 20 mm.

        >>> lens = Lens(f_mm=100.0, k1=1e-6)
        >>> lens_correction(lens, np.array([[20.0, 0.0], [12.0, 16.0]]))
        array([[0.008 , 0.    ],
               [0.0048, 0.0064]])
    """
    x, y = measured_mm[:, 0], measured_mm[:, 1]
    r2 = x * x + y * y
    radial = r2 * (lens.k1 + r2 * (lens.k2 + r2 * lens.k3)) + lens.df_mm / lens.f_mm
    delta = np.empty((len(measured_mm), 2))
    delta[:, 0] = (
        lens.dx0_mm
        + x * radial
        + (r2 + 2.0 * x * x) * lens.p1
        + 2.0 * x * y * lens.p2
        + x * lens.b1
        + y * lens.b2
    )
    delta[:, 1] = lens.dy0_mm + y * radial + 2.0 * x * y * lens.p1 + (r2 + 2.0 * y * y) * lens.p2
    if lens.residual_grid is not None:
        delta += grid_of_lens(lens.residual_grid).correction_to_ideal(measured_mm)
    return delta


def ideal_from_measured(lens: Lens, measured_mm: Array) -> Array:
    """Ideal (distortion-free) points of measured ones: ideal = measured + delta(measured).

    Args:
        lens: the ten parameters and the grid.
        measured_mm: measured points about the principal point, shape (n, 2), mm, y up.

    Returns:
        Ideal points, shape (n, 2), mm.

    Example:
        >>> ideal_from_measured(Lens(f_mm=100.0, k1=1e-6), np.array([[20.0, 0.0]]))
        array([[20.008,  0.   ]])
    """
    return measured_mm + lens_correction(lens, measured_mm)


def measured_from_ideal(lens: Lens, ideal_mm: Array) -> Array:
    """Measured points of ideal ones: eq. 5.1 inverted by Newton's method.

    Args:
        lens: the ten parameters and the grid.
        ideal_mm: ideal points about the principal point, shape (n, 2), mm, y up.

    Returns:
        Measured points, shape (n, 2), mm, exact to 1e-10 mm. Points so far outside the image that
        the polynomial folds over have no measured point: they are NaN.

    Source: docs/explanation/mathematics/lens.md#inverse.

    Example:
        >>> lens = Lens(f_mm=100.0, k1=1e-6)
        >>> measured_from_ideal(lens, np.array([[20.008, 0.0]])).round(6)
        array([[20.,  0.]])
    """
    measured = ideal_mm - lens_correction(lens, ideal_mm)
    for _ in range(_INVERSION_STEPS):
        misfit = ideal_from_measured(lens, measured) - ideal_mm
        unconverged = ~(np.abs(misfit).max(axis=1, initial=0.0) <= _INVERSION_TOLERANCE_MM)
        if not unconverged.any():
            return measured
        jacobian = _jacobian(lens, measured)
        determinant = jacobian[:, 0] * jacobian[:, 3] - jacobian[:, 1] * jacobian[:, 2]
        step = np.empty_like(measured)
        with np.errstate(all="ignore"):
            step[:, 0] = jacobian[:, 3] * misfit[:, 0] - jacobian[:, 1] * misfit[:, 1]
            step[:, 1] = jacobian[:, 0] * misfit[:, 1] - jacobian[:, 2] * misfit[:, 0]
            measured = measured - step / determinant[:, None]
    measured[unconverged] = np.nan
    return measured


def _jacobian(lens: Lens, measured_mm: Array) -> Array:
    """d(ideal) / d(measured), columns xx, xy, yx, yy: shape (n, 4).

    The grid's slopes, some 1e-4, are left out: they cost a step of the inversion, no accuracy.
    """
    x, y = measured_mm[:, 0], measured_mm[:, 1]
    r2 = x * x + y * y
    radial = r2 * (lens.k1 + r2 * (lens.k2 + r2 * lens.k3)) + lens.df_mm / lens.f_mm
    # d(radial) / d(r2), twice: the chain rule brings 2x and 2y.
    slope = 2.0 * (lens.k1 + r2 * (2.0 * lens.k2 + r2 * 3.0 * lens.k3))
    jacobian = np.empty((len(measured_mm), 4))
    jacobian[:, 0] = 1.0 + radial + x * x * slope + 6.0 * x * lens.p1 + 2.0 * y * lens.p2 + lens.b1
    jacobian[:, 1] = x * y * slope + 2.0 * y * lens.p1 + 2.0 * x * lens.p2 + lens.b2
    jacobian[:, 2] = x * y * slope + 2.0 * y * lens.p1 + 2.0 * x * lens.p2
    jacobian[:, 3] = 1.0 + radial + y * y * slope + 2.0 * x * lens.p1 + 6.0 * y * lens.p2
    return jacobian
