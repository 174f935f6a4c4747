"""Bias and dark signal of every pixel from dark series over temperature and exposure time.

offset(T, t) = bias + dark * t * 2^((T - reference) / doubling): bias and dark by pixel, the
doubling of the whole sensor. Source: Heier et al. (2002), 5.2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from processing.calibration.radiometric.frame_series import FrameSet, Map

Array = NDArray[np.float64]

_DOUBLING_K: Final = (3.0, 25.0)
_SAMPLE_PX: Final = 100_000


@dataclass(frozen=True)
class DarkSignal:
    """The fit. Sigmas hold for every pixel; `misfit` is its root mean square residual in sigmas of
    the frames' noise, one where the model holds. `doubling_sigma_k` holds the probe's noise;
    `common_sigma` is what that makes of all dark signals together, relative."""

    bias_dn: Map
    dark_dn_per_s: Map
    doubling_k: float
    doubling_sigma_k: float
    reference_c: float
    bias_sigma_dn: float
    dark_sigma_dn_per_s: float
    common_sigma: float
    misfit: float

    def offset(self, exposure_time_s: float, temperature_c: float) -> Map:
        """Offset of every pixel.

        Args:
            exposure_time_s: of the frame.
            temperature_c: of the sensor.

        Returns:
            Shape (height, width), DN.

        Source: docs/explanation/mathematics/radiometry.md#offset-and-gain.

        Example:
            6 K above the reference a dark signal of 2 DN/s has doubled: 64 + 4 DN after a second.

            >>> one = np.ones((1, 1), np.float32)
            >>> signal = DarkSignal(64 * one, 2 * one, 6.0, 0.1, 20.0, 0.1, 0.1, 0.01, 1.0)
            >>> signal.offset(1.0, 26.0)
            array([[68.]], dtype=float32)
        """
        warm = 2.0 ** ((temperature_c - self.reference_c) / self.doubling_k)
        time = np.float32(exposure_time_s * warm)
        return np.asarray(self.bias_dn + self.dark_dn_per_s * time, dtype=np.float32)


def fit_dark_signal(
    sets: Sequence[FrameSet], *, reference_c: float, temperature_sigma_c: float
) -> DarkSignal:
    """Fit the model to dark sets.

    Args:
        sets: with two exposure times and two temperatures at least.
        reference_c: temperature the dark signal is stated for.
        temperature_sigma_c: standard deviation of a probe reading, carried into the doubling.

    Returns:
        Maps of bias and dark signal, the doubling, and their standard deviations.

    Raises:
        ValueError: the sets cannot separate the parameters; the message names what is missing.

    Source: docs/explanation/mathematics/radiometry.md#calibration-fits.
    """
    times = {round(s.condition.exposure_time_s, 9) for s in sets}
    temperatures = np.array([s.condition.temperature_c for s in sets])
    if len(times) < 2:
        raise ValueError("dark sets have one exposure time; two separate dark signal from bias")
    if np.ptp(temperatures) < 5.0:
        raise ValueError(
            f"dark sets lie within {np.ptp(temperatures):.1f} K; 5 K or more are needed for "
            "the growth of the dark signal"
        )
    weight = np.array([s.count / max(s.noise_dn2, 1e-3) for s in sets])
    clipped = np.logical_or.reduce([s.clipped for s in sets])
    good = np.flatnonzero(~clipped.ravel())
    step = max(1, good.size // _SAMPLE_PX)
    sample = good[::step]
    values = np.stack([s.mean.ravel()[sample].astype(float) for s in sets])
    gram = _gram(values * np.sqrt(weight)[:, None], np.sqrt(weight))

    def squares(doubling_k: float) -> float:
        design = _design(sets, doubling_k, reference_c) * np.sqrt(weight)[:, None]
        basis, _ = np.linalg.qr(design)
        return float(np.trace(gram) - np.trace(basis.T @ gram @ basis))

    found = minimize_scalar(squares, bounds=_DOUBLING_K, method="bounded", options={"xatol": 1e-6})
    doubling = float(found.x)
    least = squares(doubling)
    freedom = sample.size * (len(sets) - 2) - 1
    misfit = math.sqrt(max(least, 0.0) / freedom)
    h = 1e-3 * doubling
    bend = (squares(doubling + h) - 2.0 * least + squares(doubling - h)) / h**2
    by_noise = math.sqrt(2.0 / bend / step) * max(misfit, 1.0) if bend > 0.0 else math.inf
    counted = np.repeat(temperatures, [s.count for s in sets])
    spread = float(np.sum((counted - counted.mean()) ** 2))
    by_probe = doubling * temperature_sigma_c / math.sqrt(spread)
    design = _design(sets, doubling, reference_c)
    normal = design.T @ (design * weight[:, None])
    cofactor = np.linalg.inv(normal)
    share = cofactor @ design.T * weight
    bias = np.zeros(clipped.shape, np.float32)
    dark = np.zeros(clipped.shape, np.float32)
    for s, b, d in zip(sets, share[0], share[1], strict=True):
        bias += np.float32(b) * s.mean
        dark += np.float32(d) * s.mean
    # How the probe's errors in each set, and that of the doubling, enter the dark signal.
    warmed = share[1] * design[:, 1]
    counts = np.array([s.count for s in sets], float)
    by_reading = math.log(2.0) / doubling * temperature_sigma_c
    doubling_sigma = math.hypot(by_noise, by_probe)
    lever = float(np.sum(warmed * (temperatures - reference_c))) * math.log(2.0) / doubling**2
    common = math.hypot(
        by_reading * math.sqrt(float(np.sum(warmed**2 / counts))), lever * doubling_sigma
    )
    return DarkSignal(
        bias_dn=bias,
        dark_dn_per_s=dark,
        doubling_k=doubling,
        doubling_sigma_k=doubling_sigma,
        reference_c=reference_c,
        bias_sigma_dn=math.sqrt(cofactor[0, 0]),
        dark_sigma_dn_per_s=math.sqrt(cofactor[1, 1]),
        common_sigma=common,
        misfit=misfit,
    )


def _gram(weighted: Array, root: Array) -> Array:
    """Products of the sets' values; a common level of each pixel, which the bias takes, first
    taken off so that digits are kept."""
    unit = root / np.linalg.norm(root)
    reduced = weighted - unit[:, None] * (unit @ weighted)
    return np.asarray(reduced @ reduced.T)


def _design(sets: Sequence[FrameSet], doubling_k: float, reference_c: float) -> Array:
    """One and the mean warmed exposure time of every set, (sets, 2)."""
    warmed: list[Any] = [
        np.mean(
            s.condition.exposure_time_s
            * 2.0 ** ((np.array(s.temperatures_c) - reference_c) / doubling_k)
        )
        for s in sets
    ]
    return np.column_stack([np.ones(len(sets)), np.array(warmed, float)])
