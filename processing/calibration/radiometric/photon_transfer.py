"""Photon transfer, saturation, dynamic range and linearity in the manner of EMVA 1288.

Numbers that need the photons counted (quantum efficiency, sensitivity) are left out: an integrating
sphere's monitor is relative. Source: EMVA Standard 1288, release 4.0 linear, sections 2, 6 and 7.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

QUANTISATION_DN2: Final = 1.0 / 12.0
_FIT_SHARE: Final = 0.7
_LINEAR_SHARES: Final = (0.05, 0.95)
_CLIPPED_SHARE: Final = 1e-3


@dataclass(frozen=True)
class ExposureSeries:
    """A series of growing exposure, over the same good pixels.

    `exposure` (n,) is light times time, any unit; `signal_dn` (n,) above the offset; `variance_dn2`
    (n,) temporal, of one frame; `sigma_dn2` (n,) the standard deviation of that; `clipped` (n,) the
    share of pixels at full scale. `dark_dn2` is the temporal variance without light.
    """

    exposure: Array
    signal_dn: Array
    variance_dn2: Array
    sigma_dn2: Array
    clipped: Array
    dark_dn2: float
    dark_sigma_dn2: float


@dataclass(frozen=True)
class PhotonTransfer:
    """Figures of EMVA 1288 for temporal noise and linearity.

    Attributes:
        gain_dn_per_e: overall system gain K, with its sigma.
        temporal_dark_noise_e: temporal dark noise, quantisation taken off.
        saturation_dn, saturation_e: signal where the variance is largest.
        absolute_threshold_e: least detectable signal (signal to noise 1).
        dynamic_range: saturation over threshold.
        snr_max: signal to noise at saturation.
        linearity_percent: mean |deviation| from the line between 5 and 95 % of saturation.
        responsivity: DN per unit of exposure, of that line; deviations (n,) in %, NaN outside.
    """

    gain_dn_per_e: float
    gain_sigma: float
    temporal_dark_noise_e: float
    dark_noise_sigma_e: float
    saturation_dn: float
    saturation_e: float
    absolute_threshold_e: float
    dynamic_range: float
    snr_max: float
    linearity_percent: float
    responsivity: float
    deviation_percent: Array

    def variance_dn2(self, signal_dn: Array, dark_dn2: float) -> Array:
        """Temporal variance of one frame at a signal, as the model has it.

        Args:
            signal_dn: above the offset, any shape, DN.
            dark_dn2: temporal variance without light.

        Returns:
            dark + K * signal, the shape of `signal_dn`, DN squared.
        """
        return np.asarray(dark_dn2 + self.gain_dn_per_e * signal_dn)


def photon_transfer(exposure_series: ExposureSeries) -> PhotonTransfer:
    """Evaluate a series of growing exposure.

    Args:
        exposure_series: four steps or more below 70 % of saturation.

    Returns:
        Figures of EMVA 1288.

    Raises:
        ValueError: too few steps below 70 % of saturation.

    Source: EMVA Standard 1288, release 4.0 linear, section 2; docs/explanation/mathematics/
    radiometry.md#noise-model.

    Example:
        Variance 4 + 0.05 S up to 1000 DN: K = 0.05 DN/e, saturation 1000 / 0.05 electrons, whose
        root is the best signal to noise.

        >>> signal_dn = np.arange(100.0, 1001.0, 100.0)
        >>> series = exposure_series_of(
        ...     [(s, s, 4.0 + 0.05 * s, 0.1, 0.0) for s in signal_dn], dark=(4.0, 0.01)
        ... )
        >>> found = photon_transfer(series)
        >>> round(found.gain_dn_per_e, 6), round(found.saturation_e), round(found.snr_max, 2)
        (0.05, 20000, 141.42)
    """
    top = int(
        np.argmax(np.where(exposure_series.clipped < 0.5, exposure_series.variance_dn2, -np.inf))
    )
    saturation = float(exposure_series.signal_dn[top])
    used = (exposure_series.signal_dn < _FIT_SHARE * saturation) & (
        exposure_series.clipped <= _CLIPPED_SHARE
    )
    if used.sum() < 4:
        raise ValueError(
            f"{int(used.sum())} flat sets lie below {_FIT_SHARE:.0%} of saturation "
            f"({saturation:.0f} DN); four or more are needed for photon transfer"
        )
    mu, var = (
        exposure_series.signal_dn[used],
        exposure_series.variance_dn2[used] - exposure_series.dark_dn2,
    )
    weight = 1.0 / exposure_series.sigma_dn2[used] ** 2
    normal = float(np.sum(weight * mu * mu))
    gain = float(np.sum(weight * mu * var)) / normal
    by_dark = float(np.sum(weight * mu)) / normal * exposure_series.dark_sigma_dn2
    gain_sigma = math.hypot(normal**-0.5, by_dark)
    dark_e2 = max(exposure_series.dark_dn2 - QUANTISATION_DN2, 0.0) / gain**2
    dark_noise = math.sqrt(dark_e2)
    dark_sigma = (
        exposure_series.dark_sigma_dn2 / gain**2 / (2.0 * dark_noise) if dark_noise else 0.0
    )
    threshold = math.sqrt(exposure_series.dark_dn2 / gain**2 + 0.25) + 0.5
    saturation_e = saturation / gain
    low, high = (share * saturation for share in _LINEAR_SHARES)
    inside = (exposure_series.signal_dn >= low) & (exposure_series.signal_dn <= high)
    slope, offset = _relative_line(
        exposure_series.exposure[inside], exposure_series.signal_dn[inside]
    )
    line = offset + slope * exposure_series.exposure
    deviation = np.where(inside, 100.0 * (exposure_series.signal_dn - line) / line, np.nan)
    return PhotonTransfer(
        gain_dn_per_e=gain,
        gain_sigma=gain_sigma,
        temporal_dark_noise_e=dark_noise,
        dark_noise_sigma_e=math.hypot(dark_sigma, dark_noise * gain_sigma / gain),
        saturation_dn=saturation,
        saturation_e=saturation_e,
        absolute_threshold_e=threshold,
        dynamic_range=saturation_e / threshold,
        snr_max=math.sqrt(saturation_e),
        linearity_percent=float(np.mean(np.abs(deviation[inside]))),
        responsivity=slope,
        deviation_percent=np.asarray(deviation),
    )


def _relative_line(exposure: Array, signal: Array) -> tuple[float, float]:
    """The line whose relative deviations are least (EMVA 1288, 6.7)."""
    design = np.column_stack([exposure, np.ones_like(exposure)]) / signal[:, None]
    solved, *_ = np.linalg.lstsq(design, np.ones_like(exposure), rcond=None)
    return float(solved[0]), float(solved[1])


def exposure_series_of(
    steps: Sequence[tuple[float, float, float, float, float]], dark: tuple[float, float]
) -> ExposureSeries:
    """Put steps in order of their exposure.

    Args:
        steps: (exposure, signal DN, variance DN squared, its sigma, clipped share) each.
        dark: temporal variance without light, DN squared, and its sigma.

    Returns:
        The series.
    """
    table = np.array(sorted(steps), float).reshape(-1, 5).T
    exposure, signal, variance, sigma, clipped = table
    return ExposureSeries(exposure, signal, variance, sigma, clipped, dark[0], dark[1])
