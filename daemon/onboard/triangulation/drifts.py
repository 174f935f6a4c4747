"""Drifts against the calibration: boresight, lever arm, time offset, attitude over the flight."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.block_adjustment import added_parameters
from processing.pipelines.live_triangulation import LiveTriangulation

Array = NDArray[np.float64]

MOUNTING: Final = (
    ("boresight about the camera's x", "mdeg", math.degrees(1.0) * 1e3),
    ("boresight about the camera's y", "mdeg", math.degrees(1.0) * 1e3),
    ("boresight about the camera's z", "mdeg", math.degrees(1.0) * 1e3),
    ("lever arm along the camera's x", "m", 1.0),
    ("lever arm along the camera's y", "m", 1.0),
    ("lever arm along the camera's z", "m", 1.0),
)
DRIFTS: Final = ("x", "y", "z")
_UNDETERMINED_SHARE: Final = 0.9
"""A sigma above this share of the calibration's: the flight does not determine the quantity."""


@dataclass(frozen=True)
class Drift:
    """One quantity: correction to the calibration, its standard deviation, and whether the flight
    determines it. `calibration_sigma` is that of the calibration, 0 where there is none."""

    name: str
    unit: str
    value: float | None
    sigma: float | None
    is_determined: bool
    calibration_sigma: float = 0.0

    @property
    def significance(self) -> float:
        """The value over the standard deviation that a right calibration gives it."""
        if self.value is None or not self.sigma or not self.is_determined:
            return 0.0
        if not self.calibration_sigma:
            return abs(self.value) / self.sigma
        # An estimate with the calibration as an observation varies by what the images add.
        expected = math.sqrt(max(self.calibration_sigma**2 - self.sigma**2, 1e-30))
        return abs(self.value) / expected

    def as_json(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "unit": self.unit,
            "value": self.value,
            "sigma": self.sigma,
            "determined": self.is_determined,
        }


def drifts_of(live: LiveTriangulation) -> tuple[Drift, ...]:
    """The quantities of the last adjustment of the block; none before the first."""
    if live.last is None:
        return ()
    found: list[Drift] = []
    mounting = live.last.mounting
    if mounting is not None:
        prior_of = live.settings.prior
        given = np.repeat([prior_of.boresight_sigma_rad, prior_of.lever_arm_sigma_m], 3)
        for k, (name, unit, factor) in enumerate(MOUNTING):
            determined = bool(mounting.share_of_prior[k] < _UNDETERMINED_SHARE)
            value, sigma = float(mounting.correction[k]), float(mounting.sigma[k])
            prior = float(given[k]) * factor
            found.append(Drift(name, unit, value * factor, sigma * factor, determined, prior))
    return (*found, *_added(live))


def _added(live: LiveTriangulation) -> tuple[Drift, ...]:
    assert live.last is not None
    images = [live.images[k] for k in live.last_images]
    n = len(images)
    velocity = np.array([one.velocity_mps for one in images])
    knows_velocity = bool(np.isfinite(velocity).all())
    since_h = np.array([one.time_s for one in images]) / 3600.0
    since_h = since_h - since_h.mean()
    position = np.zeros((n, 3, 4))
    attitude = np.zeros((n, 3, 4))
    position[:, :, 0] = velocity if knows_velocity else 0.0
    for axis in range(3):
        attitude[:, axis, 1 + axis] = since_h
    done = added_parameters(live.last.result, position, attitude, np.full(4, np.inf))
    names = (
        ("time offset", "ms", 1e3),
        *(
            (f"attitude about the camera's {a} per hour", "mdeg/h", math.degrees(1e3))
            for a in DRIFTS
        ),
    )
    result = []
    for k, (name, unit, factor) in enumerate(names):
        sigma = float(done.sigma[k])
        if not math.isfinite(sigma) or not math.isfinite(done.value[k]):
            result.append(Drift(name, unit, None, None, is_determined=False))
        else:
            value = float(done.value[k])
            result.append(Drift(name, unit, value * factor, sigma * factor, is_determined=True))
    return tuple(result)
