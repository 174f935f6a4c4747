"""Which head responds otherwise to the light that it shares with its neighbours."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from processing.image.head_response import (
    OFFSET_LIMIT,
    HeadResponse,
    OverlapCells,
    head_response,
    overlap_cells,
)

pytestmark = pytest.mark.trust

Array = Any
Change = Callable[[Array, Array], Array]
NAMES = ("A", "B", "C", "D")
"""Left to right and top to bottom, with overlaps of a fifth of the image."""
COLUMNS = ((0.0, 0.6), (0.4, 1.0), (0.0, 0.6), (0.4, 1.0))
ROWS = ((0.0, 0.6), (0.0, 0.6), (0.4, 1.0), (0.4, 1.0))
GAINS = (1.0, 1.03, 0.97, 1.01)


def overlaps(
    changes: dict[str, Change], *, contrast: float = 1.0, noise: float = 20.0
) -> list[OverlapCells]:
    """Of four heads over one ground, some of which respond otherwise to light and place."""
    random = np.random.default_rng(7)
    places = random.uniform(0.0, 1.0, (40_000, 2))
    ground = 6000.0 * np.exp(contrast * np.sin(23.0 * places[:, 0]) * np.cos(31.0 * places[:, 1]))
    seen, covered = [], []
    for name, (left, right), (top, bottom), gain in zip(NAMES, COLUMNS, ROWS, GAINS, strict=True):
        signal = gain * ground
        if name in changes:
            signal = changes[name](signal, places)
        seen.append(signal + random.normal(0.0, noise, len(signal)))
        across, down = places.T
        covered.append((across > left) & (across < right) & (down > top) & (down < bottom))
    return [
        overlap_cells(NAMES[a], NAMES[b], seen[a][both], seen[b][both], places[both])
        for a, b in itertools.combinations(range(len(NAMES)), 2)
        for both in [covered[a] & covered[b]]
    ]


def response(changes: dict[str, Change], **options: float) -> HeadResponse:
    found = head_response(overlaps(changes, **options))
    assert found is not None
    return found


def test_heads_of_other_gains_respond_alike() -> None:
    assert response({}) == HeadResponse(OFFSET_LIMIT)
    assert response({"B": lambda signal, _: 0.5 * signal}) == HeadResponse(OFFSET_LIMIT)


@pytest.mark.parametrize("offset", [400.0, -400.0, 800.0])
@pytest.mark.parametrize("name", NAMES)
def test_an_offset_is_measured_and_named(name: str, offset: float) -> None:
    found = response({name: lambda signal, _: signal + offset})
    assert found.sensor == name and found.alternatives == ()
    assert found.offset == pytest.approx(offset, rel=0.1) and found.slope is None


def test_an_offset_below_the_limit_is_not_named() -> None:
    assert response({"A": lambda signal, _: signal + 0.8 * OFFSET_LIMIT}).sensor == ""


def test_another_tone_curve_is_named_as_an_offset() -> None:
    found = response({"C": lambda signal, _: 9000.0 * (signal / 9000.0) ** 0.8})
    assert found.sensor == "C" and (found.offset or 0.0) > 3 * OFFSET_LIMIT


@pytest.mark.parametrize(("axis", "name"), [(0, "A"), (1, "D")])
@pytest.mark.parametrize("slope", [0.15, -0.15])
def test_a_slope_is_measured_from_side_to_side(axis: int, name: str, slope: float) -> None:
    middle = 0.3 if name == "A" else 0.7

    def change(signal: Array, places: Array) -> Array:
        return signal * (1.0 + slope * (places[:, axis] - middle) / 0.6)

    found = response({name: change})
    assert found.sensor == name and found.axis == ("columns", "rows")[axis]
    assert found.slope == pytest.approx(slope, rel=0.1) and found.offset is None


def test_over_even_ground_an_offset_is_not_distinguished_from_a_gain() -> None:
    found = response({"A": lambda signal, _: signal + 400.0}, contrast=0.01)
    assert found.sensor == "" and found.offset_limit > 400.0


def test_of_two_heads_both_may_be_wrong() -> None:
    cells = overlaps({"A": lambda signal, _: signal + 800.0})[:1]
    found = head_response(cells)
    assert found is not None
    assert {found.sensor, *found.alternatives} == {"A", "B"}


def test_heads_that_change_otherwise_are_left_out() -> None:
    cells = overlaps({"A": lambda signal, _: signal + 800.0})
    found = head_response(cells, {"A"})
    assert found is not None and found.sensor == ""
    assert head_response(cells, NAMES) is None
    assert head_response([]) is None


@pytest.mark.parametrize(("count", "cells"), [(0, 0), (5, 0), (13, 1), (100, 6), (1000, 30)])
def test_few_samples_make_few_cells(count: int, cells: int) -> None:
    light = np.linspace(1000.0, 2000.0, count)
    found = overlap_cells("A", "B", light, light, np.random.default_rng(1).uniform(size=(count, 2)))
    assert len(found.light) == cells
    assert np.allclose(found.log_ratio, 0.0) and np.all(found.sigma >= 0.004)


def test_noise_widens_what_is_not_distinguished() -> None:
    quiet = response({}, contrast=0.1).offset_limit
    assert response({}, contrast=0.1, noise=600.0).offset_limit > 2.0 * quiet


def test_what_no_response_explains_widens_it_too() -> None:
    def waves(signal: Array, places: Array) -> Array:
        return signal * (1.0 + 0.1 * np.sin(25.0 * places[:, 0]))

    explained = response({}, contrast=0.1).offset_limit
    assert response({"A": waves}, contrast=0.1).offset_limit > 2.0 * explained
