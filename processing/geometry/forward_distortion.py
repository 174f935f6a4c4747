"""Camera models of other programs: measured pixels from ideal rays, fitted to a calibration.

A rig file corrects measured coordinates to ideal ones; programs of computer vision compute measured
pixels of ideal rays. The polynomials are no inverses of each other, so that the parameters are
fitted to pairs of rays and pixels, and the largest residual is returned with them.

Source: docs/explanation/mathematics/lens.md#from-browns-model; Brown (1971).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]

Form = Literal["pinhole", "opencv", "brown", "full_opencv", "metashape"]

_SHARED = ("fx_px", "fy_px", "cx_px", "cy_px")
FREE_OF_FORM: Final[Mapping[Form, tuple[str, ...]]] = {
    "pinhole": _SHARED,
    "opencv": (*_SHARED, "k1", "k2", "p1", "p2"),
    "brown": (*_SHARED, "k1", "k2", "k3", "p1", "p2"),
    "full_opencv": (*_SHARED, "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"),
    "metashape": (*_SHARED, "skew_px", "k1", "k2", "k3", "radial_r8", "p1", "p2"),
}
"""Estimated parameters of each form; the others are zero."""


@dataclass(frozen=True)
class ForwardDistortion:
    """Pixels of rays: u = cx + fx x' + skew y', v = cy + fy y', integers at pixel centres, v down.

    x' = x N / D + 2 p1 x y + p2 (r2 + 2 x2), y' = y N / D + p1 (r2 + 2 y2) + 2 p2 x y with
    N = 1 + k1 r2 + k2 r4 + k3 r6 + radial_r8 r8 and D = 1 + k4 r2 + k5 r4 + k6 r6; x right, y down
    in units of the depth.
    """

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    skew_px: float = 0.0
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    radial_r8: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    @property
    def is_pinhole(self) -> bool:
        """Whether the image has no distortion."""
        terms = (self.skew_px, self.k1, self.k2, self.k3, self.k4, self.k5, self.k6)
        return not any((*terms, self.radial_r8, self.p1, self.p2))


def measured_px_from_rays(model: ForwardDistortion, rays: Array) -> Array:
    """Pixels of ideal rays.

    Args:
        model: parameters.
        rays: x / z and y / z, x right, y down, z forward, shape (n, 2).

    Returns:
        Column and row, shape (n, 2), zero-based, integer at the pixel centre.

    Example:
        >>> model = ForwardDistortion(1000.0, 1000.0, 499.5, 499.5, k1=-0.1)
        >>> measured_px_from_rays(model, np.array([[0.3, 0.4]]))
        array([[792. , 889.5]])
    """
    x, y = rays[:, 0], rays[:, 1]
    r2 = x * x + y * y
    above = 1.0 + r2 * (model.k1 + r2 * (model.k2 + r2 * (model.k3 + r2 * model.radial_r8)))
    radial = above / (1.0 + r2 * (model.k4 + r2 * (model.k5 + r2 * model.k6)))
    xd = x * radial + 2.0 * model.p1 * x * y + model.p2 * (r2 + 2.0 * x * x)
    yd = y * radial + model.p1 * (r2 + 2.0 * y * y) + 2.0 * model.p2 * x * y
    return np.column_stack(
        [
            model.cx_px + model.fx_px * xd + model.skew_px * yd,
            model.cy_px + model.fy_px * yd,
        ]
    )


def rays_from_measured_px(model: ForwardDistortion, pixels: Array) -> Array:
    """Ideal rays of pixels: the inverse of `measured_px_from_rays` by fixed-point iteration.

    Args:
        model: parameters.
        pixels: column and row, shape (n, 2).

    Returns:
        x / z and y / z, shape (n, 2); NaN where no ray maps to the pixel within 1e-6 px.

    Example:
        >>> model = ForwardDistortion(1000.0, 1000.0, 499.5, 499.5, k1=-0.1)
        >>> rays_from_measured_px(model, np.array([[792.0, 889.5]])).round(9)
        array([[0.3, 0.4]])
    """
    linear = np.array([[model.fx_px, model.skew_px], [0.0, model.fy_px]])
    centre = np.array([model.cx_px, model.cy_px])
    inverse = np.linalg.inv(linear).T
    rays = (pixels - centre) @ inverse
    misfit = np.full_like(rays, np.inf)
    with np.errstate(all="ignore"):
        for _ in range(100):
            misfit = pixels - measured_px_from_rays(model, rays)
            if np.nanmax(np.abs(misfit), initial=0.0) < 1e-9:
                break
            rays = rays + misfit @ inverse
    rays[~(np.abs(misfit).max(axis=1, initial=0.0) < 1e-6)] = np.nan
    return np.asarray(rays)


def fit_distortion(
    form: Form, rays: Array, pixels: Array, *, f_px: float
) -> tuple[ForwardDistortion, float]:
    """The parameters of a form that map rays to pixels best, by least squares.

    Args:
        form: which parameters are estimated.
        rays: x / z and y / z, x right, y down, shape (n, 2), spread over the image.
        pixels: their column and row, shape (n, 2).
        f_px: principal distance to begin with.

    Returns:
        The parameters, and the largest residual in one coordinate, px.

    Raises:
        ValueError: fewer pairs than parameters, or values that are not finite.

    Example:
        >>> true = ForwardDistortion(1000.0, 1000.0, 320.0, 240.0, k1=-0.1, p1=1e-4)
        >>> grid = np.stack(np.meshgrid(np.linspace(-0.3, 0.3, 9), np.linspace(-0.2, 0.2, 9)), -1)
        >>> rays = grid.reshape(-1, 2)
        >>> found, worst_px = fit_distortion(
        ...     "opencv", rays, measured_px_from_rays(true, rays), f_px=990.0
        ... )
        >>> round(found.k1, 6), worst_px < 1e-6
        (-0.1, True)
    """
    names = FREE_OF_FORM[form]
    if 2 * len(rays) <= len(names) or not (np.isfinite(rays).all() and np.isfinite(pixels).all()):
        raise ValueError(f"{len(rays)} pairs of finite rays and pixels; {form} has {len(names)}")
    centre = pixels.mean(axis=0) - f_px * rays.mean(axis=0)
    start = ForwardDistortion(f_px, f_px, float(centre[0]), float(centre[1]))
    reach = max(float(np.linalg.norm(rays, axis=1).max()), 1e-6)
    unit = np.array([_size_of(name, f_px, reach) for name in names])

    def model_of(values: Array) -> ForwardDistortion:
        return replace(start, **dict(zip(names, (float(v) for v in values * unit), strict=True)))

    def residuals(values: Array) -> Array:
        return (measured_px_from_rays(model_of(values), rays) - pixels).ravel()

    begin = np.array([getattr(start, name) for name in names]) / unit
    found = least_squares(residuals, begin, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return model_of(found.x), float(np.abs(found.fun).max())


def _size_of(name: str, f_px: float, reach: float) -> float:
    """The change of a parameter that moves a pixel at the edge of the field by about one pixel."""
    power = {"k1": 3, "k4": 3, "k2": 5, "k5": 5, "k3": 7, "k6": 7, "radial_r8": 9}.get(name)
    if power is not None:
        return 1.0 / (f_px * reach**power)
    if name in ("p1", "p2"):
        return 1.0 / (f_px * reach**2)
    return 1.0 if name in ("cx_px", "cy_px") else 1.0 / reach
