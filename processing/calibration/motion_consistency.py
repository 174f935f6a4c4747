"""Velocities and rates of a trajectory against its own positions and attitudes.

Delays of heads are multiplied by velocities and rates: in another unit, with another sign, in other
axes or of another exposure they make wrong delays with small residuals.

Source: docs/explanation/mathematics/boresight.md#delays-of-heads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.calibration.boresight import InertialOrientations
from processing.geometry.rotation import vectors_from_rotations

Array = NDArray[np.float64]

_LONGEST_S: Final = 9.0
_LARGEST_RAD: Final = 1.2
_MIN_INTERVALS: Final = 5
_SCALE_LIMIT: Final = 0.25
_VELOCITY_MISFIT: Final = 0.15
_RATE_MISFIT: Final = 0.7
_STEADY: Final = 0.9
"""Turns that change by more from pair to pair are swings faster than the exposures: not shown."""
_NOISE_RATIO: Final = 5.0
"""Turns smaller than this multiple of the attitudes' standard deviation show nothing of rates."""


@dataclass(frozen=True)
class MotionConsistency:
    """What positions and attitudes of neighbouring exposures show of velocities and rates.

    `scale` is that of observed over predicted changes, one where units and signs are right;
    `misfit` the root mean square of the differences over that of the changes. NaN: not known.
    """

    intervals: int
    velocity_scale: float
    velocity_misfit: float
    rate_scale: float
    rate_misfit: float

    @property
    def problems(self) -> tuple[str, ...]:
        """One sentence for velocities and one for rates, where they do not fit."""
        found = []
        for what, of, scale, misfit, limit in (
            ("velocities", "positions", self.velocity_scale, self.velocity_misfit,
             _VELOCITY_MISFIT),
            ("rates", "attitudes", self.rate_scale, self.rate_misfit, _RATE_MISFIT),
        ):  # fmt: skip
            if abs(scale - 1.0) > _SCALE_LIMIT or misfit > limit:
                found.append(
                    f"{what} do not fit the {of} of {self.intervals} pairs of neighbouring "
                    f"exposures (scale {scale:.2f}, misfit {misfit:.0%}): check their unit, sign, "
                    "axes and order"
                )
        return tuple(found)


def motion_consistency(inertial: InertialOrientations) -> MotionConsistency:
    """Compare changes between neighbouring exposures with velocities and rates.

    Args:
        inertial: with instants; pairs more than 9 s or 1.2 rad apart are left out.

    Returns:
        Scales and misfits, NaN with fewer than five pairs or, for rates, without steady turns.

    Raises:
        ValueError: instants are not given.
    """
    if inertial.time_s is None:
        raise ValueError("velocities and rates are compared with positions by the instants")
    order = np.argsort(inertial.time_s)
    first, second = order[:-1], order[1:]
    step = inertial.time_s[second] - inertial.time_s[first]
    turned = vectors_from_rotations(
        np.einsum("nji,njk->nik", inertial.rotation[first], inertial.rotation[second])
    )
    near = (step > 0.0) & (step <= _LONGEST_S)
    near &= np.linalg.norm(turned, axis=1) <= _LARGEST_RAD
    first, second, step, turned = first[near], second[near], step[near, None], turned[near]
    count = len(first)
    if count < _MIN_INTERVALS:
        return MotionConsistency(count, np.nan, np.nan, np.nan, np.nan)
    motion = inertial.motion
    velocity, rate = motion.velocity_mps, motion.rate_rad_per_s
    pull, change = motion.acceleration_mps2, motion.rate_change_rad_per_s2
    predicted = 0.5 * step * (velocity[first] + velocity[second])
    predicted += step**2 / 12.0 * (pull[first] - pull[second])
    moved = inertial.position_m[second] - inertial.position_m[first]
    turning = 0.5 * step * (rate[first] + rate[second])
    turning += step**2 / 12.0 * (change[first] - change[second])
    noise = float(np.sqrt(2.0) * np.max(inertial.attitude_sigma_rad))
    size = float(np.sqrt(np.mean(turned**2)))
    jumps = float(np.sqrt(np.mean(np.diff(turned, axis=0) ** 2)))
    shows = size > _NOISE_RATIO * noise and jumps < _STEADY * size
    rates = _fit(turning, turned) if shows else (np.nan, np.nan)
    return MotionConsistency(count, *_fit(predicted, moved), *rates)


def _fit(predicted: Array, observed: Array) -> tuple[float, float]:
    squares = float(np.sum(predicted**2))
    scale = float(np.sum(predicted * observed)) / squares if squares > 0.0 else np.inf
    misfit = np.sqrt(np.sum((observed - predicted) ** 2) / max(float(np.sum(observed**2)), 1e-300))
    return scale, float(misfit)
