"""Robust weights of observations: Huber, Cauchy, Tukey and the Danish method.

Weights are only a way to find blunders: what ends with a large residual is left out, and the
adjustment that follows is by least squares.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from processing.bundle.data_snooping import Excluded, nothing_excluded
from processing.bundle.equation_rows import Equations
from processing.bundle.gauss_newton import Run, front, robust_step
from processing.bundle.network import Network
from processing.bundle.step_control import Damping

Array = NDArray[np.float64]
WeightFunction = Literal["huber", "cauchy", "tukey", "danish"]

HUBER: Final = 2.0
"""Limit of full weight in standard deviations; 1 to 2 in practice. Source: Huber (1981)."""

CAUCHY: Final = 2.3849
"""Efficiency of 95 % on normal errors. Source: Holland and Welsch (1977)."""

TUKEY: Final = 4.6851
"""Efficiency of 95 % on normal errors. Source: Holland and Welsch (1977)."""

DANISH: Final = (3.0, 0.05, 3.0)
"""Limit of full weight, factor and power of the exponent. Source: Krarup et al. (1980)."""

LEFT_OUT_BEYOND: Final = {"huber": 8.0, "cauchy": 4.0, "tukey": 4.0, "danish": 4.0}
"""Sizes beyond which an observation is left out. With Huber's weights blunders still pull: 8 is
weight 1/4. The others take next to no part there, and normal errors exceed 4 once in 10 million."""

_LEAST: Final = 1e-4
_MIN_OF_KIND: Final = 10
_MEDIAN_OF_TWO: Final = 0.8326
"""Median of the root mean square of two normal errors of sigma 1: sqrt(ln 2)."""

_MEDIAN_OF_ONE: Final = 0.6745
_KINDS: Final = ((2, 3), (4, 5), (6,), (7,))


def weight_of(function: WeightFunction, size: Array) -> Array:
    """Weight factors by size of a residual.

    Args:
        function: name of the weight function.
        size: absolute residuals over their standard deviation, any shape.

    Returns:
        Factors between 0 and 1 on the weights, same shape.

    Source: Huber (1981); Holland and Welsch (1977); Krarup et al. (1980).

    Example:
        >>> for name in ("huber", "cauchy", "tukey", "danish"):
        ...     print(name, weight_of(name, np.array([0.0, 4.0, 8.0])).round(4).tolist())
        huber [1.0, 0.5, 0.25]
        cauchy [1.0, 0.2623, 0.0816]
        tukey [1.0, 0.0735, 0.0]
        danish [1.0, 0.0408, 0.0]
    """
    if function == "huber":
        return np.asarray(np.minimum(1.0, HUBER / np.maximum(size, 1e-9)))
    if function == "cauchy":
        return np.asarray(1.0 / (1.0 + (size / CAUCHY) ** 2))
    if function == "tukey":
        return np.asarray(np.clip(1.0 - (size / TUKEY) ** 2, 0.0, None) ** 2)
    limit, factor, power = DANISH
    return np.where(size < limit, 1.0, np.exp(-factor * np.minimum(size, 50.0) ** power))


def robust_exclusions(run: Run, function: WeightFunction) -> Excluded:
    """Iterate with robust weights and choose what is left out.

    Functions that end at weight zero begin with Huber's, which need no good starting values.

    Args:
        run: variables of the adjustment; its state is changed.
        function: name of the weight function.

    Returns:
        Observations whose residuals are beyond the function's limit in the end.

    Raises:
        NetworkError: an object point behind a camera that saw it.
        RankDefectError: directions without information.
    """
    plain = run.network
    taken = run.weight
    sizes = _iterate(run, plain, "huber", taken)
    if function != "huber":
        sizes = _iterate(run, plain, function, taken)
    run.network, run.weight = plain, taken
    beyond = LEFT_OUT_BEYOND[function]
    return Excluded(*(size > beyond for size in sizes))


def _iterate(run: Run, plain: Network, function: WeightFunction, taken: Array) -> tuple[Array, ...]:
    """Renew weights at every iteration until they stay; sizes of all residuals by table."""
    sizes: tuple[Array, ...] = ()
    damping = Damping()
    for iteration in range(run.max_iterations):
        rows = front(run, run.state)
        objective = float(rows.misclosure @ rows.misclosure)
        run.report_progress("robust iteration", iteration, objective)
        step = robust_step(run, rows, damping)
        unweighted = replace(run, network=plain, weight=taken)
        sizes = _sizes(plain, unweighted.rows(run.state, derivatives=False))
        weights = [np.maximum(weight_of(function, size), _LEAST) for size in sizes]
        before = run.weight
        run.weight = np.where(taken > 0.0, weights[0], 0.0)
        run.network = _weighted(plain, weights)
        changed = float(np.abs(run.weight - before).max(initial=0.0))
        if changed < 1e-2 and step.predicted_decrease < 1e-6 * objective:
            break
    return sizes


def _sizes(network: Network, rows: Equations) -> tuple[Array, ...]:
    """Residuals over the scale of their kind: whole image points, others by coordinate."""
    table = nothing_excluded(network)
    image = np.zeros(len(table.image))
    own = rows.group < 2
    np.add.at(image, rows.source[own], rows.misclosure[own] ** 2)
    image = np.sqrt(image / 2.0)
    unit = _scale(image[image > 0.0], _MEDIAN_OF_TWO)
    found = [image / max(unit, 1e-12)]
    for flags, groups in zip(
        (table.control, table.gnss, table.attitude, table.distance), _KINDS, strict=True
    ):
        size = np.zeros(flags.shape)
        own = np.isin(rows.group, groups)
        size[rows.source[own], rows.axis[own]] = np.abs(rows.misclosure[own])
        several = size[size > 0.0]
        spread = _scale(several, _MEDIAN_OF_ONE) if len(several) >= _MIN_OF_KIND else 0.0
        found.append(size / max(spread, unit, 1e-12))
    return tuple(found)


def _scale(size: Array, median_of_normal: float) -> float:
    return float(np.median(size)) / median_of_normal if size.size else 1.0


def _weighted(network: Network, weights: list[Array]) -> Network:
    """The network with the sigmas of everything but image points divided by root weights."""
    _, control, gnss, attitude, distance = (1.0 / np.sqrt(w) for w in weights)
    attitudes, distances = network.measured_attitudes, network.distances
    return replace(
        network,
        points=replace(network.points, sigma_m=network.points.sigma_m * control),
        gnss=replace(network.gnss, sigma_m=network.gnss.sigma_m * gnss),
        measured_attitudes=replace(attitudes, sigma_rad=attitudes.sigma_rad * attitude),
        distances=replace(distances, sigma_m=distances.sigma_m * distance[:, 0]),
    )
