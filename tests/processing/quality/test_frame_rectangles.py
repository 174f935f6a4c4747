"""Rectangles with another offset: found by sharp sides, which a lens does not draw."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from processing.geometry.placement import nominal_placements, vip_mm_from_raw
from processing.image.line_means import LineMeans, line_means
from processing.quality.frame_blocks import (
    _Edge,
    _rectangle,
    _shows_elsewhere,
    block_edges,
    edge_limits,
)
from processing.quality.frame_rectangles import (
    Side,
    _bundles_between,
    changed_rectangles,
)
from processing.quality.ground_steps import GroundView
from processing.quality.sharp_changes import (
    SHARP,
    SHARP_BUNDLES,
    WINDOW,
    runs_of_sharp,
    sharp_lines,
    sizes_at,
)
from processing.rig import find_rig

pytestmark = pytest.mark.trust

Array = NDArray[Any]
RIG = find_rig("ultracam-x-mini")
SENSOR = RIG.sensor("SU11")
COUNTS = 8
"""Level-1 counts of one DN of 12 bits."""
STEP = 40 * COUNTS
ROWS, COLUMNS = (200, 407), (300, 611)


def _ground() -> Array:
    """Texture of 50 DN as a lens draws it, and photon noise, float64."""
    draw = np.random.default_rng(3)
    size = (SENSOR.height_px, SENSOR.width_px)
    texture = cv2.GaussianBlur(draw.normal(0.0, 1.0, size), (0, 0), 1.5)
    texture *= 50.0 * COUNTS / texture.std()
    return np.asarray(8000.0 + texture + draw.normal(0.0, 8.0 * COUNTS, size))


GROUND = _ground()


def _words(signal: Array) -> Array:
    return np.asarray(np.clip(np.rint(signal / 2.0) * 2.0, 2, 65534), np.uint16)


def _part(rows: tuple[int, int] = ROWS, columns: tuple[int, int] = COLUMNS) -> Array:
    part = np.zeros_like(GROUND)
    part[rows[0] : rows[1] + 1, columns[0] : columns[1] + 1] = 1.0
    return part


def _first(signal: Array) -> tuple[Side, ...]:
    lines = line_means(_words(signal), (0, SENSOR.height_px - 1))
    return next(changed_rectangles(SENSOR, lines), ())


def test_ground_as_a_lens_draws_it_has_no_rectangle() -> None:
    assert _first(GROUND) == ()


@pytest.mark.parametrize("sign", [-1, 1])
def test_all_four_sides_of_a_block_below_the_texture_are_found_to_the_line(sign: int) -> None:
    sides = _first(GROUND + sign * STEP * _part())
    found = {(side.axis, side.at): side.step for side in sides}
    assert set(found) == {
        ("rows", ROWS[0] - 1),
        ("rows", ROWS[1]),
        ("columns", COLUMNS[0] - 1),
        ("columns", COLUMNS[1]),
    }
    for (_, at), step in found.items():
        expected = sign * STEP if at in (ROWS[0] - 1, COLUMNS[0] - 1) else -sign * STEP
        assert step == pytest.approx(expected, rel=0.15)
    assert [side.sigmas for side in sides] == sorted((s.sigmas for s in sides), reverse=True)


def test_a_block_in_a_corner_of_the_frame_has_two_sides() -> None:
    sides = _first(GROUND + 3 * STEP * _part((0, 249), (0, 399)))
    assert {(side.axis, side.at) for side in sides} == {("rows", 249), ("columns", 399)}


def test_an_edge_that_a_lens_drew_is_no_side() -> None:
    assert _first(GROUND + 3 * STEP * cv2.GaussianBlur(_part(), (0, 0), 0.8)) == ()


def test_lines_around_a_place_are_no_rectangle() -> None:
    inner = _part((ROWS[0] + 1, ROWS[1] - 1), (COLUMNS[0] + 1, COLUMNS[1] - 1))
    assert _first(GROUND + 3 * STEP * (_part() - inner)) == ()


def test_a_step_along_one_side_alone_is_no_rectangle() -> None:
    ramp = np.clip((np.arange(SENSOR.height_px) - ROWS[0]) / 200.0, 0.0, 1.0)[:, None]
    fading = (1.0 - ramp) * _part((ROWS[0], SENSOR.height_px - 1))
    assert _first(GROUND + 3 * STEP * fading) == ()


@pytest.mark.parametrize("strength", [3.0, 10.0])
@pytest.mark.parametrize("turns", range(4))
def test_a_rectangle_whose_fourth_side_fades_inside_of_the_frame_is_none(
    turns: int, strength: float
) -> None:
    part = _part()
    columns = np.clip((np.arange(part.shape[1]) - COLUMNS[0]) / 200.0, 0.0, 1.0)
    faded = part * columns
    if turns % 2:
        rows = np.clip((np.arange(part.shape[0]) - ROWS[0]) / 150.0, 0.0, 1.0)
        faded = part * rows[:, None]
    if turns >= 2:
        faded = faded[::-1, ::-1]
    assert _first(GROUND + strength * STEP * faded) == ()


def test_a_side_with_a_gap_is_one_edge_and_distant_ones_are_two() -> None:
    sizes = np.zeros((60, 3), np.float32)
    has_run = np.zeros((2, 3), np.bool_)
    sizes[10:20, 1] = sizes[22:32, 1] = sizes[50:56, 1] = 2.0
    has_run[0, 1] = True
    runs, mean_sizes = runs_of_sharp(sizes, has_run, SHARP, WINDOW, SHARP_BUNDLES)
    assert runs.tolist() == [[1, 1, 10, 32], [1, 1, 50, 56]]
    assert mean_sizes[0] == pytest.approx(40.0 / np.sqrt(22.0))


def test_sharp_lines_are_those_with_enough_sharp_changes_among_neighbouring_bundles() -> None:
    draw = np.random.default_rng(9)
    means = draw.normal(3000.0, 10.0, (12, 75)).astype(np.float32)
    means[3:8, 41:] += 60.0
    means[6:9, 20:] -= 60.0
    over, marked = sharp_lines(means, SHARP, WINDOW, SHARP_BUNDLES)
    change = np.diff(means.astype(np.float64), axis=1)
    size = np.zeros(means.shape)
    size[:, 1:-2] = 1.5 * change[:, 1:-1] - 0.5 * (means[:, 3:] - means[:, :-3])
    blocks = [np.abs(size[:, at : at + 32]).mean(axis=1) for at in (0, 32, 64)]
    around = np.stack([blocks[0], *blocks, blocks[-1]], axis=1)
    sigma = 1.2533 * (around[:, :-2] + around[:, 1:-1] + around[:, 2:]) / 3.0 + 0.25
    assert over == pytest.approx(1.0 / sigma, rel=1e-4)
    size /= np.repeat(sigma, 32, axis=1)[:, :75]
    for sign, found in zip((1.0, -1.0), marked, strict=True):
        sharp = sign * size > SHARP
        hits = np.stack([sharp[k : k + WINDOW].sum(axis=0) for k in range(12 - WINDOW + 1)])
        assert np.array_equal(found, (hits >= SHARP_BUNDLES).any(axis=0))
    assert marked[0, 40] and not marked[1, 40]
    places = np.array([0, 20, 40, 73])
    assert sizes_at(means, over, places) == pytest.approx(size[:, places], abs=1e-3)


@pytest.mark.parametrize("length", [64, 850, 1250, 1286, 3328])
def test_every_bundle_lies_between_the_ends_of_its_line(length: int) -> None:
    bundles = min(39, length // 32)
    assert _bundles_between(0, length - 1, length // bundles, bundles) == (0, bundles)


def _seen(
    changed: str, among: str, *, outlined: str = ""
) -> tuple[GroundView, dict[str, LineMeans]]:
    """Frames over textured ground, where some have the same rectangle, and means of their lines.

    Of those that are outlined only two pixels along its sides are changed.
    """
    temperatures = {cone.probe: cone.calibration_c for cone in RIG.cones}
    placements = nominal_placements(RIG, temperatures, {})
    of_first = placements[changed.split()[0]]
    corners = [(COLUMNS[0] - 0.5, ROWS[0] - 0.5), (COLUMNS[1] + 0.5, ROWS[1] + 0.5)]
    ends = vip_mm_from_raw(of_first, np.array(corners))
    frames = {}
    for sensor in (RIG.sensor(name) for name in among.split()):
        rough = GROUND[: sensor.height_px, : sensor.width_px]
        signal = 8000.0 + 0.3 * (rough - 8000.0)
        if sensor.name in (changed + " " + outlined).split():
            rows, columns = np.indices(rough.shape)
            pixels = np.stack((columns.ravel(), rows.ravel()), axis=1).astype(np.float64)
            at = vip_mm_from_raw(placements[sensor.name], pixels)
            inside = (at >= ends.min(axis=0)).all(axis=1) & (at <= ends.max(axis=0)).all(axis=1)
            part = inside.reshape(rough.shape).astype(np.uint8)
            if sensor.name in outlined.split():
                part -= cv2.erode(part, np.ones((5, 5), np.uint8))
            signal = rough + float(STEP) * part
        frames[sensor.name] = _words(signal)
    means = {n: line_means(frame, (0, len(frame) - 1)) for n, frame in frames.items()}
    return GroundView(RIG, placements, frames), means


def _named(changed: str, among: str) -> list[str]:
    """Frames that are named of those that `_seen` makes."""
    view, means = _seen(changed, among)
    found = block_edges(RIG, view.placements, view.frames, means, edge_limits(RIG, means))
    return [block.sensor for block in found]


def test_a_block_below_the_texture_is_named_where_no_other_head_shows_it() -> None:
    assert _named("SU11", "SU11 R G B N") == ["SU11"]
    assert _named("R", "R G B N") == ["R"]


def test_a_rectangle_that_other_heads_show_is_ground() -> None:
    assert _named("R G B N", "R G B N") == []


@pytest.mark.parametrize(("shown", "named"), [(0.0, ["R"]), (1.0, [])])
def test_a_corner_is_none_where_one_of_its_sides_is_an_edge_of_the_ground(
    shown: float, named: list[str]
) -> None:
    temperatures = {cone.probe: cone.calibration_c for cone in RIG.cones}
    placements = nominal_placements(RIG, temperatures, {})
    edge_mm = vip_mm_from_raw(placements["R"], np.array([[399.5, 249.5]]))[0]
    frames = {}
    for name in "RGBN":
        sensor = RIG.sensor(name)
        rough = GROUND[: sensor.height_px, : sensor.width_px]
        rows, columns = np.indices(rough.shape)
        pixels = np.stack((columns.ravel(), rows.ravel()), axis=1).astype(np.float64)
        off = (vip_mm_from_raw(placements[name], pixels) - edge_mm).reshape(*rough.shape, 2)
        # Below the corner the other heads see more of the edge: mean shares are a third.
        part = shown * (off[..., 0] < 0.0) * np.where(off[..., 1] < 0.0, 1.3, 1.0)
        if name == "R":
            part = (rows < 250) * (columns < 400)
        frames[name] = _words(8000.0 + 0.3 * (rough - 8000.0) + 3.0 * STEP * part)
    means = {n: line_means(frame, (0, len(frame) - 1)) for n, frame in frames.items()}
    view = GroundView(RIG, placements, frames)
    sides = next(changed_rectangles(RIG.sensor("R"), means["R"]))
    assert {(side.axis, side.at) for side in sides} == {("rows", 249), ("columns", 399)}
    assert [block.sensor for block in _rectangle(view, RIG.sensor("R"), means["R"])] == named


def test_an_edge_that_another_head_shows_is_ground_whatever_lies_next_to_it() -> None:
    edge = _Edge("rows", ROWS[0] - 1, *COLUMNS, float(STEP), STEP / 8000.0)
    for outlined, expected in (("", False), ("G", True)):
        view, means = _seen("R", "R G B N", outlined=outlined)
        assert _shows_elsewhere(view, edge, "R", means) is expected


def test_a_rectangle_that_one_other_head_at_most_sees_is_not_decided() -> None:
    assert _named("R", "R G") == []


def test_a_small_frame_has_none() -> None:
    small = replace(SENSOR, width_px=120, height_px=20)
    lines = line_means(_words(GROUND[:20, :120]), (0, 19))
    assert not list(changed_rectangles(small, lines))
