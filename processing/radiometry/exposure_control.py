"""From the sampled histogram of a frame to the exposure time, gain and TDI count of the next one.

A pure law: counts and limits in, settings out. Which frames are looked at, when settings may change
and who changes them is the daemon's. Exposure time comes first, since it gains light; it ends where
motion would smear, and gain, which amplifies noise as well, does the rest up to its own limit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

BINS: Final = 64
EVERY: Final = 8
"""Every eighth pixel of every eighth row: 65,000 of a frame of 4 million."""
BRIGHT_SHARE: Final = 0.99
"""The 99th percentile is controlled: of bright roofs little is lost."""

MAX_STEP_FACTOR: Final = 2.0
"""The most that light is changed at once, up or down: one odd image must not spoil the next."""

SATURATED_STEP: Final = 0.5
"""Saturated pixels do not show by how much."""


@dataclass(frozen=True)
class ExposureSettings:
    """What a head exposes with."""

    exposure_time_us: float
    gain_db: float = 0.0
    tdi_shifts: int = 0

    @property
    def light(self) -> float:
        """What the signal is proportional to."""
        return self.exposure_time_us * 10 ** (self.gain_db / 20)


@dataclass(frozen=True)
class ExposureLimits:
    """What settings may be.

    `rows_per_s` is how fast the image moves over the rows of the sensor: ground speed over GSD;
    None where height or speed are not known, then the exposure time may only become shorter.
    `smear_px` is the motion that may be left, along track after TDI and, by `crab_rad`, across.
    `gain_max_db` is the noise limit. `black` is the black level as a share of the full scale,
    `target` where the 99th percentile of the pixels should be, `deadband` how far off that
    is left alone.
    """

    exposure_time_min_us: float
    exposure_time_max_us: float
    gain_max_db: float
    tdi_shifts_max: int
    rows_per_s: float | None
    smear_px: float = 0.5
    crab_rad: float = 0.0
    target: float = 0.6
    deadband: float = 0.12
    black: float = 0.0


def next_settings(
    counts: Sequence[int], now: ExposureSettings, limits: ExposureLimits
) -> ExposureSettings:
    """The settings for the next exposure.

    Args:
        counts: of DN in equal bins of the full scale, from frames exposed with `now`.
        now: what they were exposed with.
        limits: what is allowed.

    Returns:
        `now` itself where it is well, or nothing is known; else settings within the limits.

    Example:
        All pixels lie at 30 % of the full scale, the target is 60 %: twice the time.

        >>> limits = ExposureLimits(100.0, 5000.0, 0.0, tdi_shifts_max=0, rows_per_s=10.0)
        >>> counts = [0] * 100
        >>> counts[29] = 1000
        >>> now = ExposureSettings(exposure_time_us=1000.0)
        >>> next_settings(counts, now, limits).exposure_time_us
        2000.0
    """
    factor = light_factor(counts, limits)
    is_unchanged = smear_px(now, limits) <= limits.smear_px + 1e-9
    if abs(math.log(factor)) <= math.log1p(limits.deadband) and is_unchanged:
        return now
    return settings_for(now.light * factor, now, limits)


def light_factor(counts: Sequence[int], limits: ExposureLimits) -> float:
    """Factor on light that brings the 99th percentile to the target.

    Args:
        counts: of DN in equal bins of the full scale, dark first.
        limits: `target` and `black` are used.

    Returns:
        Within 1 / `MAX_STEP_FACTOR` and `MAX_STEP_FACTOR`; 1 for no counts, `SATURATED_STEP` where
        more than a hundredth is in the last bin.

    Example:
        The 99th percentile is 0.5, the target 0.6.

        >>> limits = ExposureLimits(100.0, 5000.0, 0.0, tdi_shifts_max=0, rows_per_s=None)
        >>> round(light_factor([0, 99, 1, 0], limits), 6)
        1.2
        >>> light_factor([0, 0, 0, 100], limits)
        0.5
    """
    total = sum(counts)
    if total == 0:
        return 1.0
    if counts[-1] > (1.0 - BRIGHT_SHARE) * total:
        return SATURATED_STEP
    seen, level = 0, 0.0
    for index, count in enumerate(counts):
        if seen + count >= BRIGHT_SHARE * total:
            level = (index + (BRIGHT_SHARE * total - seen) / count) / len(counts)
            break
        seen += count
    signal = max(level - limits.black, 1e-6)
    factor = (limits.target - limits.black) / signal
    return min(max(factor, 1.0 / MAX_STEP_FACTOR), MAX_STEP_FACTOR)


def settings_for(light: float, now: ExposureSettings, limits: ExposureLimits) -> ExposureSettings:
    """The settings that give an amount of light, or as much of it as the limits allow.

    Args:
        light: exposure time in us times the linear gain, as of `ExposureSettings.light`.
        now: the settings in use; without a known speed the exposure time is not made longer.
        limits: what is allowed.

    Returns:
        Exposure time first, TDI shifts that follow the motion, gain for the rest.

    Example:
        The time ends at 1000 us; the factor of 2 that is missing is 6.02 dB.

        >>> limits = ExposureLimits(100.0, 1000.0, 12.0, tdi_shifts_max=0, rows_per_s=10.0)
        >>> settings_for(2000.0, ExposureSettings(500.0), limits)
        ExposureSettings(exposure_time_us=1000.0, gain_db=6.02, tdi_shifts=0)
    """
    longest_us = min(limits.exposure_time_max_us, _max_sharp_time_us(now, limits))
    time_us = min(max(light, limits.exposure_time_min_us), longest_us)
    tdi_shifts = _tdi_shifts(time_us, longest_us, now, limits)
    time_us = _time_for_shifts_us(time_us, tdi_shifts, limits)
    gain_db = 20 * math.log10(max(light / time_us, 1.0))
    return ExposureSettings(
        exposure_time_us=round(time_us, 1),
        gain_db=round(min(gain_db, limits.gain_max_db), 2),
        tdi_shifts=tdi_shifts,
    )


def smear_px(settings: ExposureSettings, limits: ExposureLimits) -> float:
    """Motion that TDI leaves during an exposure.

    Args:
        settings: exposure time and TDI shifts are used.
        limits: `rows_per_s` and `crab_rad` are used.

    Returns:
        The larger of the motions along and across, px; 0 where the speed is not known.

    Example:
        1000 rows/s for 5.2 ms are 5.2 px; 5 shifts leave 0.2.

        >>> limits = ExposureLimits(100.0, 9000.0, 0.0, tdi_shifts_max=50, rows_per_s=1000.0)
        >>> round(smear_px(ExposureSettings(5200.0, tdi_shifts=5), limits), 6)
        0.2
    """
    if limits.rows_per_s is None:
        return 0.0
    moved_px = limits.rows_per_s * settings.exposure_time_us * 1e-6
    along = abs(moved_px * math.cos(limits.crab_rad) - settings.tdi_shifts)
    return max(along, moved_px * abs(math.sin(limits.crab_rad)))


def _max_sharp_time_us(now: ExposureSettings, limits: ExposureLimits) -> float:
    if limits.rows_per_s is None:
        return now.exposure_time_us
    along_px = limits.tdi_shifts_max + limits.smear_px
    across_px = limits.smear_px / max(abs(math.sin(limits.crab_rad)), 1e-9)
    return min(along_px / math.cos(limits.crab_rad), across_px) / limits.rows_per_s * 1e6


def _tdi_shifts(
    time_us: float, longest_us: float, now: ExposureSettings, limits: ExposureLimits
) -> int:
    """The whole number of rows moved, unless so many would ask for more time than there is."""
    if limits.rows_per_s is None:
        return now.tdi_shifts
    rows_per_us = limits.rows_per_s * 1e-6 * math.cos(limits.crab_rad)
    shifts = min(round(time_us * rows_per_us), limits.tdi_shifts_max)
    return shifts if shifts - limits.smear_px <= longest_us * rows_per_us else shifts - 1


def _time_for_shifts_us(time_us: float, tdi_shifts: int, limits: ExposureLimits) -> float:
    """The time nearest to this at which so many shifts leave no more motion than is allowed."""
    if limits.rows_per_s is None:
        return time_us
    along_per_us = limits.rows_per_s * 1e-6 * math.cos(limits.crab_rad)
    least_us = (tdi_shifts - limits.smear_px) / along_per_us
    most_us = (tdi_shifts + limits.smear_px) / along_per_us
    return min(max(time_us, least_us, limits.exposure_time_min_us), most_us)


def sampled_histogram(frame: NDArray[Any], bits: int) -> tuple[int, ...]:
    """Counts of DN in BINS equal bins of the converter's range.

    Args:
        frame: (h, w) uint16.
        bits: how many of the 16 bits count, from below: all where DN are left-justified.

    Returns:
        BINS counts; the last holds what is saturated or within a 64th of it.

    Example:
        2048 of 12 bits is half of the range: bin 32 of 64.

        >>> counts = sampled_histogram(np.full((16, 16), 2048, np.uint16), 12)
        >>> counts.index(4), sum(counts)
        (32, 4)
    """
    sample = np.ascontiguousarray(frame[EVERY // 2 :: EVERY, EVERY // 2 :: EVERY])
    bits_below = bits + 1 - BINS.bit_length()
    # In words of 16 bits where none is lost: a third of the time.
    bins = sample >> bits_below if bits_below >= 0 else sample.astype(np.int64) << -bits_below
    counts = np.bincount(np.minimum(bins, BINS - 1).ravel(), minlength=BINS)
    return tuple(counts.tolist())
