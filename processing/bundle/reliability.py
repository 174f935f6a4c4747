"""Reliability of an adjustment: what blunder a test finds, and what one that it misses changes.

Internal reliability is the minimal detectable bias of each observation, external reliability its
effect on the unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from processing.bundle.adjust import Adjustment
from processing.bundle.critical_values import MIN_REDUNDANCY, SINGLE_SIGNIFICANCE

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Reliability:
    """Reliability of every row of an adjustment.

    Attributes:
        limit: critical value of a standardised residual.
        power: probability with which a bias of the size below is found.
        noncentrality: expected standardised residual of such a bias.
        detectable: (m,) minimal detectable bias in the unit of the observation (mm, m, rad);
            infinite where the others do not control the observation.
        bias_to_noise: (m,) largest change of any function of the unknowns by it, over the
            function's standard deviation.
        point_shift_m: (m,) length of the change of the observation's own object point, m; NaN for
            observations of none.
    """

    limit: float
    power: float
    noncentrality: float
    detectable: Array
    bias_to_noise: Array
    point_shift_m: Array


def reliability_of(result: Adjustment) -> Reliability:
    """Minimal detectable bias and external reliability of every observation.

    Args:
        result: the adjustment; the limit is that of its data snooping, or that of a single test of
            significance 0.1 % without it.

    Returns:
        See `Reliability`. Sigmas are a posteriori, with Baarda's test a priori.

    Source: Baarda (1968); Förstner and Wrobel (2016), section 4.6;
    docs/explanation/mathematics/bundle.md#reliability.
    """
    settings = result.settings
    limit = result.reject_limit
    if limit is None:
        limit = -float(ndtri(SINGLE_SIGNIFICANCE / 2.0))
    noncentrality = limit + float(ndtri(settings.power))
    unit = 1.0 if settings.uses_a_priori_sigma else result.sigma0
    share = result.redundancy_number
    controlled = share > MIN_REDUNDANCY
    safe = np.where(controlled, share, 1.0)
    in_sigmas = np.where(controlled, noncentrality / np.sqrt(safe), np.inf)
    length = np.linalg.norm(result.influence, axis=1)
    with np.errstate(invalid="ignore"):
        ratio = np.where(controlled, noncentrality * np.sqrt((1.0 - safe) / safe), np.inf)
        shift = unit * np.where(length > 0.0, length * in_sigmas, 0.0)
    return Reliability(
        limit=limit,
        power=settings.power,
        noncentrality=noncentrality,
        detectable=unit * in_sigmas * result.equations.sigma,
        bias_to_noise=ratio,
        point_shift_m=np.where(result.equations.point >= 0, shift, np.nan),
    )
