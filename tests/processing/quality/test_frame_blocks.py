"""Edges of blocks: another offset all over, and lines of the ground that only look like an edge."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.geometry.placement import nominal_placements
from processing.image.line_means import LineMeans, line_means
from processing.quality import frame_blocks
from processing.quality.frame_blocks import (
    BlockEdge,
    _Edge,
    _steps_there,
    block_edges,
    edge_limits,
)
from processing.quality.ground_steps import Axis
from processing.rig import find_rig

Array = NDArray[Any]
RIG = find_rig("ultracam-x-mini")
TEMPERATURES = {cone.probe: cone.calibration_c for cone in RIG.cones}
SIGNAL = 8000
STEP = 1000
ROWS, COLUMNS = slice(96, 256), slice(96, 256)


def _frames() -> dict[str, Array]:
    return {s.name: np.full((s.height_px, s.width_px), SIGNAL, np.uint16) for s in RIG.sensors}


def _search(frames: dict[str, Array]) -> tuple[BlockEdge, ...]:
    means = {s.name: line_means(frames[s.name], (0, s.height_px - 1)) for s in RIG.sensors}
    placements = nominal_placements(RIG, TEMPERATURES, {})
    return block_edges(RIG, placements, frames, means, edge_limits(RIG, means))


def test_frames_of_one_signal_have_no_block() -> None:
    assert _search(_frames()) == ()


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("name", ["SU11", "R"])
def test_a_block_with_another_offset_is_found_with_its_step(name: str, sign: int) -> None:
    frames = _frames()
    frames[name][ROWS, COLUMNS] = SIGNAL + sign * STEP
    (block,) = _search(frames)
    assert block.sensor == name and abs(block.at + 0.5 - 95.5) in (0.0, 160.0)
    assert abs(block.relative) == pytest.approx(STEP / SIGNAL, rel=0.1)


def test_a_line_around_a_place_that_is_as_bright_as_before_is_no_block() -> None:
    frames = _frames()
    inner = frames["R"][98:254, 98:254].copy()
    frames["R"][ROWS, COLUMNS] = SIGNAL + STEP
    frames["R"][97:255, 97:255] = SIGNAL + 8 * STEP // 10
    frames["R"][98:254, 98:254] = inner
    assert _search(frames) == ()


def test_another_frame_steps_alike_only_at_the_same_line_and_by_as_much() -> None:
    sensor = RIG.sensor("R")
    by_column = np.full((13, sensor.width_px), float(SIGNAL), np.float32)
    by_column[3:8, 120:] += 600.0
    lines = LineMeans(by_row=np.zeros((0, 1), np.float32), by_column=by_column, first_row=0)
    pace = sensor.height_px // 13
    edge = _Edge("columns", 119, 3 * pace, 8 * pace - 1, 1000.0, 0.12)
    assert _steps_there(sensor, lines, edge)
    other = {
        "at": _Edge("columns", 118, 3 * pace, 8 * pace - 1, 1000.0, 0.12),
        "place": _Edge("columns", 119, 9 * pace, 13 * pace - 1, 1000.0, 0.12),
        "sign": _Edge("columns", 119, 3 * pace, 8 * pace - 1, -1000.0, -0.12),
        "size": _Edge("columns", 119, 3 * pace, 8 * pace - 1, 1300.0, 0.16),
        "axis": _Edge("rows", 119, 3 * pace, 8 * pace - 1, 1000.0, 0.12),
        "outside": _Edge("columns", sensor.width_px - 1, 0, 8 * pace, 1000.0, 0.12),
    }
    for what, elsewhere in other.items():
        assert not _steps_there(sensor, lines, elsewhere), what


def edge(axis: Axis, at: int, first: int, last: int, step: float) -> _Edge:
    return _Edge(axis, at, first, last, step, 0.1)


def meet(a: _Edge, b: _Edge) -> bool:
    """Two sides of one rectangle: opposite, or with a corner."""
    if not 1 / 3 < abs(a.step / b.step) < 3:
        return False
    if a.axis == b.axis:
        shared = min(a.last, b.last) - max(a.first, b.first)
        return a.step * b.step < 0 and 2 * shared > max(a.last - a.first, b.last - b.first)
    near = frame_blocks.NEAR_PX
    return min(abs(a.at - b.first), abs(a.at - b.last)) < near and (
        min(abs(b.at - a.first), abs(b.at - a.last)) < near
    )


@pytest.mark.parametrize("count", [0, 1, 2, 20, 200])
def test_edges_with_a_corner_or_an_opposite_one_are_found_among_many(count: int) -> None:
    draw = np.random.default_rng(count)
    edges = []
    for _ in range(count):
        first = int(draw.integers(0, 3000))
        step = float(draw.choice([-1, 1]) * draw.uniform(10, 80))
        last = first + int(draw.integers(50, 900))
        axis: Axis = "rows" if draw.random() < 0.5 else "columns"
        edges.append(edge(axis, int(draw.integers(0, 3000)), first, last, step))
    expected = [a for a in edges if any(meet(a, b) for b in edges if b is not a)]
    assert list(frame_blocks._cornered(edges)) == expected
    assert count < 20 or len(expected) > 0


def test_edges_next_to_others_along_the_same_axis_are_not_isolated() -> None:
    reach_px = 10.0
    alone, next_to, other_axis = (
        edge("rows", 500, 0, 99, 20.0),
        edge("rows", 1000, 0, 99, 20.0),
        edge("columns", 500, 0, 99, 20.0),
    )
    near = edge("rows", 1000 + round(frame_blocks.ISOLATED_REACH * reach_px) - 1, 0, 99, 20.0)
    every = [alone, next_to, other_axis, near]
    assert list(frame_blocks._isolated(every, every, reach_px)) == [alone, other_axis]
