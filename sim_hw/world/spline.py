"""Pictures as quintic B-splines: read anywhere between their samples without moving anything.

Interpolation with windowed sinc kernels of six taps shifts long waves by up to 0.017 px, depending
on the sub-pixel phase; a spline of the same six taps stays below 0.001 px up to half the Nyquist
frequency. Source: Unser, Splines: a perfect fit for signal and image processing, 1999.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float32]

TAPS = 6
PHASES = 1024
"""Entries of the table of weights; between them it is interpolated."""
STORED_UNIT = 32000.0
STORED_ZERO = 12000.0
"""Coefficients are kept as uint16: radiance 1 lies at zero plus unit, and they may overshoot."""
REACH = 20
DESIGN_SIZE = 512


def weight_table() -> Map:
    """Weights of the six taps at -2..3 for fractions 0..1, shape (PHASES + 1, 6)."""
    fraction = np.arange(PHASES + 1)[:, None] / PHASES
    return np.asarray(quintic(np.arange(-2, 4)[None, :] - fraction), dtype=np.float32)


def quintic(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """The centred B-spline of degree five."""
    a = np.abs(x)
    inner = (((-10 * a + 30) * a * a - 60) * a * a + 66) / 120
    middle = (((((5 * a - 45) * a + 150) * a - 210) * a + 75) * a + 51) / 120
    outer = np.clip(3 - a, 0, None) ** 5 / 120
    return np.asarray(np.where(a < 1, inner, np.where(a < 2, middle, outer)))


def coefficients(picture: Map, sigma_px: float = 0.0) -> Map:
    """Spline coefficients of a picture seen through a Gaussian lens, same shape (rows, columns)."""
    kernel = coefficient_kernel(sigma_px)
    filtered = cv2.sepFilter2D(
        picture, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REFLECT101
    )
    return np.asarray(filtered, dtype=np.float32)


def coefficient_kernel(sigma_px: float) -> Map:
    """Taps of Gaussian and inverse spline filter in one, from their product of spectra."""
    f = np.fft.fftfreq(DESIGN_SIZE)
    spline = (66 + 52 * np.cos(2 * np.pi * f) + 2 * np.cos(4 * np.pi * f)) / 120
    # The Gaussian sampled at whole pixels: cut off at the Nyquist frequency it would ring.
    spectrum = sum(np.exp(-2 * (np.pi * sigma_px * (f + m)) ** 2) for m in range(-3, 4)) / spline
    if sigma_px == 0:
        spectrum = 1 / spline
    taps = np.fft.fftshift(np.fft.ifft(spectrum).real)
    middle = DESIGN_SIZE // 2
    kernel = taps[middle - REACH : middle + REACH + 1]
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)


def stored(radiances: Map) -> NDArray[np.uint16]:
    """Coefficients as they are kept."""
    return np.asarray(np.clip(radiances * STORED_UNIT + (STORED_ZERO + 0.5), 0, 65535), np.uint16)
