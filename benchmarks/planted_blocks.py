"""`python -m benchmarks.planted_blocks`: which blocks with another offset are found in a frame.

A quarter of the width and height of Level-1 frames of clean exposures gets more signal, in PAN and
colour frames of each rig over each ground. What is found is compared with the offset over the
texture of the frame, which is what the report states as `block_limit_dn`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from benchmarks import planted
from benchmarks.planted import RIGS, Array, GivenStep, Random, Row, share
from processing.image.line_means import line_means
from processing.quality.frame_blocks import block_edges, edge_limits
from processing.radiometry.level1 import level1_counts_per_dn
from processing.rig import Rig, Sensor

SCENES: Final = ("landscape", "fields", "shadow", "traffic", "haze")
SIZES_DN: Final = (20, 30, 40, 60, 80, 120, 160)
PAN_FRAMES: Final = 3
COLUMNS: Final = ("rig", "frames", *(f"{dn} DN" for dn in SIZES_DN))


def main() -> None:
    planted.run("planted_blocks", "block_edges", SCENES, _of_exposure, summary, exposures=2)


def _of_exposure(given: GivenStep, random: Random) -> Iterator[Row]:
    rig, placements, frames, means, limits = given.arguments
    clean = block_edges(rig, placements, frames, means, limits)
    yield {"clean": [block.sensor for block in clean]}
    pan = given.pan
    some = random.choice(pan, min(PAN_FRAMES, len(pan)), replace=False)
    for name in (*some, *(n for n in frames if n not in pan)):
        sensor, lines = rig.sensor(name), means[name]
        counts = level1_counts_per_dn(sensor.bits)
        rows = (lines.first_row, lines.first_row + lines.by_row.shape[1] - 1)
        part = _quarter(sensor, rows, random)
        for dn in SIZES_DN:
            frame = _brighter(frames[name], part, round(dn * counts))
            changed = {**means, name: line_means(frame, rows)}
            found = block_edges(
                rig,
                placements,
                {**frames, name: frame},
                changed,
                {**limits, **_limits_of(rig, changed, name)},
            )
            yield {
                "name": str(name),
                "pan": name in pan,
                "dn": dn,
                "over_limit": dn * counts / max(limits[name]),
                "found": name in [block.sensor for block in found],
            }


def _limits_of(rig: Rig, means: Mapping[str, Any], name: str) -> Mapping[str, tuple[float, float]]:
    return edge_limits(rig, {name: means[name]})


def _quarter(sensor: Sensor, rows: tuple[int, int], random: Random) -> tuple[slice, slice]:
    height, width = sensor.height_px // 4, sensor.width_px // 4
    top = int(random.integers(rows[0], rows[1] - height))
    left = int(random.integers(0, sensor.width_px - width))
    return slice(top, top + height), slice(left, left + width)


def _brighter(frame: Array, part: tuple[slice, slice], counts: int) -> Array:
    """The frame with more signal in a part; saturated words stay as they are."""
    changed = frame.copy()
    words = changed[part].astype(np.int64)
    changed[part] = np.where(words & 1, words, np.minimum(words + counts // 2 * 2, 65534))
    return changed


def summary(rows: Sequence[Row]) -> str:
    """Markdown: found of planted by rig and size, and by size over the smallest step looked at."""
    lines = ["| " + " | ".join(COLUMNS) + " |", "|" + "---|" * len(COLUMNS)]
    blocks = [row for row in rows if "dn" in row]
    for rig in RIGS:
        for pan in (True, False):
            some = [r for r in blocks if r["rig"] == rig and r["pan"] is pan]
            cells = [share([r["found"] for r in some if r["dn"] == dn]) for dn in SIZES_DN]
            lines.append(f"| `{rig}` | {'PAN' if pan else 'colour'} | " + " | ".join(cells) + " |")
    lines += ["", "| offset over the smallest step | found |", "|---|---|"]
    for low in (0.0, 1.0, 1.5, 2.0, 3.0, 4.5):
        high = {0.0: 1.0, 1.0: 1.5, 1.5: 2.0, 2.0: 3.0, 3.0: 4.5, 4.5: np.inf}[low]
        found = [r["found"] for r in blocks if low <= r["over_limit"] < high]
        label = f"{low:g} to {high:g}" if high < np.inf else f"{low:g} and more"
        lines.append(f"| {label} | {share(found)} |")
    clean = [row for row in rows if "clean" in row]
    named = sum(bool(row["clean"]) for row in clean)
    lines += ["", f"{len(clean)} exposures without a planted block: {named} with a named frame."]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
