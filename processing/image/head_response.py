"""A PAN head that responds otherwise than its neighbours to the light they share.

Each overlap is cut into cells of alike place and light. Between heads that respond alike the ratio
of their signals is one number; a dark signal that was not subtracted or another tone curve makes it
depend on the light, another fall-off on the place.

Source: docs/explanation/mathematics/radiometry.md#response-of-a-head.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

OFFSET_LIMIT: Final = 240.0
"""Level-1 counts (30 DN of 12 bits): black drifts by a few DN."""
SLOPE_LIMIT: Final = 0.08
"""Change of signal from one side of a frame to the other."""
SIGNIFICANCE: Final = 8.0
"""Standard deviations by which an offset or slope must differ from zero."""
ALTERNATIVE: Final = 0.5
"""Of what the best explanation explains: another one that explains as much may be right instead."""
_PARTS: Final = 6
"""Of an overlap along its longer side."""
_LEVELS: Final = 5
"""Of the light in each part."""
_MIN_SAMPLES: Final = 12
"""Of a cell."""
_CELL_MAX: Final = 48
"""Samples of a cell: more would cost time and add nothing, as parallax remains."""
SAMPLES_MAX: Final = _PARTS * _LEVELS * _CELL_MAX
"""Of an overlap."""
_CELL_SIGMA: Final = 0.004
"""Of a log ratio: what parallax and reflection leave between two cones."""
_GAIN_SIGMA: Final = 0.5
_WIDE_OFFSET: Final = 1e4
_WIDE_SLOPE: Final = 1.0
"""Prior sigmas that determine nothing but what no overlap does."""


@dataclass(frozen=True)
class OverlapCells:
    """Cells (n) of the overlap of two heads: medians of log(a / b), with their sigma.

    `place` (n, 2) is their middle as shares of the image's columns and rows, `light` (n,) the mean
    signal of both heads in Level-1 counts.
    """

    sensor_a: str
    sensor_b: str
    place: Array
    light: Array
    log_ratio: Array
    sigma: Array


@dataclass(frozen=True)
class HeadResponse:
    """The head whose response differs most; none where no one differs by a limit.

    `offset` is in Level-1 counts, `slope` the change of its signal from one side of its frame to
    the other along `axis` of the image; what is not significant is None. `alternatives` explain
    the overlaps as well. Offsets below `offset_limit` may be there in any head.
    """

    offset_limit: float
    sensor: str = ""
    offset: float | None = None
    slope: float | None = None
    axis: str = ""
    alternatives: tuple[str, ...] = ()


def overlap_cells(
    sensor_a: str, sensor_b: str, light_a: Array, light_b: Array, places: Array
) -> OverlapCells:
    """Cut an overlap into cells of alike place and light.

    Args:
        sensor_a: name of a head.
        sensor_b: name of the other.
        light_a: signal of the first at common places, (n,) Level-1 counts above zero.
        light_b: that of the other.
        places: of the samples, (n, 2) shares of the image's columns and rows.

    Returns:
        The cells; none where there are too few samples for one.
    """
    parts = min(_PARTS, len(light_a) // _MIN_SAMPLES)
    levels = min(_LEVELS, len(light_a) // (parts * _MIN_SAMPLES)) if parts else 0
    if not levels:
        return OverlapCells(sensor_a, sensor_b, np.empty((0, 2)), *(np.empty(0),) * 3)
    size = min(len(light_a) // (parts * levels), _CELL_MAX)
    chosen = np.arange(parts * levels * size) * len(light_a) // (parts * levels * size)
    places, first, second = places[chosen], light_a[chosen], light_b[chosen]
    along = places[:, int(np.argmax(np.ptp(places, axis=0)))]
    by_part = np.argsort(along).reshape(parts, -1)
    light = 0.5 * (first + second)
    by_light = np.argsort(light[by_part], axis=1)
    cells = np.take_along_axis(by_part, by_light, axis=1).reshape(-1, size)
    ratios = np.sort(np.log(first / second)[cells], axis=1)
    middles = 0.5 * (ratios[:, size // 2] + ratios[:, (size - 1) // 2])
    # Of normal errors; the median's standard deviation is 1.2533 times that of the mean.
    spreads = 0.7413 * (ratios[:, -1 - size // 4] - ratios[:, size // 4])
    return OverlapCells(
        sensor_a,
        sensor_b,
        places[cells].mean(axis=1),
        light[cells].mean(axis=1),
        middles,
        np.hypot(1.2533 * spreads / np.sqrt(size), _CELL_SIGMA),
    )


def head_response(
    overlaps: Sequence[OverlapCells], changed: Collection[str] = ()
) -> HeadResponse | None:
    """The head of which another response explains the overlaps best.

    Args:
        overlaps: of all heads.
        changed: sensors whose signal changes within their frames in another way; left out.

    Returns:
        The response; None where no overlap remains.

    Source: docs/explanation/mathematics/radiometry.md#response-of-a-head.
    """
    used = [o for o in overlaps if not {o.sensor_a, o.sensor_b} & set(changed) and len(o.light)]
    names = sorted({name for o in used for name in (o.sensor_a, o.sensor_b)})
    if not names:
        return None
    fits = _fits(names, used)
    limit = max(max(OFFSET_LIMIT, SIGNIFICANCE * fit.offset_sigma) for fit in fits.values())
    found = {name: fit for name, fit in fits.items() if fit.is_significant}
    if not found:
        return HeadResponse(limit)
    best = max(found, key=lambda name: found[name].explained)
    least = ALTERNATIVE * found[best].explained
    others = tuple(name for name in found if name != best and found[name].explained >= least)
    fit = found[best]
    return HeadResponse(limit, best, fit.offset, fit.slope, fit.axis, others)


@dataclass(frozen=True)
class _Fit:
    """What another response of one head explains: the decrease of the weighted squares."""

    explained: float
    offset_sigma: float
    offset: float | None
    slope: float | None
    axis: str

    @property
    def is_significant(self) -> bool:
        return self.offset is not None or self.slope is not None


def _fits(names: Sequence[str], overlaps: Sequence[OverlapCells]) -> dict[str, _Fit]:
    """For each head: gains of all, and an offset and slopes of this one, by least squares."""
    count = len(names)
    signs = [[(n == o.sensor_a) - (n == o.sensor_b) for n in names] for o in overlaps]
    sign = np.repeat(np.array(signs, np.float64), [len(o.light) for o in overlaps], axis=0)
    place = np.concatenate([o.place for o in overlaps])
    light = np.concatenate([o.light for o in overlaps])
    weight = 1.0 / np.concatenate([o.sigma for o in overlaps])
    measured = np.concatenate([o.log_ratio for o in overlaps]) * weight
    gains = sign * weight[:, None]
    before = _squares(gains, measured, np.full(count, _GAIN_SIGMA))[1]
    fits = {}
    for k, name in enumerate(names):
        of_head = place[sign[:, k] != 0.0]
        middle, extent = 0.5 * (of_head.max(axis=0) + of_head.min(axis=0)), np.ptp(of_head, axis=0)
        terms = np.column_stack([1.0 / light, (place - middle) / np.maximum(extent, 1e-6)])
        design = np.hstack([gains, terms * gains[:, k : k + 1]])
        sigmas = np.array([*[_GAIN_SIGMA] * count, _WIDE_OFFSET, _WIDE_SLOPE, _WIDE_SLOPE])
        solution, after, covariance = _squares(design, measured, sigmas)
        variance = max(1.0, after / max(len(measured) - count - 3, 1))
        sigma = np.sqrt(variance * np.diag(covariance)[count:])
        offset, slopes = float(solution[count]), solution[count + 1 :]
        side = int(np.argmax(np.abs(slopes) / sigma[1:]))
        is_offset = abs(offset) > max(OFFSET_LIMIT, SIGNIFICANCE * sigma[0])
        is_slope = abs(slopes[side]) > max(SLOPE_LIMIT, SIGNIFICANCE * sigma[1 + side])
        fits[name] = _Fit(
            (before - after) / variance,
            float(sigma[0]),
            offset if is_offset else None,
            float(slopes[side]) if is_slope else None,
            ("columns", "rows")[side],
        )
    return fits


def _squares(design: Array, measured: Array, sigmas: Array) -> tuple[Array, float, Array]:
    """Least squares with prior sigmas: solution, squares of the residuals, and covariance."""
    covariance = np.linalg.inv(design.T @ design + np.diag(sigmas**-2.0))
    solution = covariance @ (design.T @ measured)
    residuals = measured - design @ solution
    return solution, float(residuals @ residuals), covariance
