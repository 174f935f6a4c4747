"""Residuals of one frame in bins along an axis, and runs of bins that are shifted.

What follows from such runs is in `processing.mosaic.readout_slips`. These loops run for every frame
of every exposure, also where nothing is found.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.image.compiled_kernel import compiled_kernel

Array = NDArray[Any]

MEDIAN_EFFICIENCY_FACTOR: Final = 1.2533
"""Standard deviation of a median over that of a mean, for normal errors."""


@compiled_kernel()
def points_of_frame(
    sensor_a: Array,
    sensor_b: Array,
    raw_a: Array,
    raw_b: Array,
    residuals: Array,
    usable: Array,
    number: int,
) -> tuple[Array, Array, Array]:
    """The usable tie points of one frame, with residuals as seen from this frame.

    Args:
        sensor_a: number of the first frame of each point, (n,).
        sensor_b: of the second one, (n,).
        raw_a: places in the first frame, (n, 2), px.
        raw_b: in the second one, (n, 2), px.
        residuals: place of a less place of b, (n, 2).
        usable: which points count, (n,).
        number: of the frame.

    Returns:
        Indices of its m points (m,), their places in the frame (m, 2), and the residuals (m, 2),
        of the other sign where the frame is the second one.
    """
    rows = np.empty(len(sensor_a) + 1, np.int64)
    count = 0
    for i in range(len(sensor_a)):
        # No branch, which a processor would guess wrong now and then; one more place than points.
        rows[count] = i
        count += usable[i] & ((sensor_a[i] == number) | (sensor_b[i] == number))
    raw, own = np.empty((count, 2)), np.empty((count, 2))
    for k in range(count):
        i = rows[k]
        is_first = sensor_a[i] == number
        for axis in range(2):
            raw[k, axis] = raw_a[i, axis] if is_first else raw_b[i, axis]
            own[k, axis] = residuals[i, axis] if is_first else -residuals[i, axis]
    return rows[:count].copy(), raw, own


@compiled_kernel()
def order_along(at: Array, size: int) -> Array:
    """Order of points along an axis, equal ones as they are: a stable sort.

    Args:
        at: places, (n,), px; few lie in the same pixel.
        size: of the frame along the axis, px.

    Returns:
        Indices of the points, (n,) int64.

    Example:
        >>> order_along(np.array([5.0, 0.5, 5.0, 0.25]), 10)
        array([3, 1, 0, 2])
    """
    pixel = np.empty(len(at), np.int64)
    first = np.zeros(size + 2, np.int64)
    for i in range(len(at)):
        pixel[i] = min(max(math.floor(at[i]), -1), size) + 1
        if pixel[i] <= size:
            first[pixel[i] + 1] += 1
    for k in range(1, len(first)):
        first[k] += first[k - 1]
    order = np.empty(len(at), np.int64)
    for i in range(len(at)):
        order[first[pixel[i]]] = i
        first[pixel[i]] += 1
    # Within a pixel the order is that of the points; now that of their places.
    for j in range(1, len(order)):
        i, k = order[j], j
        while k > 0 and at[order[k - 1]] > at[i]:
            order[k] = order[k - 1]
            k -= 1
        order[k] = i
    return order


@compiled_kernel()
def level_of(medians: Array) -> Array:
    """The level of a frame: the median of what its bins have, a seventh of the work of all.

    Args:
        medians: of the bins, (n, 2).

    Returns:
        By coordinate, (2,).
    """
    return np.array([np.median(medians[:, 0].copy()), np.median(medians[:, 1].copy())])


@compiled_kernel(error_model="numpy")
def bin_residuals(
    residuals: Array, sigma: Array, order: Array, per: int
) -> tuple[Array, Array, Array]:
    """Medians of residuals in bins, and running sums over the bins.

    Args:
        residuals: of the points, (n, 2).
        sigma: standard deviation of a coordinate of each, (n,).
        order: numbers of the points along the axis, (bins * per,).
        per: points of a bin.

    Returns:
        Medians (bins, 2), sums of medians times information (bins + 1, 2), and sums of information
        (bins + 1,), the first of which are zero. Information is the sum of 1 / sigma^2.
    """
    bins = len(order) // per
    medians = np.empty((bins, 2))
    sums, weight = np.zeros((bins + 1, 2)), np.zeros(bins + 1)
    values = np.empty(per)
    for b in range(bins):
        information = 0.0
        for k in range(b * per, (b + 1) * per):
            information += 1.0 / sigma[order[k]] ** 2
        weight[b + 1] = weight[b] + information
        for axis in range(2):
            for k in range(per):
                values[k] = residuals[order[b * per + k], axis]
            # Sorts without branches, which a processor would guess wrong half of the time.
            for turn in range(per):
                for k in range(turn % 2, per - 1, 2):
                    one, other = values[k], values[k + 1]
                    values[k], values[k + 1] = min(one, other), max(one, other)
            medians[b, axis] = (values[(per - 1) // 2] + values[per // 2]) / 2.0
            sums[b + 1, axis] = sums[b, axis] + medians[b, axis] * information
    return medians, sums, weight


@compiled_kernel(error_model="numpy")
def shifted_runs(sums: Array, weight: Array, level: Array, limit: float) -> Array:
    """The most shifted run of bins of each width whose score is over a limit.

    A run is shifted against the frame's level or against the mean of the rest, whichever is more.

    Args:
        sums: of medians times information, (bins + 1, 2).
        weight: sums of information, (bins + 1,).
        level: of the frame, (2,).
        limit: of the score: the shift over its standard deviation.

    Returns:
        First bin, width and score by run, (runs, 3).
    """
    bins = len(weight) - 1
    found = np.empty((bins, 3))
    count, width = 0, 2 if bins > 2 else bins + 1
    while width <= max((bins + 1) // 2, 2) and width <= bins:
        largest, at_bin = -1.0, 0
        for first in range(bins + 1 - width):
            held = weight[first + width] - weight[first]
            of_run, of_rest = 1.0 / held, 1.0 / (weight[bins] - held)
            reach = 0.0
            for axis in range(2):
                inside = sums[first + width, axis] - sums[first, axis]
                mean = inside * of_run
                rest = (sums[bins, axis] - inside) * of_rest
                reach = max(reach, abs(mean - level[axis]), abs(mean - rest))
            if reach * reach * held > largest:
                largest, at_bin = reach * reach * held, first
        best = math.sqrt(max(largest, 0.0)) / MEDIAN_EFFICIENCY_FACTOR
        if best > limit:
            found[count, 0], found[count, 1], found[count, 2] = at_bin, width, best
            count += 1
        width = max(width + 1, math.ceil(width * 1.2))
    return found[:count]
