"""The other sides of a block of which one edge is known: lines to which tie points may be drawn.

A block of a frame with another offset has an edge of opposite sign where it ends, and two across.
Matching takes edges that one of two frames shows for ground.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.image.line_means import BUNDLE_PX, LineMeans
from processing.quality.frame_blocks import BlockEdge
from processing.quality.ground_steps import Axis, LineStep
from processing.rig import Rig, Sensor

Array = NDArray[Any]

MIN_SHARE: Final = 0.5
"""Of the known edge, that the opposite one changes by."""


def sides_of_blocks(
    rig: Rig, means: Mapping[str, LineMeans], blocks: Sequence[BlockEdge]
) -> list[LineStep]:
    """The known edges of blocks and the other sides that the frames show.

    Args:
        rig: the camera.
        means: of Level-1 lines, by sensor name.
        blocks: by `frame_blocks.block_edges`.

    Returns:
        Lines of each block; those without an opposite edge have the known one alone.
    """
    return [
        side
        for block in blocks
        for side in _sides(block, rig.sensor(block.sensor), means[block.sensor])
    ]


def _sides(block: BlockEdge, sensor: Sensor, lines: LineMeans) -> list[LineStep]:
    sides = [LineStep(block.sensor, block.axis, block.at, block.relative)]
    across: Axis = "columns" if block.axis == "rows" else "rows"
    change, first_line = _change(sensor, lines, block.axis, block.first, block.last)
    at = block.at - first_line
    opposite = np.flatnonzero(-change * np.sign(change[at]) >= MIN_SHARE * abs(change[at]))
    for end in (opposite + first_line).tolist():
        sides.append(LineStep(block.sensor, block.axis, end, -block.relative))
        low, high = sorted((block.at, end))
        aside, first_aside = _change(sensor, lines, across, low, high)
        for corner in (block.first, block.last):
            near = max(corner - BUNDLE_PX - first_aside, 0)
            window = np.abs(aside[near : corner + BUNDLE_PX - first_aside])
            if len(window):
                line = near + int(np.argmax(window)) + first_aside
                sides.append(LineStep(block.sensor, across, line, block.relative))
    return sides


def _change(
    sensor: Sensor, lines: LineMeans, axis: Axis, first: int, last: int
) -> tuple[Array, int]:
    """Change from each line to the next between two of its pixels, and the first line's number."""
    along, number, length = lines.by_column, 0, sensor.height_px
    if axis == "rows":
        along, number, length = lines.by_row, lines.first_row, sensor.width_px
    pace = length // len(along)
    bundles = along[first // pace : last // pace + 1]
    return np.asarray(np.median(np.diff(bundles, axis=1), axis=0)), number
