"""Sets of frames taken in one condition, reduced to maps while they are read.

No file is opened here. Frames come one after another, and only sums are stored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float32]


@dataclass(frozen=True)
class SeriesCondition:
    """How the frames of a set were taken.

    `monitor` is the mean of the light's monitor (any unit, one for a whole series; 0: dark),
    `temperature_c` the mean of the sensor's probe.
    """

    name: str
    light: Literal["dark", "flat"]
    exposure_time_s: float
    f_number: float
    tdi_shifts: int
    temperature_c: float
    monitor: float


@dataclass(frozen=True)
class FrameSet:
    """A set of `count` frames: mean and temporal variance of every pixel, DN and DN squared.

    Frames are brought to their common mean level before, so that a lamp that drifts does not count
    as noise. `temperatures_c` (count,) are those of the single frames; `clipped`
    (height, width) marks pixels that reached full scale in any frame.
    """

    condition: SeriesCondition
    count: int
    mean: Map
    variance: Map
    temperatures_c: tuple[float, ...]
    clipped: NDArray[np.bool_]

    @property
    def noise_dn2(self) -> float:
        """Temporal variance of a typical pixel: robust against defects."""
        good = self.variance[~self.clipped]
        return float(_trimmed_mean(good)) if good.size else 0.0


def _trimmed_mean(values: NDArray[Any]) -> float:
    low, high = np.percentile(values, [0.0, 99.5])
    trimmed = values[(values >= low) & (values <= high)]
    return float(trimmed.mean(dtype=np.float64))


@dataclass
class FrameAccumulator:
    """Sums the frames of a set; `result` returns the set."""

    condition: SeriesCondition
    black_dn: float
    full_scale_dn: int
    _levels: list[float] = field(default_factory=list)
    _temperatures: list[float] = field(default_factory=list)
    _first: Map = field(default_factory=lambda: np.zeros(0, np.float32))
    _sum: Map = field(default_factory=lambda: np.zeros(0, np.float32))
    _squares: Map = field(default_factory=lambda: np.zeros(0, np.float32))
    _clipped: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))

    def add(self, raw: NDArray[np.uint16], *, temperature_c: float) -> None:
        """Take one frame.

        Args:
            raw: shape (height, width), DN.
            temperature_c: of the sensor.
        """
        values = raw.astype(np.float32) - np.float32(self.black_dn)
        level = float(values.mean(dtype=np.float64)) if self.condition.light == "flat" else 1.0
        if not self._levels:
            self._first = values
            self._sum, self._squares = np.zeros_like(values), np.zeros_like(values)
            self._clipped = raw >= self.full_scale_dn
        else:
            # About the first frame: sums of small numbers keep their digits.
            difference = values * np.float32(self._levels[0] / max(level, 1e-3)) - self._first
            self._sum += difference
            self._squares += difference * difference
            self._clipped |= raw >= self.full_scale_dn
        self._levels.append(level)
        self._temperatures.append(temperature_c)

    def result(self) -> FrameSet:
        """The set of the frames taken so far.

        Returns:
            Mean, temporal variance, temperatures and clipped pixels.

        Raises:
            ValueError: fewer than two frames; one has no temporal variance.
        """
        count = len(self._levels)
        if count < 2:
            raise ValueError(f"set {self.condition.name} has {count} frame; two or more are needed")
        mean = self._sum / np.float32(count)
        variance = (self._squares - self._sum * mean) / np.float32(count - 1)
        to_mean = np.float32(np.mean(self._levels) / max(self._levels[0], 1e-3))
        return FrameSet(
            self.condition,
            count,
            np.asarray((self._first + mean) * to_mean + np.float32(self.black_dn), np.float32),
            np.asarray(np.maximum(variance, 0.0) * to_mean**2, np.float32),
            tuple(self._temperatures),
            self._clipped,
        )


def select_light(sets: Sequence[FrameSet], light: str) -> list[FrameSet]:
    """The sets taken in one kind of light.

    Args:
        sets: to choose from.
        light: `dark` or `flat` (before the light).

    Returns:
        The sets in their order.
    """
    return [s for s in sets if s.condition.light == light]
