"""Reliability of an adjustment as figures of the report and rows of tables."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.adjust import Adjustment
from processing.bundle.data_snooping import observation_name
from processing.bundle.reliability import Reliability, reliability_of

Array = NDArray[np.float64]

UNIT_OF_GROUP: Final = {
    "image x": ("um", 1e3),
    "image y": ("um", 1e3),
    "attitude": ("mrad", 1e3),
    "prior": ("", 1.0),
    "jitter": ("ms", 1e3),
    "pattern": ("sigma", 1.0),
}

OBSERVATION_COLUMNS: Final = (
    "observation", "kind", "residual", "unit", "redundancy", "standardised", "detectable",
    "bias_to_noise", "point_shift_m",
)  # fmt: skip


def unit_of(group: str) -> tuple[str, float]:
    """Unit of a kind of observation in reports, and how many of it are one of the network."""
    return UNIT_OF_GROUP.get(group, ("m", 1.0))


def reliability_summary(result: Adjustment) -> dict[str, Any]:
    """Critical value, and detectable bias and external reliability of every kind of observation."""
    found = reliability_of(result)
    settings = result.settings
    return {
        "test": settings.test,
        "limit": found.limit,
        "tests": result.tests,
        "significance": settings.significance,
        "power": found.power,
        "noncentrality": found.noncentrality,
        "groups": [
            _of_group(result, found, index, name)
            for index, name in enumerate(result.equations.groups[:8])
            if (result.equations.group == index).any()
        ],
    }


def _of_group(result: Adjustment, found: Reliability, index: int, name: str) -> dict[str, Any]:
    rows = result.equations
    own = np.flatnonzero(rows.group == index)
    controlled = own[np.isfinite(found.detectable[own])]
    unit, factor = unit_of(name)
    content: dict[str, Any] = {
        "name": name,
        "unit": unit,
        "count": len(own),
        "uncontrolled": len(own) - len(controlled),
        "mean_redundancy": float(result.redundancy_number[own].mean()),
        "detectable_median": None,
        "detectable_max": None,
        "bias_to_noise_max": None,
        "point_shift_max_m": None,
        "weakest": None,
    }
    if len(controlled):
        worst = int(controlled[np.argmax(found.bias_to_noise[controlled])])
        shift = found.point_shift_m[controlled]
        content |= {
            "detectable_median": float(np.median(found.detectable[controlled])) * factor,
            "detectable_max": float(found.detectable[controlled].max()) * factor,
            "bias_to_noise_max": float(found.bias_to_noise[worst]),
            "point_shift_max_m": float(np.nanmax(shift)) if np.isfinite(shift).any() else None,
            "weakest": observation_name(
                result.network, index, int(rows.source[worst]), int(rows.axis[worst])
            ),
        }
    return content


def image_reliability(result: Adjustment) -> tuple[Array, Array]:
    """Minimal detectable bias (image points, 2) um, and the largest point shift (image points,) m.

    NaN where an image point took no part, infinite where the others do not control it.
    """
    found, rows = reliability_of(result), result.equations
    count = len(result.network.image_points.image)
    detectable, shift = np.full((count, 2), np.nan), np.full(count, np.nan)
    for axis in range(2):
        own = rows.group == axis
        source = rows.source[own]
        detectable[source, axis] = found.detectable[own] * 1e3
        shift[source] = np.fmax(shift[source], found.point_shift_m[own])
    return detectable, shift


def other_observations(result: Adjustment) -> Iterator[tuple[str | float, ...]]:
    """Rows of observations that are no image points: residual, redundancy, reliability."""
    found, rows = reliability_of(result), result.equations
    for k in np.flatnonzero((rows.group >= 2) & (rows.group < 8)):
        kind = rows.groups[rows.group[k]]
        unit, factor = unit_of(kind)
        name = observation_name(
            result.network, int(rows.group[k]), int(rows.source[k]), int(rows.axis[k])
        )
        yield (
            name,
            kind,
            float(result.residual[k] * rows.sigma[k] * factor),
            unit,
            round(float(result.redundancy_number[k]), 4),
            round(float(result.standardised[k]), 3),
            float(found.detectable[k] * factor),
            float(found.bias_to_noise[k]),
            float(found.point_shift_m[k]),
        )
