"""Which patch of the photographs lies where: the arrangement whose neighbours fit best.

Simulated annealing over swaps of patches, after Kirkpatrick et al., Optimization by Simulated
Annealing, Science, 1983. The cost of two neighbours is how their overlap differs; patches of one
kind of ground gather into areas, and patches that show a border come to lie between them.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Costs = NDArray[np.float32]
Indices = NDArray[np.int64]

MIN_REPEAT_DISTANCE = 2
"""A cell is not used again, in whatever orientation, within this many patches."""
REPEAT_COST = 40.0
"""Of a cell next to itself, in medians of the cost of two neighbours."""
PROPOSALS = 1000
"""Swaps tried for each place."""
TEMPERATURES = (0.6, 0.01)
"""First and last, in medians of the cost of two neighbours."""
BATCH = 1 << 18


def arrange(
    shape: tuple[int, int],
    right_of: Costs,
    below: Costs,
    own: Costs,
    cells: Indices,
    random: np.random.Generator,
) -> Indices:
    """Arrange patches on a grid.

    Args:
        shape: rows and columns.
        right_of: (n, n), cost of patch q to the right of patch p, [p, q].
        below: (n, n), cost of patch q below patch p.
        own: (n,), cost of using a patch at all, in medians of the cost of two neighbours.
        cells: (n,), the cell of each patch; patches of one cell repel each other.
        random: decides.

    Returns:
        Index of the patch at every place, shape (rows, columns). Where there are more places than
        patches, all patches are used equally often.
    """
    places = shape[0] * shape[1]
    copies = -(-places // len(own))
    items = np.concatenate([random.permutation(len(own)) for _ in range(copies)])
    if copies > 1:
        items = items[:places]
    unit = float(np.median(right_of))
    scale = np.float32(1.0 / max(unit, 1e-12))
    costs = (right_of * scale, below * scale, own.astype(np.float32))
    swaps = PROPOSALS * places
    cooling = (TEMPERATURES[1] / TEMPERATURES[0]) ** (1.0 / swaps)
    temperature = TEMPERATURES[0]
    for done in range(0, swaps, BATCH):
        count = min(BATCH, swaps - done)
        first = random.integers(0, places, count, dtype=np.int32)
        second = random.integers(0, len(items), count, dtype=np.int32)
        chance = random.random(count, dtype=np.float32)
        temperature = _anneal(
            items, shape[1], places, *costs, cells, first, second, chance, temperature, cooling
        )
    return np.asarray(items[:places].reshape(shape))


@numba.njit(cache=True, nogil=True, fastmath=False)
def _cost_at(items, columns, places, right_of, below, own, cells, at):
    """Cost of the patch at a place with its neighbours; none if it is not placed."""
    if at >= places:
        return np.float32(0.0)
    patch = items[at]
    rows = places // columns
    r, c = at // columns, at % columns
    total = own[patch]
    if c > 0:
        total += right_of[items[at - 1], patch]
    if c < columns - 1:
        total += right_of[patch, items[at + 1]]
    if r > 0:
        total += below[items[at - columns], patch]
    if r < rows - 1:
        total += below[patch, items[at + columns]]
    for i in range(max(r - MIN_REPEAT_DISTANCE, 0), min(r + MIN_REPEAT_DISTANCE + 1, rows)):
        for j in range(max(c - MIN_REPEAT_DISTANCE, 0), min(c + MIN_REPEAT_DISTANCE + 1, columns)):
            near = i * columns + j
            if near != at and cells[items[near]] == cells[patch]:
                total += np.float32(REPEAT_COST)
    return total


@numba.njit(cache=True, nogil=True, fastmath=False)
def _anneal(
    items: Indices,
    columns: int,
    places: int,
    right_of: Costs,
    below: Costs,
    own: Costs,
    cells: Indices,
    first: NDArray[np.int32],
    second: NDArray[np.int32],
    chance: Costs,
    temperature: float,
    cooling: float,
) -> float:
    for k in range(len(first)):
        temperature *= cooling
        a, b = first[k], second[k]
        before = _cost_at(items, columns, places, right_of, below, own, cells, a)
        before += _cost_at(items, columns, places, right_of, below, own, cells, b)
        items[a], items[b] = items[b], items[a]
        after = _cost_at(items, columns, places, right_of, below, own, cells, a)
        after += _cost_at(items, columns, places, right_of, below, own, cells, b)
        if after > before and chance[k] >= np.exp((before - after) / temperature):
            items[a], items[b] = items[b], items[a]
    return temperature
