"""Weights of tie points by numbers: classes, shared corners, blunders, variance components."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.geometry.placement import nominal_placements, vip_mm_from_raw
from processing.geometry.topology import corners, overlaps
from processing.matching.tie_points import PAN_TO_COLOUR, PAN_TO_PAN, TiePoints
from processing.mosaic.weights import (
    CLASSES,
    MosaicSettings,
    TiePointGroup,
    block_after_step,
    block_of,
    class_scales,
    full_weight,
    groups_of,
    initial_weights,
    weight_factors,
)
from processing.rig import find_rig
from tests.processing.synthetic import Truth, make_truth, tie_points_of

Array = NDArray[np.float64]
MINI = find_rig("ultracam-x-mini")


def exposure() -> tuple[Truth, TiePoints]:
    rng = np.random.default_rng(5)
    truth = make_truth(MINI, rng, sensor_px=0.3, layer_px=0.5)
    points = tie_points_of(truth, rng, per_overlap=300, per_sensor=100)
    # Some matches are twice as sharp as others, in both classes.
    points.sigma_px[::3] *= 0.5
    return truth, points


def group_of(difference: Array, *, kind: int = PAN_TO_PAN, sigma: float = 1.0) -> TiePointGroup:
    n = len(difference)
    none = np.empty((n, 2))
    return TiePointGroup(
        a="SU00",
        b="SU10",
        kind=kind,
        rows=np.arange(n),
        corrected_a=none,
        corrected_b=none,
        sigma=np.full(n, sigma),
        difference=np.asarray(difference, np.float64),
        redundancy=np.ones((n, 2)),
        factor=np.ones(n),
    )


def test_sigmas_are_those_of_the_class_times_how_sharp_the_match_is() -> None:
    truth, points = exposure()
    settings = MosaicSettings(sigma_pp_px=0.2, sigma_pc_px=0.3, parallax_px=0.4)
    groups = groups_of(MINI, truth.start, points, settings, CLASSES)
    assert sum(len(g.rows) for g in groups) == len(points)
    shared = corners(MINI)
    for group in groups:
        relative = points.sigma_px[group.rows] / (0.1 if group.kind == PAN_TO_PAN else 0.3)
        assert (group.a, group.b) == points.pairs[points.overlap[group.rows[0]]]
        if group.kind == PAN_TO_COLOUR:
            # Parallax is not smaller where the match is sharper.
            expected = np.sqrt((0.3 * relative) ** 2 + 0.4**2)
            np.testing.assert_allclose(group.sigma, expected, rtol=1e-12)
            continue
        xy = vip_mm_from_raw(truth.start[group.a], points.raw_a[group.rows])
        outside_shared = ~np.any([c.rectangle.contains(xy) for c in shared], axis=0)
        np.testing.assert_allclose(
            group.sigma[outside_shared], 0.2 * relative[outside_shared], rtol=1e-12
        )
        assert 0.5 < outside_shared.mean() < 1.0
    only = groups_of(MINI, truth.start, points, settings, (PAN_TO_PAN,))
    assert {g.kind for g in only} == {PAN_TO_PAN} and len(only) == 12


def test_all_differences_at_a_corner_hold_the_information_of_images_less_one() -> None:
    truth, points = exposure()
    settings = MosaicSettings(sigma_pp_px=0.2)
    groups = groups_of(MINI, truth.start, points, settings, (PAN_TO_PAN,))
    seen = 0
    for corner in corners(MINI):
        meeting = [o for o in overlaps(MINI) if {o.sensor_a, o.sensor_b} <= set(corner.sensors)]
        information = 0.0
        for o in meeting:
            group = next(g for g in groups if (g.a, g.b) == (o.sensor_a, o.sensor_b))
            xy = vip_mm_from_raw(truth.start[group.a], points.raw_a[group.rows])
            inside = corner.rectangle.contains(xy)
            relative = points.sigma_px[group.rows][inside] / 0.1
            if inside.any():
                information += float(np.mean((0.2 * relative / group.sigma[inside]) ** 2))
                seen += 1
            else:
                information += (len(corner.sensors) - 1) / len(meeting)
        assert information == pytest.approx(min(len(corner.sensors) - 1, len(meeting)))
    assert seen > 8


def test_a_class_without_points_and_points_without_error_are_harmless() -> None:
    truth, points = exposure()
    pan = points.only(points.kind == PAN_TO_PAN)
    pan.sigma_px[5] = 0.0
    groups = groups_of(MINI, truth.start, pan, MosaicSettings(), CLASSES)
    assert {g.kind for g in groups} == {PAN_TO_PAN}
    assert min(float(g.sigma.min()) for g in groups) == 1e-6
    colour = points.only(points.kind == PAN_TO_COLOUR)
    (first, *_) = groups_of(MINI, truth.start, colour, MosaicSettings(), CLASSES)
    expected = 0.3 * points.sigma_px[points.kind == PAN_TO_COLOUR][first.rows] / 0.3
    np.testing.assert_allclose(first.sigma, expected, rtol=1e-12)


def test_the_first_look_leaves_out_what_is_far_from_the_median_of_its_pair() -> None:
    truth, points = exposure()
    group = groups_of(MINI, truth.start, points, MosaicSettings(), (PAN_TO_PAN,))[0]
    a, b = points.raw_a[group.rows], points.raw_b[group.rows]
    px = truth.model.pitch_mm
    difference = vip_mm_from_raw(truth.start[group.a], a) / px
    difference -= vip_mm_from_raw(truth.start[group.b], b) / px
    factors = initial_weights(truth.model, truth.start, group)
    np.testing.assert_allclose(group.difference, difference, atol=1e-6)
    off = np.abs(difference - np.median(difference, axis=0))
    spread = 1.4826 * np.median(off, axis=0)
    limit = 6.0 * np.maximum(spread, 0.2)
    assert factors.tolist() == (off < limit).all(axis=1).astype(float).tolist()
    assert group.redundancy.tolist() == np.ones((len(a), 2)).tolist()
    # Planted: one point just within six spreads in x, one just beyond in y.
    width = truth.start[group.a].sensor.pitch_mm
    offsets = np.array([[1.0, 0.0], [0.0, 1.0]]) * limit * (0.99, 1.01) * width
    moved = dataclasses.replace(group, corrected_a=group.corrected_a.copy())
    middle = np.argsort(off.sum(axis=1))[:2]
    moved.corrected_a[middle] += offsets - (difference[middle] - np.median(difference, axis=0)) * px
    assert initial_weights(truth.model, truth.start, moved)[middle].tolist() == [1.0, 0.0]


def test_small_spreads_count_as_a_fifth_of_a_pixel() -> None:
    placements = nominal_placements(MINI, {}, {})
    truth = make_truth(MINI, np.random.default_rng(1), temperature_c=20.0)
    n = 9
    at = np.zeros((n, 2))
    group = dataclasses.replace(group_of(np.zeros((n, 2))), corrected_a=at.copy(), corrected_b=at)
    group.corrected_a[0, 0] = 1.19 * truth.model.pitch_mm
    group.corrected_a[1, 1] = -1.21 * truth.model.pitch_mm
    initial_weights_found = initial_weights(truth.model, placements, group)
    assert initial_weights_found.tolist() == [1.0, 0.0, *[1.0] * 7]


def test_the_equations_are_derivatives_of_their_misclosure() -> None:
    truth, points = exposure()
    for group in groups_of(MINI, truth.start, points, MosaicSettings(), CLASSES)[::5]:
        group.factor = np.linspace(0.0, 1.0, len(group.rows))
        block = block_of(truth.model, truth.start, group, truth.values, 1.7)
        for k, column in enumerate(block.columns):
            step = np.zeros(len(truth.values))
            step[column] = 1e-3 * truth.model.units[column]
            ahead = block_of(truth.model, truth.start, group, truth.values + step, 1.7)
            behind = block_of(truth.model, truth.start, group, truth.values - step, 1.7)
            slope = -(ahead.misclosure - behind.misclosure) / 2e-3
            np.testing.assert_allclose(block.design[k], slope, atol=1e-4)
        expected = group.factor / (group.sigma * 1.7) ** 2
        np.testing.assert_allclose(block.weight, [*expected, *expected], rtol=1e-12)
        # x of all, then y of all; the noise of matching is all that is left at the truth.
        assert np.abs(block.misclosure).max() < 2.0
        group.difference = np.column_stack([group.sigma, -2.0 * group.sigma])
        later = block_after_step(block, group, 0.5)
        np.testing.assert_allclose(later.misclosure, [*-group.sigma, *2.0 * group.sigma])
        np.testing.assert_allclose(later.weight, 4.0 * 1.7**2 * block.weight, rtol=1e-12)
        assert later.design is block.design


def test_full_weight_is_one_over_the_variance_of_either_coordinate() -> None:
    group = group_of(np.zeros((2, 2)), kind=PAN_TO_COLOUR)
    group.sigma = np.array([0.5, 2.0])
    weights = full_weight(group, {PAN_TO_PAN: 9.0, PAN_TO_COLOUR: 2.0})
    assert weights.tolist() == [1.0, 0.0625, 1.0, 0.0625]


def components(pan: float, colour: float, n: int = 40) -> list[TiePointGroup]:
    alternating = np.array([1.0, -1.0] * (n // 2))[:, None] * np.ones((1, 2))
    return [
        group_of(alternating * pan * 0.1, sigma=0.1),
        group_of(alternating * colour * 0.3, kind=PAN_TO_COLOUR, sigma=0.3),
    ]


def test_variance_components_bring_both_classes_to_the_same_unit() -> None:
    before = {PAN_TO_PAN: 1.0, PAN_TO_COLOUR: 1.0}
    after, moved = class_scales(components(1.5, 6.0), before, MosaicSettings())
    assert after == {PAN_TO_PAN: 1.0, PAN_TO_COLOUR: pytest.approx(4.0)} and moved
    groups = components(1.0, 2.0, 80)
    groups[1].redundancy[:] = 0.25
    assert class_scales(groups, before, MosaicSettings())[0][PAN_TO_COLOUR] == pytest.approx(4.0)
    # A rejected point counts on neither side; a Huber weight of its square, not its redundancy.
    groups = components(1.0, 2.0)
    groups[1].difference[:8], groups[1].factor[:8] = 1e3, 0.0
    assert class_scales(groups, before, MosaicSettings())[0][PAN_TO_COLOUR] == pytest.approx(2.0)
    groups[1].factor[8:] = 0.25
    assert class_scales(groups, before, MosaicSettings())[0][PAN_TO_COLOUR] == pytest.approx(1.0)


@pytest.mark.parametrize(("ratio", "expected"), [(2.0039, False), (2.0041, True), (1.995, True)])
def test_a_ratio_moved_by_two_per_mille_has_moved(ratio: float, expected: bool) -> None:
    before = {PAN_TO_PAN: 1.0, PAN_TO_COLOUR: 2.0}
    assert class_scales(components(1.0, ratio), before, MosaicSettings())[1] is expected


def test_a_class_of_too_little_redundancy_keeps_its_scale() -> None:
    before = {PAN_TO_PAN: 1.0, PAN_TO_COLOUR: 3.0}
    for n, initial_weights_found in ((14, True), (16, False)):
        after, moved = class_scales(components(1.0, 2.0, n), before, MosaicSettings())
        assert (
            after[PAN_TO_COLOUR] == pytest.approx(3.0 if initial_weights_found else 2.0)
            and moved is not initial_weights_found
        )
    thirty = components(1.0, 2.0, 40)
    thirty[0].redundancy[:] = 30.0 / 80.0
    assert class_scales(thirty, before, MosaicSettings())[0][PAN_TO_COLOUR] != 3.0
    exact = components(0.0, 2.0)
    assert class_scales(exact, before, MosaicSettings()) == (before, False)


def test_a_blunder_is_beyond_four_robust_standard_deviations() -> None:
    spread = 1.4826
    difference = np.array([1.0, -1.0] * 20)[:, None] * np.ones((1, 2))
    difference[0, 0], difference[1, 1] = 3.99 * spread, -3.99 * spread
    difference[2, 0], difference[3, 1] = -4.01 * spread, 4.01 * spread
    pan = group_of(difference * 0.1, sigma=0.1)
    colour = group_of(difference * 0.9, kind=PAN_TO_COLOUR, sigma=0.3)
    # Twice the residual where half of it was adjusted away.
    colour.redundancy[4] = 0.25
    colour.difference[4] = 0.9 * 1.9 * spread
    colour.redundancy[5] = 0.25
    colour.difference[5] = 0.9 * 2.1 * spread
    hard, of_colour = weight_factors([pan, colour], MosaicSettings(), soft=False)
    assert hard.tolist() == [1.0, 1.0, 0.0, 0.0, *[1.0] * 36]
    assert of_colour.tolist() == [1.0, 1.0, 0.0, 0.0, 1.0, 0.0, *[1.0] * 34]


def test_soft_weights_fall_beyond_two_spreads_about_the_median_of_the_pair() -> None:
    difference = np.array([1.0, -1.0] * 20 + [0.0])[:, None] * np.ones((1, 2))
    difference[0, 0] = 8.0 * 1.4826
    difference[1, 1] = 1.99 * 1.4826
    group = group_of(difference * 0.1 + np.array([7.0, -3.0]), sigma=0.1)
    (soft,) = weight_factors([group], MosaicSettings(), soft=True)
    assert soft == pytest.approx([0.25, 1.0, *[1.0] * 39], rel=1e-9)


def test_the_default_accuracies_are_those_of_typical_points() -> None:
    settings = MosaicSettings()
    truth, points = exposure()
    for group in groups_of(MINI, truth.start, points, settings, CLASSES)[::4]:
        typical = 0.1 if group.kind == PAN_TO_PAN else 0.3
        assert float(np.median(group.sigma)) == pytest.approx(typical, rel=0.01)
    assert math.isclose(settings.undetermined_px, 1.0) and settings.parallax_px == 0.0


def test_residuals_far_below_their_sigmas_give_a_ratio_of_classes_too() -> None:
    """Sums of squares below one: the residuals are a hundredth and a fiftieth of their sigmas."""
    rng = np.random.default_rng(3)
    off = rng.choice([-1.0, 1.0], (40, 2))
    pan = group_of(0.01 * off)
    colour = group_of(0.02 * off, kind=PAN_TO_COLOUR)
    after, moved = class_scales([pan, colour], dict.fromkeys(CLASSES, 1.0), MosaicSettings())
    assert after == {PAN_TO_PAN: 1.0, PAN_TO_COLOUR: pytest.approx(2.0)} and moved
    still = group_of(np.zeros((40, 2)))
    before = dict.fromkeys(CLASSES, 1.0)
    assert class_scales([still, colour], before, MosaicSettings()) == (before, False)
