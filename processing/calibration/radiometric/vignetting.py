"""Vignetting as a function of the aperture.

The part of vignetting that comes from mounts at a distance falls with the area of the diaphragm.
So the field of light at f-number N over that at N0 is 1 + (1/N^2 - 1/N0^2) * polynomial in r^2, and
any aperture between is had from a few measured ones. Source: Heier et al. (2002), 5.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.calibration.radiometric.frame_series import Map

Array = NDArray[Any]

_POWERS: Final = (1, 2, 3, 4)
_BLOCK_PX: Final = 16


@dataclass(frozen=True)
class ApertureModel:
    """`coefficients` (4,) of (r / reach_mm)^2, ^4, ^6, ^8; `covariance` (4, 4) theirs.

    `illumination` is what each measured aperture passes against 1/N^2, the base aperture being
    one: how well the diaphragm's scale holds. `misfit_percent` by aperture is the root mean square
    of what the model leaves of block means.
    """

    base_f_number: float
    reach_mm: float
    coefficients: Array
    covariance: Array
    illumination: dict[float, float]
    misfit_percent: dict[float, float]

    def ratio(self, r2_mm2: Array, f_number: float) -> Map:
        """Field of light at an aperture over that at the base aperture, one on the axis.

        Args:
            r2_mm2: squared distance from the axis, any shape, mm squared.
            f_number: of the aperture.

        Returns:
            The shape of `r2_mm2`.

        Source: docs/explanation/mathematics/radiometry.md#calibration-fits.

        Example:
            f/8 against f/4: (4/8)^2 - 1 = -0.75 of a fall of 20 % at the corner.

            >>> model = ApertureModel(4.0, 30.0, np.array([-0.2, 0, 0, 0]), np.eye(4), {}, {})
            >>> model.ratio(np.array([0.0, 900.0]), 8.0)
            array([1.  , 1.15], dtype=float32)
        """
        rho2 = r2_mm2 / self.reach_mm**2
        shape = sum(c * rho2**p for c, p in zip(self.coefficients, _POWERS, strict=True))
        return np.asarray(
            1.0 + _relative_aperture_area(f_number, self.base_f_number) * shape, dtype=np.float32
        )


def fit_aperture(
    base: tuple[float, Array],
    others: Sequence[tuple[float, Array]],
    *,
    r2_mm2: Array,
    good: Array,
) -> ApertureModel:
    """Fit the model of vignetting by aperture.

    Args:
        base: f-number and mean signal per monitored light and second, shape (height, width).
        others: the same at other apertures; none: the field is taken as it is at all apertures.
        r2_mm2: squared distance of every pixel from the axis, shape (height, width).
        good: pixels that count, shape (height, width), bool.

    Returns:
        Coefficients with their covariance, and how well each aperture fits.

    Source: docs/explanation/mathematics/radiometry.md#calibration-fits.
    """
    reach2 = float(r2_mm2.max())
    rho2 = _blocks(r2_mm2 / reach2, good)
    shape = np.stack([rho2**p for p in _POWERS], axis=1)
    rows, values, ratios = [], [], []
    for k, (f_number, field) in enumerate(others):
        ratio = _blocks(field / base[1], good) * (f_number / base[0]) ** 2
        # The aperture's light multiplies the whole field: ratio = e (1 + q S), e unknown.
        own = np.zeros((len(ratio), len(others)))
        own[:, k] = 1.0
        rows.append(np.hstack([_relative_aperture_area(f_number, base[0]) * shape, own]))
        values.append(ratio)
        ratios.append(ratio)
    if not others:
        empty = np.zeros((len(_POWERS), len(_POWERS)))
        return ApertureModel(
            base[0], reach2**0.5, np.zeros(len(_POWERS)), empty, {base[0]: 1.0}, {}
        )
    illumination = np.ones(len(others))
    for _ in range(4):
        design = np.vstack(rows).copy()
        for k in range(len(others)):
            part = slice(k * len(rho2), (k + 1) * len(rho2))
            design[part, : len(_POWERS)] *= illumination[k]
        solved, *_ = np.linalg.lstsq(design, np.concatenate(values), rcond=None)
        illumination = solved[len(_POWERS) :]
    residual = np.concatenate(values) - design @ solved
    freedom = len(residual) - len(solved)
    cofactor = np.linalg.inv(design.T @ design)[: len(_POWERS), : len(_POWERS)]
    residuals_by_aperture = residual.reshape(len(others), -1)
    return ApertureModel(
        base_f_number=base[0],
        reach_mm=reach2**0.5,
        coefficients=solved[: len(_POWERS)],
        covariance=cofactor * float(residual @ residual) / freedom,
        illumination={base[0]: 1.0}
        | {f: float(e) for (f, _), e in zip(others, illumination, strict=True)},
        misfit_percent={
            f: float(100.0 * np.sqrt(np.mean(r**2)))
            for (f, _), r in zip(others, residuals_by_aperture, strict=True)
        },
    )


def _relative_aperture_area(f_number: float, base: float) -> float:
    return (base / f_number) ** 2 - 1.0


def _blocks(values: Array, good: Array) -> Array:
    """Means of the good pixels of blocks, flat; blocks with half of their pixels defect are left
    out of every map."""
    height, width = (n // _BLOCK_PX * _BLOCK_PX for n in values.shape)

    def summed(array: Array) -> Array:
        cut = array[:height, :width].astype(np.float64)
        shaped = cut.reshape(height // _BLOCK_PX, _BLOCK_PX, width // _BLOCK_PX, _BLOCK_PX)
        return np.asarray(shaped.sum(axis=(1, 3)).ravel())

    count = summed(good)
    valid = count > _BLOCK_PX**2 / 2
    return np.asarray(summed(np.where(good, values, 0.0))[valid] / count[valid])
