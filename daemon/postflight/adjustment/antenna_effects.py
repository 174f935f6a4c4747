"""Systematic errors of antenna positions that would explain a sigma0 beyond its limit.

A shift, a lever arm and a time offset are estimated from the equations of the adjustment without
them. Those with which sigma0 is inside of its limits are named.

Source: docs/explanation/mathematics/bundle.md#added-parameters.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from processing.bundle.adjust import Adjustment
from processing.bundle.block_adjustment import added_parameters

Array = NDArray[np.float64]

_MIN_POSITIONS: Final = 4
_LIMIT: Final = 0.995
_REVERSED_WITHIN: Final = 0.2
"""Share of twice the given lever arm within which the found one is its reversal."""


def antenna_effects(result: Adjustment) -> list[str]:
    """Name what would explain antenna positions that contradict the other observations.

    Args:
        result: an adjustment whose sigma0 is above its limit.

    Returns:
        One sentence, or none.
    """
    given = result.network.gnss
    n = len(given.station)
    if n < _MIN_POSITIONS:
        return []
    rotation = result.state.attitude[given.attitude]
    found = []
    for kind, derivatives in (
        ("shift", np.tile(np.eye(3), (n, 1, 1))),
        ("lever", rotation),
        ("time", _velocity(result)[:, :, None]),
    ):
        count = derivatives.shape[2]
        if result.redundancy <= count or not derivatives.any():
            continue
        added = added_parameters(
            result, derivatives, np.zeros((n, 3, count)), np.full(count, np.inf)
        )
        if not np.isfinite(added.value).all() or not np.isfinite(added.covariance).all():
            continue
        unit = max(1.0, result.sigma0)
        less = unit**2 * float(added.value @ np.linalg.solve(added.covariance, added.value))
        redundancy = result.redundancy - count
        sigma0 = math.sqrt(max(result.sigma0**2 * result.redundancy - less, 0.0) / redundancy)
        if sigma0 <= math.sqrt(chdtri(redundancy, 1.0 - _LIMIT) / redundancy):
            found.append((sigma0, _named(kind, added.value, given.lever_m)))
    if not found:
        return []
    found.sort()
    return [
        "antenna positions contradict the other observations; what would explain it: "
        + ", or ".join(f"{named} (sigma0 is then {sigma0:.4g})" for sigma0, named in found)
    ]


def _named(kind: str, value: Array, lever_m: Array) -> str:
    if kind == "time":
        return f"positions of an instant {value[0] * 1e3:+.3g} ms from that of the exposure"
    listed = ", ".join(f"{v:+.3g}" for v in value)
    if kind == "shift":
        return (
            f"a common shift of {listed} m in X, Y, Z: another height system or datum than that of "
            "the control"
        )
    mean = lever_m.mean(axis=0)
    length = float(np.linalg.norm(mean))
    if length > 0.0 and np.linalg.norm(value + 2.0 * mean) < _REVERSED_WITHIN * 2.0 * length:
        return f"a lever arm of the other sign (it is off by {listed} m in the rig's x, y, z)"
    return f"a lever arm that is off by {listed} m in the rig's x, y, z"


def _velocity(result: Adjustment) -> Array:
    """Of the antenna along each line, m/s (n, 3), by neighbours in time; 0 where not known."""
    given = result.network.gnss
    velocity = np.zeros_like(given.position_m)
    for line in np.unique(given.line[given.line >= 0]):
        own = np.flatnonzero(given.line == line)
        own = own[np.argsort(given.time_s[own])]
        if len(own) > 1 and (np.diff(given.time_s[own]) > 0.0).all():
            velocity[own] = np.gradient(given.position_m[own], given.time_s[own], axis=0)
    return velocity
