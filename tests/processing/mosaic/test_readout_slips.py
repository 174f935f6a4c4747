"""Shifted bands of residuals: found where they were put, by as much as they were shifted."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.matching.tie_points import PAN_TO_COLOUR, PAN_TO_PAN, TiePoints
from processing.mosaic import readout_slips
from processing.mosaic.readout_slips import (
    MIN_SIGMA_PX,
    Slip,
    find_slips,
    inside_slips,
    of_sensor,
    slip_figures,
    slip_of,
)
from processing.mosaic.slip_settings import SlipSettings, remaining_share
from processing.rig import find_rig

Array = NDArray[np.float64]
MINI = find_rig("ultracam-x-mini")
WIDTH, HEIGHT = 1248, 832
NAMES = ("SU00", "SU10", "SU20", "SU50")


def points(count: int, *, sigma: float = 0.1, seed: int = 1) -> tuple[TiePoints, Array]:
    """Points of SU00 with SU10 (first of even ones) or SU20 (second of odd ones), and residuals."""
    rng = np.random.default_rng(seed)
    is_odd = np.arange(count) % 2 == 1
    size = np.array([WIDTH - 1.0, HEIGHT - 1.0])
    tie_points = TiePoints(
        names=NAMES,
        pairs=(("SU00", "SU10"), ("SU20", "SU00")),
        attempted=(count, count),
        sensor_a=np.where(is_odd, 2, 0),
        sensor_b=np.where(is_odd, 0, 1),
        raw_a=rng.uniform(0.0, 1.0, (count, 2)) * size,
        raw_b=rng.uniform(0.0, 1.0, (count, 2)) * size,
        sigma_px=np.full(count, sigma),
        correlation=np.ones(count),
        kind=np.full(count, PAN_TO_PAN),
        overlap=is_odd.astype(np.int64),
    )
    return tie_points, rng.normal(0.0, sigma, (count, 2))


def shifted(
    tie_points: TiePoints,
    residuals: Array,
    axis: int,
    first: float,
    last: float,
    shift: tuple[float, float],
    *,
    number: int = 0,
) -> Array:
    """Residuals with a band of one frame shifted; its second image counts with the minus sign."""
    result = residuals.copy()
    for of, raw, sign in (
        (tie_points.sensor_a, tie_points.raw_a, 1.0),
        (tie_points.sensor_b, tie_points.raw_b, -1.0),
    ):
        inside = (of == number) & (raw[:, axis] >= first) & (raw[:, axis] <= last)
        result[inside] += sign * np.array(shift)
    return result


def rows_inside(tie_points: TiePoints, first: float, last: float) -> int:
    own = np.where((tie_points.sensor_a == 0)[:, None], tie_points.raw_a, tie_points.raw_b)
    return int(np.sum((own[:, 1] >= first) & (own[:, 1] <= last)))


@pytest.mark.parametrize(
    ("axis", "first", "last"),
    [(1, 300, 460), (1, 0, 200), (1, 560, HEIGHT - 1), (0, 500, 800), (0, 0, 300)],
)
@pytest.mark.parametrize("shift", [(3.0, -1.0), (-0.5, 0.9)])
def test_a_shifted_band_is_found_where_it_lies(
    axis: int, first: int, last: int, shift: tuple[float, float]
) -> None:
    tie_points, residuals = points(1200)
    residuals = shifted(tie_points, residuals, axis, first, last, shift)
    (slip,) = find_slips(MINI, tie_points, residuals)
    size = HEIGHT if axis == 1 else WIDTH
    # A band is as fine as a bin of seven points.
    bin_px = 7 * size / 1200
    assert (slip.sensor, slip.axis) == ("SU00", "rows" if axis == 1 else "columns")
    assert slip.first == (0 if first == 0 else pytest.approx(first, abs=2 * bin_px))
    assert slip.last == (last if last == size - 1 else pytest.approx(last, abs=2 * bin_px))
    assert (slip.dx_px, slip.dy_px) == pytest.approx(shift, abs=0.04)
    assert slip.length_px == pytest.approx(np.hypot(*shift), abs=0.05)
    assert slip.share == pytest.approx((slip.last - slip.first + 1) / size)
    assert slip.points == pytest.approx(1200 * slip.share, rel=0.2)
    # At most the shift over the standard deviation of a mean of all medians.
    main = max(abs(shift[0]), abs(shift[1]))
    assert 15.0 < slip.score < 1.1 * main / 0.1 * np.sqrt(slip.points) / 1.2533


def test_an_error_free_frame_has_no_slip() -> None:
    for seed in range(5):
        assert find_slips(MINI, *points(800, seed=seed)) == ()


def test_the_smallest_shift_that_is_a_slip_falls_with_the_points_of_a_band() -> None:
    settings = SlipSettings()
    assert settings.min_shift_px(100) == pytest.approx(0.32)
    assert settings.min_shift_px(289) == pytest.approx(0.25)
    tie_points, residuals = points(1400, sigma=0.03)
    inside = rows_inside(tie_points, 200, 400)
    for of_least, expected in ((0.85, 0), (1.15, 1)):
        shift = of_least * settings.min_shift_px(inside)
        found = find_slips(
            MINI, tie_points, shifted(tie_points, residuals, 1, 200, 400, (shift, 0.0))
        )
        assert len(found) == expected, of_least


@pytest.mark.parametrize(("sigma", "expected"), [(0.33, 1), (0.65, 0)])
def test_a_shift_within_fifteen_standard_deviations_is_noise(sigma: float, expected: int) -> None:
    tie_points, residuals = points(840, sigma=sigma, seed=3)
    inside = rows_inside(tie_points, 300, 500)
    # 15 standard deviations of the band's mean at a sigma of 0.5 px.
    shift = 15.0 * 0.5 * 1.2533 / np.sqrt(inside)
    found = find_slips(MINI, tie_points, shifted(tie_points, residuals, 1, 300, 500, (shift, 0)))
    assert len(found) == expected


@pytest.mark.parametrize(("times", "expected"), [(1.0, 1), (3.0, 1), (4.0, 0)])
def test_a_band_whose_points_scatter_more_than_it_is_shifted_is_no_slip(
    times: float, expected: int
) -> None:
    tie_points, residuals = points(500)
    own = np.where((tie_points.sensor_a == 0)[:, None], tie_points.raw_a, tie_points.raw_b)
    residuals[own[:, 1] >= 440] *= times
    residuals = shifted(tie_points, residuals, 1, 440, HEIGHT - 1, (0.35, 0.0))
    assert len(find_slips(MINI, tie_points, residuals)) == expected
    by_kind_alone = SlipSettings(own_limit=0.0)
    assert len(find_slips(MINI, tie_points, residuals, settings=by_kind_alone)) == 1


def test_fewer_points_than_six_bins_are_not_searched() -> None:
    settings = SlipSettings()
    for count, expected in ((41, 0), (42, 1)):
        tie_points, residuals = points(count, sigma=0.02)
        moved = shifted(tie_points, residuals, 1, 0, 330, (20.0, 0.0))
        assert len(find_slips(MINI, tie_points, moved, settings=settings)) == expected
    lost = moved.copy()
    lost[np.flatnonzero(tie_points.sensor_a == 0)[0]] = np.nan
    assert find_slips(MINI, tie_points, lost, settings=settings) == ()


def test_a_band_of_which_only_some_points_move_is_traffic() -> None:
    tie_points, residuals = points(1400, sigma=0.05)
    of_a = (tie_points.sensor_a == 0)[:, None]
    order = np.argsort(np.where(of_a, tie_points.raw_a, tie_points.raw_b)[:, 1])
    sign = np.where(of_a, 1.0, -1.0)
    # Of every seven neighbours four or five move: 57 % or 71 %, and 60 % are asked for.
    for moving, count in ((4, 0), (5, 1)):
        moved = residuals.copy()
        for first in range(490, 840, 7):
            rows = order[first : first + moving]
            moved[rows] += sign[rows] * (0.0, 2.0)
        assert len(find_slips(MINI, tie_points, moved)) == count, moving


def test_two_frames_are_named_the_one_that_explains_most_first() -> None:
    tie_points, residuals = points(1400)
    residuals = shifted(tie_points, residuals, 1, 300, 500, (0.0, 1.0))
    residuals = shifted(tie_points, residuals, 0, 0, 500, (2.5, 0.0), number=1)
    found = find_slips(MINI, tie_points, residuals)
    assert [(s.sensor, s.axis) for s in found] == [("SU10", "columns"), ("SU00", "rows")]
    assert found[0].dx_px == pytest.approx(2.5, abs=0.05)
    assert found[1].dy_px == pytest.approx(1.0, abs=0.05)
    (only,) = find_slips(MINI, tie_points, residuals, sensors=("SU00",))
    assert only.sensor == "SU00"
    (first,) = find_slips(MINI, tie_points, residuals, settings=SlipSettings(max_rounds=1))
    assert first == found[0]


def test_points_without_residual_and_rejected_ones_do_no_harm() -> None:
    tie_points, residuals = points(1200)
    residuals = shifted(tie_points, residuals, 1, 300, 460, (3.0, -1.0))
    residuals[5::11] = np.nan
    residuals[3::17] += 300.0
    (slip,) = find_slips(MINI, tie_points, residuals)
    assert (slip.dx_px, slip.dy_px) == pytest.approx((3.0, -1.0), abs=0.06)


SLIP = Slip("SU00", "rows", 100, 200, 1.5, -2.0, 0.12, 40.0, 90)


def test_points_in_a_band_are_those_of_the_frame_between_its_ends() -> None:
    tie_points, _ = points(6)
    tie_points.raw_a[:, 1] = [99.9, 100.0, 100.0, 150.0, 200.0, 150.0]
    tie_points.raw_b[:, 1] = [150.0, 200.0, 150.0, 200.1, 10.0, 99.0]
    assert inside_slips(tie_points, (SLIP,)).tolist() == [False, True, True, False, True, False]
    assert inside_slips(tie_points, ()).tolist() == [False] * 6
    assert of_sensor(tie_points, "SU20").tolist() == [False, True] * 3
    assert of_sensor(tie_points, "SU10").tolist() == [True, False] * 3
    assert of_sensor(tie_points, "SU00").all() and not of_sensor(tie_points, "SU50").any()


@pytest.mark.parametrize(
    ("inside_at", "outside_at", "expected"),
    [((0.2, 0.0), (4.0, 1.0), (300, HEIGHT - 1)), ((4.0, 1.0), (0.2, 0.0), (0, 299))],
)
def test_of_two_parts_the_one_farther_from_its_calibrated_place_is_shifted(
    inside_at: tuple[float, float], outside_at: tuple[float, float], expected: tuple[int, int]
) -> None:
    tie_points, residuals = points(1200)
    moved = shifted(tie_points, residuals, 1, 0, 299, inside_at)
    moved = shifted(tie_points, moved, 1, 299.0001, HEIGHT, outside_at)
    slip = slip_of(MINI, tie_points, moved, "SU00")
    assert slip is not None
    assert (slip.first, slip.last) == pytest.approx(expected, abs=10)
    far, near = max(inside_at, outside_at), min(inside_at, outside_at)
    assert slip.dx_px == pytest.approx(far[0] - near[0], abs=0.06)
    assert slip.dy_px == pytest.approx(far[1] - near[1], abs=0.06)
    assert slip.share == pytest.approx((slip.last - slip.first + 1) / HEIGHT)
    assert slip.points == pytest.approx(rows_inside(tie_points, *expected), abs=10)


def test_of_a_band_in_the_middle_the_rest_stays_the_reference() -> None:
    tie_points, residuals = points(8000)
    moved = shifted(tie_points, residuals, 0, 0, WIDTH, (1.0, 1.0))
    moved = shifted(tie_points, moved, 0, 400, 700, (-1.0, -1.0))
    slip = slip_of(MINI, tie_points, moved, "SU00")
    assert slip is not None and slip.axis == "columns"
    assert (slip.first, slip.last) == pytest.approx((400, 700), abs=15)
    assert (slip.dx_px, slip.dy_px) == pytest.approx((-1.0, -1.0), abs=0.06)
    assert slip_of(MINI, *points(600), "SU00") is None


def test_columns_are_measured_by_the_width_of_the_frame() -> None:
    tie_points, residuals = points(1200)
    moved = shifted(tie_points, residuals, 0, 900, WIDTH, (0.3, 0.0))
    moved = shifted(tie_points, moved, 0, 0, 899.999, (3.0, 0.0))
    slip = slip_of(MINI, tie_points, moved, "SU00")
    assert slip is not None and (slip.axis, slip.first) == ("columns", 0)
    assert slip.last == pytest.approx(899, abs=15)
    assert slip.dx_px == pytest.approx(2.7, abs=0.06)
    assert slip.share == pytest.approx((slip.last + 1) / WIDTH)


def test_figures_name_the_first_slip_and_all_frames() -> None:
    other = Slip("SU10", "columns", 0, 9, 0.1, 0.0, 0.1, 20.0, 30)
    assert slip_figures(MINI, (SLIP, other)).as_json() == {
        "slip_sensor": "SU00",
        "slip_cone": "0",
        "slip_px": 2.5,
        "slip_axis": "rows",
        "slip_first": 100,
        "slip_last": 200,
        "slip_alternatives": None,
        "slip_sensors": "SU00, SU10",
    }
    assert set(slip_figures(MINI, ()).as_json().values()) == {None}


def test_residuals_are_as_sure_as_their_class_and_their_own_match() -> None:
    tie_points, _ = points(4000)
    rng = np.random.default_rng(4)
    tie_points.kind[2000:] = PAN_TO_COLOUR
    tie_points.sigma_px[:] = np.tile([0.1, 0.2, 0.4, 0.1, 0.2], 800)
    true = tie_points.sigma_px / 0.2 * np.where(tie_points.kind == PAN_TO_PAN, 0.3, 0.7)
    residuals = rng.normal(0.0, 1.0, (4000, 2)) * true[:, None]
    np.testing.assert_allclose(readout_slips._sigma_px(tie_points, residuals), true, rtol=0.06)
    still = readout_slips._sigma_px(tie_points, residuals * 1e-3)
    assert still == pytest.approx(np.full(4000, MIN_SIGMA_PX)) and MIN_SIGMA_PX == 0.02


@pytest.mark.parametrize(("first", "last"), [(0, 299), (500, HEIGHT)])
def test_the_other_part_begins_where_the_found_band_ends(first: int, last: int) -> None:
    tie_points, residuals = points(1200)
    moved = shifted(tie_points, residuals, 1, 0, HEIGHT, (4.0, 1.0))
    moved = shifted(tie_points, moved, 1, first, last, (-4.0, -1.0))
    (band,) = find_slips(MINI, tie_points, moved, sensors=("SU00",))
    other = slip_of(MINI, tie_points, moved, "SU00")
    assert other is not None
    ends = (band.last + 1, HEIGHT - 1) if first == 0 else (0, band.first - 1)
    assert (other.first, other.last) == ends
    assert (other.dx_px, other.dy_px) == (-band.dx_px, -band.dy_px)
    inside = int(inside_slips(tie_points, (band,)).sum())
    assert other.points == 1200 - inside


def worst(count: int, level: float, step: float) -> Slip | None:
    """What `_worst` makes of points one pixel apart, the first half of them shifted in x."""
    at = np.arange(count, dtype=np.float64)
    residuals = np.full((count, 2), level)
    residuals[: count // 2, 0] += step
    noise = 0.01 * np.random.default_rng(1).standard_normal((count, 2))
    sigma = np.full(count, 0.05)
    found = readout_slips._best_band(
        "SU00", "rows", count, at, residuals + noise, sigma, SlipSettings(), own_px=1.0
    )
    return None if found is None else found[0]


@pytest.mark.parametrize("level", [0.0, 3.0, -8.0])
def test_a_band_is_measured_against_the_rest_of_its_frame(level: float) -> None:
    """Wherever the frame lies as a whole."""
    slip = worst(280, level, 1.5)
    assert slip is not None and (slip.first, slip.last) == (0, 139)
    assert (slip.dx_px, slip.dy_px) == pytest.approx((1.5, 0.0), abs=0.01)
    assert slip.share == 0.5 and slip.points == 140


def test_half_of_four_bins_is_the_smallest_band() -> None:
    slip = worst(28, 0.0, 20.0)
    assert slip is not None and slip.points == 14
    assert worst(21, 0.0, 20.0) is not None
    assert worst(14, 0.0, 20.0) is None


@pytest.mark.parametrize(
    ("share", "kept"), [(0.04, 0.8848), (0.25, 0.4375), (0.5, 0.25), (0.75, 0.4375)]
)
def test_a_straight_line_leaves_this_much_of_a_step(share: float, kept: float) -> None:
    at = np.linspace(0.0, 1.0, 20001)
    step = (at < share).astype(np.float64)
    left = step - np.polyval(np.polyfit(at, step, 1), at)
    assert np.mean(left[at < share]) - np.mean(left[at >= share]) == pytest.approx(kept, abs=1e-3)
    assert remaining_share(share) == pytest.approx(kept)


def test_pixels_are_as_large_as_they_lie_in_the_virtual_image() -> None:
    rig = find_rig("dmc-mini")
    assert readout_slips._own_px(rig, "G") == pytest.approx(4.8, abs=1e-3)
    assert readout_slips._own_px(rig, rig.pan_cones[0].sensors[0].name) == pytest.approx(
        1.0, abs=1e-3
    )
    assert readout_slips._own_px(find_rig("midas-mini"), "nadir") == 1.0


@pytest.mark.parametrize(("own_px", "expected"), [(1.0, True), (2.2, True), (2.9, False)])
def test_a_band_moves_by_half_a_pixel_of_its_own_frame_or_is_no_slip(
    own_px: float, expected: bool
) -> None:
    """Of a sixth 58 % is left: 0.75 px are the least that pixels of 2.57 px can shift by."""
    at = np.arange(840.0)
    residuals = 0.01 * np.random.default_rng(2).standard_normal((840, 2))
    residuals[:140, 1] += 0.75
    sigma = np.full(840, 0.05)
    found = readout_slips._best_band(
        "SU00", "rows", 840, at, residuals, sigma, SlipSettings(), own_px=own_px
    )
    assert (found is not None) is expected


@pytest.mark.parametrize("shown_by", [(0,), (0, 1)])
def test_a_pan_frame_that_alone_shows_a_slip_of_green_is_named_as_well(
    shown_by: tuple[int, ...],
) -> None:
    count, rng = 1200, np.random.default_rng(9)
    sensor_a = np.arange(count) % 2
    raw = rng.uniform(0.0, 1.0, (count, 2)) * np.array([WIDTH - 1.0, HEIGHT - 1.0])
    tie_points = TiePoints(
        names=("SU00", "SU10", "G"),
        pairs=(("SU00", "G"), ("SU10", "G")),
        attempted=(count, count),
        sensor_a=sensor_a,
        sensor_b=np.full(count, 2),
        # Rows of the PAN frames at which the shift lies differ: only green has them side by side.
        raw_a=rng.permutation(raw),
        raw_b=raw,
        sigma_px=np.full(count, 0.1),
        correlation=np.ones(count),
        kind=np.full(count, PAN_TO_COLOUR),
        overlap=sensor_a,
    )
    residuals = rng.normal(0.0, 0.1, (count, 2))
    band = (raw[:, 1] >= 100) & (raw[:, 1] < 260)
    # The other frame has few points there.
    keep = ~band | (sensor_a == 0) | (np.arange(count) % 16 == 1)
    residuals[band & np.isin(sensor_a, shown_by), 1] += 2.0
    tie_points, residuals = tie_points.only(keep), residuals[keep]
    slip, *_ = find_slips(MINI, tie_points, residuals, sensors=("G",))
    assert slip.sensor == "G"
    assert slip.alternatives == (("SU00",) if shown_by == (0,) else ())
