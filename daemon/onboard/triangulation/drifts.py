"""Drifts against the calibration: mounting, time offset, attitude and principal distance.

Some are functions of time or temperature over the flight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.adjust import Adjustment
from processing.bundle.block_adjustment import AdjustedMounting, added_parameters
from processing.bundle.flown_network import MountingPrior
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
MIN_TEMPERATURE_SPAN_K: Final = 5.0
"""Below it no effect of temperature is estimated."""
MIN_HEIGHTS_SHARE: Final = 0.15
"""Difference of flying heights above ground, over their mean, that counts as two heights."""
_UNDETERMINED_SHARE: Final = 0.9
"""A sigma above this share of the calibration's: the flight does not determine the quantity."""


@dataclass(frozen=True)
class Drift:
    """One quantity: correction to the calibration, its standard deviation, and whether the flight
    determines it. `calibration_sigma` is that of the calibration, 0 where there is none, and
    `share` what the block leaves of it."""

    name: str
    unit: str
    value: float | None
    sigma: float | None
    is_determined: bool
    calibration_sigma: float = 0.0
    share: float = 1.0

    @property
    def significance(self) -> float:
        """The value over the standard deviation that a right calibration gives it."""
        if self.value is None or not self.sigma or not self.is_determined:
            return 0.0
        if not self.calibration_sigma:
            return abs(self.value) / self.sigma
        # An estimate with the calibration as an observation varies by what the images add.
        unit = self.sigma / (self.share * self.calibration_sigma)
        expected = unit * self.calibration_sigma * math.sqrt(max(1.0 - self.share**2, 1e-12))
        return abs(self.value) / expected

    def as_json(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "unit": self.unit,
            "value": self.value,
            "sigma": self.sigma,
            "determined": self.is_determined,
        }


@dataclass(frozen=True)
class DriftInputs:
    """What drifts over n exposures are derived from.

    Attributes:
        result: the adjustment; its station k is the k-th exposure here.
        mounting: None where several heads have mountings of their own.
        prior: of the mounting.
        time_s: (n,) since any fixed instant.
        velocity_mps: (n, 3) in the object system, NaN if unknown.
        temperature_c: (n,) of the camera, NaN if unknown.
        above_m: (n,) heights above ground.
    """

    result: Adjustment
    mounting: AdjustedMounting | None
    prior: MountingPrior
    time_s: Array
    velocity_mps: Array
    temperature_c: Array
    above_m: Array


def drifts_of(given: DriftInputs) -> tuple[Drift, ...]:
    """Corrections of the mounting, and what depends on time, temperature and velocity."""
    found: list[Drift] = []
    if given.mounting is not None:
        priors = np.repeat([given.prior.boresight_sigma_rad, given.prior.lever_arm_sigma_m], 3)
        for k, (name, unit, factor) in enumerate(MOUNTING):
            share = float(given.mounting.share_of_prior[k])
            determined = share < _UNDETERMINED_SHARE
            value, sigma = float(given.mounting.correction[k]), float(given.mounting.sigma[k])
            prior = float(priors[k]) * factor
            found.append(
                Drift(name, unit, value * factor, sigma * factor, determined, prior, share)
            )
    return (*found, *_added(given))


def live_drifts(live: LiveTriangulation) -> tuple[Drift, ...]:
    """Those of the last adjustment of the block in flight; none before the first."""
    if live.last is None:
        return ()
    images = [live.images[k] for k in live.last_images]
    return drifts_of(
        DriftInputs(
            live.last.result,
            live.last.mounting,
            live.settings.prior,
            np.array([one.time_s for one in images]),
            np.array([one.velocity_mps for one in images]),
            np.array([one.temperature_c for one in images]),
            np.array([one.position_m[2] for one in images]) - live.block.ground_m,
        )
    )


def _added(given: DriftInputs) -> tuple[Drift, ...]:
    """Parameters that the adjustment has no unknowns for.

    Time offset and attitude per hour are estimated together; each of the others with them, for it
    may be nearly one of them (a time offset that grows is a pitch that grows, in straight lines).
    """
    n = len(given.time_s)
    since_h = (given.time_s - given.time_s.mean()) / 3600.0
    velocity = given.velocity_mps if np.isfinite(given.velocity_mps).all() else np.zeros((n, 3))
    common = [_Effect("time offset", "ms", 1e3, position=velocity)]
    common += [
        _Effect(f"attitude about the camera's {name} per hour", "mdeg/h", math.degrees(1e3),
                attitude=since_h[:, None] * np.eye(3)[axis])
        for axis, name in enumerate(DRIFTS)
    ]  # fmt: skip
    growing = _Effect("time offset per hour", "ms/h", 1e3, position=velocity * since_h[:, None])
    found = [*_estimated(given, common), *_estimated(given, [growing, *common])[:1]]
    warmer_k = given.temperature_c - given.temperature_c.mean()
    if np.isfinite(warmer_k).all() and np.ptp(warmer_k) >= MIN_TEMPERATURE_SPAN_K:
        effects = [
            _Effect(f"boresight about the camera's {name} per K", "mdeg/K", math.degrees(1e3),
                    attitude=warmer_k[:, None] * np.eye(3)[axis])
            for axis, name in enumerate(DRIFTS)
        ]  # fmt: skip
        found += _estimated(given, [*effects, *common])[: len(effects)]
    if np.ptp(given.above_m) >= MIN_HEIGHTS_SHARE * np.mean(given.above_m):
        # From one height alone a longer principal distance is a higher flight.
        network = given.result.network
        table = network.image_points
        by_f = table.xy_mm / network.cameras[0].f_mm
        later = by_f * since_h[network.images.station[table.image]][:, None]
        effects = [
            _Effect("principal distance", "um", 1e3, image_mm=by_f),
            _Effect("principal distance per hour", "um/h", 1e3, image_mm=later),
        ]
        found += _estimated(given, [*effects, *common])[: len(effects)]
    return tuple(found)


def _estimated(given: DriftInputs, effects: Sequence[_Effect]) -> list[Drift]:
    n, points = len(given.time_s), len(given.result.network.image_points.image)
    done = added_parameters(
        given.result,
        _columns([one.position for one in effects], (n, 3)),
        _columns([one.attitude for one in effects], (n, 3)),
        np.full(len(effects), np.inf),
        image_mm=_columns([one.image_mm for one in effects], (points, 2))
        if any(one.image_mm is not None for one in effects)
        else None,
    )
    result = []
    for k, one in enumerate(effects):
        sigma = float(done.sigma[k])
        if not math.isfinite(sigma) or not math.isfinite(done.value[k]):
            result.append(Drift(one.name, one.unit, None, None, is_determined=False))
        else:
            value = float(done.value[k]) * one.factor
            result.append(Drift(one.name, one.unit, value, sigma * one.factor, is_determined=True))
    return result


@dataclass(frozen=True)
class _Effect:
    """A parameter: derivatives of positions (n, 3), attitudes (n, 3) and image points (m, 2)."""

    name: str
    unit: str
    factor: float
    position: Array | None = None
    attitude: Array | None = None
    image_mm: Array | None = None


def _columns(parts: Sequence[Array | None], shape: tuple[int, int]) -> Array:
    return np.stack([np.zeros(shape) if one is None else one for one in parts], axis=-1)
