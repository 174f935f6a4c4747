"""Sums of residuals over cells of neighbours, against residuals made by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.matching.tie_points import PAN_TO_COLOUR, PAN_TO_PAN
from processing.mosaic.adjustment import ObservationBlock, normal_equations
from processing.mosaic.clusters import _cells, _variance_ratio, clustered_cofactor
from processing.mosaic.weights import TiePointGroup

Array = NDArray[np.float64]
SIGMA0, UNIT, PITCH_MM = 1.5, 2.0, 0.0072


def rectangle(width: float, height: float, across: int, down: int) -> Array:
    """Places on a grid of a rectangle whose lower left corner is (10, -30), corners included."""
    x, y = np.meshgrid(np.linspace(0.0, width, across), np.linspace(0.0, height, down))
    return np.column_stack([10.0 + x.ravel(), -30.0 + y.ravel()])


def test_places_lie_in_square_cells_of_thirty() -> None:
    wide = rectangle(12.0, 4.0, 18, 5)
    cell, area = _cells(wide)
    assert area == pytest.approx(16.0)
    expected = np.minimum((wide[:, 0] - 10.0) // 4.0, 2)
    assert cell.tolist() == expected.tolist()
    tall = rectangle(4.0, 12.0, 5, 18)
    cell, area = _cells(tall)
    assert area == pytest.approx(16.0)
    assert cell.tolist() == np.minimum((tall[:, 1] + 30.0) // 4.0, 2).tolist()
    square = rectangle(8.0, 8.0, 12, 10)
    cell, area = _cells(square)
    right, up = square[:, 0] >= 14.0, square[:, 1] >= -26.0
    assert area == pytest.approx(16.0) and cell.tolist() == (2 * up + right).tolist()


def test_few_places_or_one_are_one_cell() -> None:
    cell, area = _cells(rectangle(8.0, 2.0, 6, 5))
    assert set(cell.tolist()) <= {0, 1, 2, 3} and len(set(cell.tolist())) == 2
    assert area == pytest.approx(8.0)
    cell, _ = _cells(np.full((40, 2), 3.0))
    assert len(set(cell.tolist())) == 1


def block_of_cells(
    size: float, *, kind: int = PAN_TO_PAN, cells: int = 15, design: float = 0.0
) -> tuple[TiePointGroup, ObservationBlock]:
    """A row of square cells of 30 points; in each all are off by `size` sigmas, either way.

    Every other point is not used, and far off. One unknown moves the x of all points by `design`.
    """
    used = np.column_stack(
        [np.repeat(np.arange(cells), 30) + np.tile((np.arange(30) % 6 + 0.5) / 6.0, cells),
         np.tile((np.arange(30) // 6 + 0.5) / 5.0, cells)]
    )  # fmt: skip
    # The rectangle of places is that of the cells.
    used[0], used[-1] = (0.0, 0.0), (cells, 1.0)
    count = len(used)
    sigma = np.random.default_rng(1).uniform(0.5, 2.0, count)
    sign = np.where(np.repeat(np.arange(cells), 30) % 2, 1.0, -1.0)
    off = (size * sign * sigma * UNIT * SIGMA0)[:, None] * [1.0, -1.0]
    rng = np.random.default_rng(2)
    order = rng.permutation(2 * count)
    group = TiePointGroup(
        a="A",
        b="B",
        kind=kind,
        rows=np.arange(2 * count),
        corrected_a=np.zeros((2 * count, 2)),
        corrected_b=np.concatenate([used, used])[order],
        sigma=np.concatenate([sigma, sigma])[order],
        difference=np.concatenate([off, np.full((count, 2), 1e3)])[order],
        redundancy=np.ones((2 * count, 2)),
        factor=np.concatenate([np.ones(count), np.zeros(count)])[order],
    )
    block = ObservationBlock(
        columns=np.array([0]),
        design=np.concatenate([np.full(2 * count, design), np.zeros(2 * count)])[None],
        misclosure=np.zeros(4 * count),
        weight=np.tile(group.factor / (group.sigma * UNIT) ** 2, 2),
    )
    return group, block


def ratio(
    *parts: tuple[TiePointGroup, ObservationBlock], cofactor: float = 0.0, reach_mm: float = 0.0
) -> float:
    groups, blocks = zip(*parts, strict=True)
    scale = np.full(len(parts), UNIT)
    return _variance_ratio(groups, blocks, np.array([[cofactor]]), scale, SIGMA0, reach_mm)


@pytest.mark.parametrize("size", [0.05, 0.5, 1.3])
def test_points_that_err_alike_have_a_sum_of_thirty_times_the_variance(size: float) -> None:
    assert ratio(block_of_cells(size)) == pytest.approx(30.0 * size**2)


def test_cells_smaller_than_the_reach_show_a_part_of_it() -> None:
    # Cells of one square millimetre, a reach of two: a fifth is shown.
    assert ratio(block_of_cells(0.5), reach_mm=2.0) == pytest.approx(
        1.0 + 5.0 * (30.0 * 0.25 - 1.0)
    )


@pytest.mark.parametrize(("cells", "found"), [(14, 1.0), (15, 7.5)])
def test_fewer_than_thirty_sums_yield_nothing(cells: int, found: float) -> None:
    assert ratio(block_of_cells(0.5, cells=cells)) == pytest.approx(found)


def test_sums_of_several_groups_count_together_and_single_points_not() -> None:
    single, block = block_of_cells(0.5, cells=1)
    single.factor[:] = 0.0
    single.factor[0] = 1.0
    assert ratio((single, block), block_of_cells(0.5)) == pytest.approx(7.5)
    assert ratio(block_of_cells(0.5, cells=7), block_of_cells(1.0, cells=8)) == pytest.approx(
        30.0 * (7 * 0.25 + 8) / 15
    )


def test_what_the_unknowns_take_of_a_sum_is_not_expected_of_it() -> None:
    group, block = block_of_cells(0.5, design=0.3)
    used = group.factor > 0.0
    cell = np.clip(group.corrected_b[used, 0].astype(int), 0, 14)
    expected = 900.0
    for number in range(15):
        lever = float(np.sum(0.3 / (group.sigma[used][cell == number] * UNIT)))
        expected -= 0.01 * lever**2
    found = 2 * 15 * (30 * 0.5) ** 2
    assert ratio((group, block), cofactor=0.01) == pytest.approx(
        1.0 + (found - expected) / expected
    )


@pytest.mark.parametrize(("kind", "reach_mm"), [(PAN_TO_PAN, 0.0), (PAN_TO_COLOUR, 93.0 * 0.0072)])
def test_the_cofactor_grows_by_what_points_of_a_class_err_alike(kind: int, reach_mm: float) -> None:
    common, separate = (
        block_of_cells(0.5, kind=kind, design=0.01),
        block_of_cells(0.05, kind=1 - kind, design=0.02),
    )
    assert {PAN_TO_PAN, PAN_TO_COLOUR} == {0, 1}
    cofactor = np.array([[0.02]])
    groups, blocks = zip(common, separate, strict=True)
    scale = np.full(2, UNIT)
    found = clustered_cofactor(groups, blocks, cofactor, scale, SIGMA0, pitch_mm=PITCH_MM)
    k = ratio(common, cofactor=0.02, reach_mm=reach_mm)
    normal, _ = normal_equations([common[1]], 1)
    assert k > 2.0
    np.testing.assert_allclose(found, cofactor + (k - 1.0) * cofactor @ normal @ cofactor)
