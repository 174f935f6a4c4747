"""The fisheye model of Pix4D's tags, converted to the lens correction of a rig file.

Parrot's Sequoia states it in its images. The correction is fitted once, as that of Brown's model.

Source: Pix4D, "How are the Internal and External Camera Parameters defined?", fisheye lens; Parrot,
Sequoia application note SEQ-AN-03; docs/explanation/mathematics/lens.md#from-browns-model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.brown import lens_from_distortion
from processing.rig import Lens

Array = NDArray[np.float64]

_STEPS: Final = 200
_REACH: Final = 1.6
"""Ideal points reach this far, in half frames: a fisheye draws them together."""


@dataclass(frozen=True)
class Fisheye:
    """measured = principal point + A rho u, rho = sum p_i theta^i, theta = 2/pi atan(r).

    r is the distance of the ideal point from the axis in units of the focal length and u its
    direction, x right, y down; A = (c d; e f) in pixels; the principal point is (column, row).
    """

    principal_point_px: tuple[float, float]
    polynomial: tuple[float, ...]
    affine_px: tuple[float, float, float, float]

    @property
    def f_px(self) -> float:
        """Focal length at the axis: the mean scale of A times d rho / d r = p1 2 / pi."""
        c, d, e, f = self.affine_px
        scale = math.sqrt(abs(c * f - d * e))
        return scale * self.polynomial[1] * 2.0 / math.pi


def measured_px_from_ideal_fisheye(fisheye: Fisheye, xy: Array) -> Array:
    """Pixels of ideal points.

    Args:
        fisheye: coefficients.
        xy: ideal points in units of the focal length, shape (n, 2), x right, y down.

    Returns:
        Column and row, shape (n, 2).

    Source: Pix4D, "How are the Internal and External Camera Parameters defined?", fisheye lens.

    Example:
        At 45 degrees theta is 0.5: half of A's 1000 px.

        >>> lens = Fisheye((640.0, 480.0), (0.0, 1.0, 0.0, 0.0), (1000.0, 0.0, 0.0, 1000.0))
        >>> measured_px_from_ideal_fisheye(lens, np.array([[1.0, 0.0], [0.0, 0.0]]))
        array([[1140.,  480.],
               [ 640.,  480.]])
    """
    r = np.hypot(xy[:, 0], xy[:, 1])
    rho = np.polynomial.polynomial.polyval(2.0 / math.pi * np.arctan(r), fisheye.polynomial)
    unit = np.divide(xy, r[:, None], out=np.zeros_like(xy), where=r[:, None] > 0.0)
    affine = np.array(fisheye.affine_px).reshape(2, 2)
    return np.asarray(np.array(fisheye.principal_point_px) + rho[:, None] * unit @ affine.T)


def lens_from_fisheye(
    fisheye: Fisheye,
    *,
    width_px: int,
    height_px: int,
    pitch_mm: float,
    f_number: float,
    serial: str,
) -> tuple[Lens, float]:
    """The lens correction that undoes a fisheye best.

    Args:
        fisheye: the distortion to undo.
        width_px: columns of the frame.
        height_px: rows of the frame.
        pitch_mm: pixel pitch.
        f_number: copied into the lens.
        serial: copied into the lens.

    Returns:
        The lens about the principal point, and the largest error of the fit over the frame, px.

    Raises:
        ValueError: a polynomial that does not begin with zero or folds the frame over, or one that
            cannot be undone within a pixel.

    Source: docs/explanation/mathematics/lens.md#from-browns-model; Heier et al. (2002), eq. 5.1.

    Example:
        >>> lens = Fisheye((639.5, 479.5), (0.0, 1.0, 0.0, -0.1), (1800.0, 0.0, 0.0, 1800.0))
        >>> found, worst_px = lens_from_fisheye(
        ...     lens, width_px=1280, height_px=960, pitch_mm=0.00375, f_number=2.2, serial=""
        ... )
        >>> round(found.f_mm, 3), worst_px < 0.1
        (4.297, True)
    """
    if len(fisheye.polynomial) < 2 or fisheye.polynomial[0] != 0.0 or fisheye.polynomial[1] <= 0.0:
        raise ValueError("the polynomial of a fisheye begins with 0 and a positive number")
    half = math.hypot(width_px, height_px) / max(fisheye.f_px, 1.0)
    theta = 2.0 / math.pi * np.arctan(np.linspace(0.0, half, _STEPS))
    if np.diff(np.polynomial.polynomial.polyval(theta, fisheye.polynomial)).min() <= 0.0:
        raise ValueError("the polynomial of the fisheye folds the frame over")
    return lens_from_distortion(
        lambda ideal: measured_px_from_ideal_fisheye(fisheye, ideal),
        fisheye.f_px, fisheye.principal_point_px, (width_px, height_px), pitch_mm,
        f_number=f_number, serial=serial, is_affine=True, reach=_REACH,
    )  # fmt: skip
