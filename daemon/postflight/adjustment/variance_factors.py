"""Kinds of observations whose residuals do not fit their a priori standard deviations."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from scipy.special import chdtri

from daemon.postflight.adjustment.reliability_report import unit_of
from processing.bundle.adjust import Adjustment

_SIGNIFICANCE: Final = 0.001
"""Over all kinds."""

_MIN_REDUNDANCY: Final = 1.0
_MIN_RATIO: Final = 1.1
"""Of the sigma that fits and the given one: less is of no consequence."""

_OF_OBSERVATIONS: Final = 8
"""Kinds of observations; the rest are prior values."""

_FINEST_GNSS_M: Final = 1e-4


def variance_factor_cautions(result: Adjustment) -> list[str]:
    """Name the kinds of observations whose variance factor is outside its interval.

    Kinds whose sigmas variance components have changed already take no part.

    Args:
        result: the adjustment.

    Returns:
        A sentence for each, with the sigma that would fit.

    Source: docs/explanation/mathematics/bundle.md#adjustment.
    """
    rows = result.equations
    names = rows.groups[:_OF_OBSERVATIONS]
    tested = [
        group
        for group in result.groups
        if group.name in names
        and group.redundancy >= _MIN_REDUNDANCY
        and math.isfinite(group.factor)
        and group.name not in result.factors
    ]
    found = []
    for group in tested:
        tail = _SIGNIFICANCE / len(tested) / 2.0
        limits = np.asarray(chdtri(group.redundancy, [1.0 - tail, tail]))
        low, high = (limits / group.redundancy).tolist()
        ratio = math.sqrt(group.factor)
        if low <= group.factor <= high or 1.0 / _MIN_RATIO < ratio < _MIN_RATIO:
            continue
        unit, scale = unit_of(group.name)
        given = float(np.median(rows.sigma[rows.group == rows.groups.index(group.name)])) * scale
        small = group.factor < low
        found.append(
            f"{group.name}: the variance factor is {group.factor:.3g}, outside {low:.3g} to "
            f"{high:.3g}: residuals are {'smaller' if small else 'larger'} than the sigma of "
            f"{given:.4g} {unit} states, {ratio * given:.3g} {unit} would fit. Is the sigma "
            + ("of another unit?" if small else "too small, or has this kind a systematic error?")
        )
    return found


def fine_positions(result: Adjustment) -> list[str]:
    """Name antenna positions whose sigma no receiver reaches; residuals cannot show it.

    Args:
        result: the adjustment.

    Returns:
        A sentence, or nothing.
    """
    sigma = result.network.gnss.sigma_m
    own = sigma[(sigma > 0.0) & (sigma < _FINEST_GNSS_M)]
    if not own.size:
        return []
    return [
        f"{own.size} standard deviations of antenna positions are below {_FINEST_GNSS_M:g} m, the "
        f"smallest {own.min():.3g} m: receivers reach millimetres, and the positions are as good "
        "as held. Is the sigma of another unit?"
    ]
