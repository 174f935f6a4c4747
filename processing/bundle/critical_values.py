"""Critical values of data snooping for the number of tests of an adjustment.

Baarda's test divides a residual by its standard deviation from the a priori sigmas, Pope's by the
one from the a posteriori sigma0. The significance is that of the whole block: the probability that
a block without blunders loses any observation.
"""

from __future__ import annotations

import math
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from processing.bundle.equation_rows import Equations
from processing.bundle.normal_equations import ReducedEquations

Array = NDArray[np.float64]
TestName = Literal["pope", "baarda"]

MIN_REDUNDANCY: Final = 0.01
"""Redundancy number below which an observation is not controlled by the others."""

SINGLE_SIGNIFICANCE: Final = 0.001
"""Of one test where no data snooping is requested. Source: Baarda (1968)."""

_SAME_TEST: Final = 0.98
"""Correlation of two residuals beyond which their tests are one."""

_PART_ENTRIES: Final = 4_000_000


def single_significance(significance: float, tests: int) -> float:
    """Significance of one of several independent tests.

    Args:
        significance: of all tests together, between 0 and 1.
        tests: their number, at least 1.

    Returns:
        1 - (1 - significance)^(1 / tests).

    Raises:
        ValueError: a significance outside (0, 1), or no test.

    Source: Sidak (1967).

    Example:
        >>> f"{single_significance(0.05, 1000):.4e}"
        '5.1292e-05'
    """
    if not 0.0 < significance < 1.0 or tests < 1:
        raise ValueError(f"significance {significance} of {tests} tests; it is between 0 and 1")
    return -math.expm1(math.log1p(-significance) / tests)


def critical_value(test: TestName, significance: float, tests: int, redundancy: int) -> float:
    """Limit of a standardised residual.

    Args:
        test: `baarda`, normal distribution; `pope`, tau distribution.
        significance: of all tests together, between 0 and 1.
        tests: number of distinct tests, at least 1.
        redundancy: of the adjustment; the tau distribution needs 2 or more.

    Returns:
        The limit; infinity where the redundancy is too small for a test.

    Source: Baarda (1968); Pope (1976), the tau distribution from Student's:
    tau = t sqrt(f) / sqrt(f - 1 + t^2) with f - 1 degrees of freedom.

    Example:
        >>> f"{critical_value('baarda', 0.001, 1, 100):.4f}"
        '3.2905'
        >>> f"{critical_value('pope', 0.05, 1, 10):.4f}"
        '1.9039'
    """
    single = single_significance(significance, tests)
    if test == "baarda":
        return -float(ndtri(single / 2.0))
    if redundancy < 2:
        return math.inf
    t = -float(stdtrit(redundancy - 1, single / 2.0))
    return t * math.sqrt(redundancy) / math.sqrt(redundancy - 1 + t * t)


def number_of_tests(rows: Equations, reduced: ReducedEquations, redundancy_number: Array) -> int:
    """Number of distinct tests of an adjustment.

    Residuals of one object point that are proportional to each other have the same test: both
    coordinates across the base of a point of two rays, the three along it of three rays in a strip.

    Args:
        rows: observations as adjusted.
        reduced: their reduced equations.
        redundancy_number: of the rows, shape (m,).

    Returns:
        Testable rows, those with the same test counted once.

    Source: docs/explanation/mathematics/bundle.md#data-snooping.
    """
    testable = (redundancy_number > MIN_REDUNDANCY) & (rows.group < 8)
    single = int((testable & (rows.point < 0)).sum())
    of_points = np.flatnonzero(testable & (rows.point >= 0))
    of_points = of_points[np.argsort(rows.point[of_points], kind="stable")]
    _, first, count = np.unique(rows.point[of_points], return_index=True, return_counts=True)
    for width in np.unique(count):
        begin = first[count == width]
        step = max(1, _PART_ENTRIES // int(width) ** 2)
        for low in range(0, len(begin), step):
            at = of_points[begin[low : low + step, None] + np.arange(width)]
            single += _distinct(reduced.point_rows[at])
    return single


def _distinct(part: Array) -> int:
    """Rows whose residual is not proportional to an earlier one of its point, (points, n, 3)."""
    width = part.shape[1]
    cofactor = np.eye(width) - np.einsum("pik,pjk->pij", part, part)
    spread = np.sqrt(np.clip(np.einsum("pii->pi", cofactor), 1e-12, None))
    correlation = np.abs(cofactor) / spread[:, :, None] / spread[:, None, :]
    earlier = np.tril(correlation > _SAME_TEST, -1).any(axis=2)
    return int((~earlier).sum())
