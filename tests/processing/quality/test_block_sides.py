"""The other sides of a block of which one edge is known."""

from __future__ import annotations

import numpy as np
import pytest

from processing.image.line_means import line_means
from processing.quality.block_sides import sides_of_blocks
from processing.quality.frame_blocks import BlockEdge
from processing.rig import find_rig

pytestmark = pytest.mark.trust

RIG = find_rig("ultracam-x-mini")
SENSOR = RIG.master_sensors[0]
TOP, LOW, LEFT, RIGHT = 200, 400, 150, 420


def test_the_four_sides_of_a_block_are_found_from_one() -> None:
    random = np.random.default_rng(5)
    frame = 8000.0 + random.normal(0.0, 40.0, (SENSOR.height_px, SENSOR.width_px))
    frame[TOP:LOW, LEFT:RIGHT] += 900.0
    means = {SENSOR.name: line_means(frame.astype(np.uint16), (0, SENSOR.height_px - 1))}
    edges = (
        BlockEdge(SENSOR.name, "rows", TOP - 1, LEFT - 10, RIGHT + 10, 112.0, 0.11, 0.0),
        BlockEdge(SENSOR.name, "columns", RIGHT - 1, TOP + 10, LOW - 10, -112.0, -0.11, 0.0),
    )
    sides = {("rows", TOP - 1), ("rows", LOW - 1), ("columns", LEFT - 1), ("columns", RIGHT - 1)}
    for edge in edges:
        found = sides_of_blocks(RIG, means, [edge])
        assert {(side.axis, side.at) for side in found} == sides
        assert {side.sensor for side in found} == {SENSOR.name}


def test_a_block_without_an_opposite_edge_has_the_known_one_alone() -> None:
    frame = np.full((SENSOR.height_px, SENSOR.width_px), 8000.0)
    frame[TOP:, LEFT:RIGHT] += 900.0
    means = {SENSOR.name: line_means(frame.astype(np.uint16), (0, SENSOR.height_px - 1))}
    edge = BlockEdge(SENSOR.name, "rows", TOP - 1, LEFT, RIGHT, 112.0, 0.11, 0.0)
    (side,) = sides_of_blocks(RIG, means, [edge])
    assert (side.axis, side.at, side.relative) == ("rows", TOP - 1, 0.11)
