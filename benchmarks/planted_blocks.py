"""`python -m benchmarks.planted_blocks`: which blocks with another offset are found in a frame.

A quarter of the width and height of Level-1 frames of clean exposures gets more signal, in PAN and
colour frames of each rig over each ground. What is found is compared with the offset over the
texture of the frame, which is what the report states as `block_limit_dn`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from benchmarks.silent_errors.clean import FIRST, first_without_smear
from benchmarks.silent_errors.exposures import remeasured
from benchmarks.silent_errors.limits import DMC, L, X
from daemon.cli.benchmark.measurement import machine
from processing.image.line_means import line_means
from processing.pipelines import stitched_stages
from processing.quality.frame_blocks import BlockEdge, block_edges, edge_limits
from processing.radiometry.level1 import level1_counts_per_dn
from processing.rig import Rig, Sensor

Array = NDArray[Any]
Row = dict[str, Any]
Random = np.random.Generator

SCENES: Final = ("landscape", "fields", "shadow", "traffic", "haze")
SIZES_DN: Final = (20, 30, 40, 60, 80, 120, 160)
PAN_FRAMES: Final = 3
COLUMNS: Final = ("rig", "frames", *(f"{dn} DN" for dn in SIZES_DN))


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.planted_blocks")
    add = parser.add_argument
    add("--exposures", type=int, default=2, help="Of each rig and scene (default: 2).")
    add("--seed", type=int, default=5, help="Seed for all random generators (default: 5).")
    add("--json", action="store_true", help="Print one JSON object.")
    given = parser.parse_args()
    rows = list(planted(given.exposures, given.seed))
    print(json.dumps({"machine": machine(), "blocks": rows}) if given.json else summary(rows))


def planted(exposures: int, seed: int) -> Iterator[Row]:
    """Plant blocks in exposures of every rig over every scene.

    Args:
        exposures: of each rig and scene.
        seed: for all random generators.

    Yields:
        Outcomes of all blocks, and the frames that were named where nothing was planted.
    """
    random = np.random.default_rng(seed)
    number = 0
    for scene in SCENES:
        for rig in (X, L, DMC):
            for _ in range(exposures):
                number += 1
                print(f"exposure {number}: {rig} over {scene}", file=sys.stderr, flush=True)
                for row in _of_exposure(rig, scene, number, random):
                    yield {"rig": rig, "scene": scene, **row}


def _of_exposure(rig: str, scene: str, number: int, random: Random) -> Iterator[Row]:
    light = first_without_smear(rig, scene, FIRST + 10 * number)
    seen: list[Any] = []

    def searched(*given: Any) -> tuple[BlockEdge, ...]:
        seen.append(given)
        return block_edges(*given)

    with patch.object(stitched_stages, "block_edges", searched):
        remeasured(rig, light, 900 + number, scene=scene).process()
    of_rig, placements, frames, means, limits = seen[0]
    clean = block_edges(of_rig, placements, frames, means, limits)
    yield {"clean": [block.sensor for block in clean]}
    pan = [s.name for cone in of_rig.pan_cones for s in cone.sensors]
    some = random.choice(pan, min(PAN_FRAMES, len(pan)), replace=False)
    for name in (*some, *(n for n in frames if n not in pan)):
        sensor, lines = of_rig.sensor(name), means[name]
        counts = level1_counts_per_dn(sensor.bits)
        rows = (lines.first_row, lines.first_row + lines.by_row.shape[1] - 1)
        part = _quarter(sensor, rows, random)
        for dn in SIZES_DN:
            frame = _brighter(frames[name], part, round(dn * counts))
            changed = {**means, name: line_means(frame, rows)}
            found = block_edges(
                of_rig,
                placements,
                {**frames, name: frame},
                changed,
                {**limits, **_limits_of(of_rig, changed, name)},
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
    for rig in (X, L, DMC):
        for pan in (True, False):
            some = [r for r in blocks if r["rig"] == rig and r["pan"] is pan]
            cells = [_share([r for r in some if r["dn"] == dn]) for dn in SIZES_DN]
            lines.append(f"| `{rig}` | {'PAN' if pan else 'colour'} | " + " | ".join(cells) + " |")
    lines += ["", "| offset over the smallest step | found |", "|---|---|"]
    for low in (0.0, 1.0, 1.5, 2.0, 3.0, 4.5):
        high = {0.0: 1.0, 1.0: 1.5, 1.5: 2.0, 2.0: 3.0, 3.0: 4.5, 4.5: np.inf}[low]
        some = [r for r in blocks if low <= r["over_limit"] < high]
        label = f"{low:g} to {high:g}" if high < np.inf else f"{low:g} and more"
        lines.append(f"| {label} | {_share(some)} |")
    clean = [row for row in rows if "clean" in row]
    named = sum(bool(row["clean"]) for row in clean)
    lines += ["", f"{len(clean)} exposures without a planted block: {named} with a named frame."]
    return "\n".join(lines)


def _share(rows: Sequence[Row]) -> str:
    return f"{sum(r['found'] for r in rows)} of {len(rows)}"


if __name__ == "__main__":
    main()
