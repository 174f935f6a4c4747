"""`python -m benchmarks.planted_regions`: parts of frames that show other ground, and who is named.

A quarter of the width and height of Level-1 frames of clean exposures gets the content of another
place, in a PAN frame and every colour frame of each rig over each ground.
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
from benchmarks.silent_errors.scenes import SCENES
from daemon.cli.benchmark.measurement import machine
from processing.geometry.placement import SensorPlacement
from processing.image.colour import ColourSettings, colour_heads, green_positions, register_band
from processing.matching.tie_points import TiePointSettings, match_tie_points
from processing.pipelines import stitched_stages
from processing.quality.other_ground import OtherGround, other_ground_regions
from processing.rig import Rig

Array = NDArray[Any]
Row = dict[str, Any]
Random = np.random.Generator

TEXTURED: Final = ("landscape", "fields", "shadow", "traffic")
"""Scenes with texture everywhere."""


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.planted_regions")
    add = parser.add_argument
    add("--exposures", type=int, default=1, help="Of each rig and scene (default: 1).")
    add("--seed", type=int, default=5, help="Seed for all random generators (default: 5).")
    add("--json", action="store_true", help="Print one JSON object.")
    given = parser.parse_args()
    rows = list(planted(given.exposures, given.seed))
    print(json.dumps({"machine": machine(), "parts": rows}) if given.json else summary(rows))


def planted(exposures: int, seed: int) -> Iterator[Row]:
    """Plant parts of other ground in exposures of every rig over every scene.

    Args:
        exposures: of each rig and scene.
        seed: for all random generators.

    Yields:
        Who is named where nothing is planted, and for each planted part.
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

    def searched(*given: Any, **others: Any) -> tuple[OtherGround, ...]:
        seen.append(given)
        return other_ground_regions(*given, **others)

    with patch.object(stitched_stages, "other_ground_regions", searched):
        remeasured(rig, light, 900 + number, scene=scene).process()
    of_rig, placements, frames = seen[0][:3]
    yield {"clean": _named(named_regions(of_rig, placements, frames))}
    pan = [s.name for cone in of_rig.pan_cones for s in cone.sensors]
    for name in (str(random.choice(pan)), *(h.sensor.name for h in colour_heads(of_rig))):
        changed = {**frames, name: with_other_part(frames[name], random)}
        named = _named(named_regions(of_rig, placements, changed))
        yield {"name": name, "pan": name in pan, "named": named, "found": name in named}


def named_regions(
    rig: Rig, placements: Mapping[str, SensorPlacement], frames: Mapping[str, Array]
) -> tuple[OtherGround, ...]:
    """Match Level-1 frames where they lie, and look for regions of other ground.

    Args:
        rig: the camera.
        placements: of the sensors, by name.
        frames: Level-1 words by sensor name.

    Returns:
        What `other_ground_regions` finds.
    """
    settings, colour = TiePointSettings(), ColourSettings()
    heads = colour_heads(rig)
    green = heads[0].sensor.name
    positions = green_positions(placements[green], frames[green], colour)
    registrations = [
        register_band(
            head.leading,
            placements[green],
            placements[head.sensor.name],
            frames[green],
            frames[head.sensor.name],
            positions=positions,
            settings=colour,
        )
        for head in heads[1:]
    ]
    points = match_tie_points(rig, placements, frames, settings=settings)
    return other_ground_regions(
        rig, placements, frames, points, registrations, settings=settings, colour=colour
    )


def with_other_part(frame: Array, random: Random) -> Array:
    """A frame with a sixteenth of its area from another place of it, turned upside down.

    Args:
        frame: Level-1 words, (h, w) uint16.
        random: where.

    Returns:
        (h, w) uint16.
    """
    height, width = frame.shape
    top = int(random.integers(20, height - height // 4 - 20))
    left = int(random.integers(0, width - width // 4))
    part = slice(top, top + height // 4), slice(left, left + width // 4)
    changed = frame.copy()
    changed[part] = np.roll(frame, (height // 2, width // 3), (0, 1))[::-1][part]
    return changed


def _named(regions: Sequence[OtherGround]) -> list[str]:
    return [name for region in regions[:1] for name in (region.sensor, *region.alternatives)]


def summary(rows: Sequence[Row]) -> str:
    """Markdown: found of planted by rig, frame and texture, and clean exposures with a name."""
    lines = [
        "| rig | frame | over texture everywhere | haze, coast, water, cloud |",
        "|---|---|---|---|",
    ]
    parts = [row for row in rows if "name" in row]
    kinds = dict.fromkeys((r["rig"], "PAN" if r["pan"] else r["name"]) for r in parts)
    for rig, kind in kinds:
        cells = []
        for textured in (True, False):
            some = [
                r["found"]
                for r in parts
                if (r["rig"], "PAN" if r["pan"] else r["name"]) == (rig, kind)
                and (r["scene"] in TEXTURED) is textured
            ]
            cells.append(f"{sum(some)} of {len(some)}")
        lines.append(f"| `{rig}` | {kind} | " + " | ".join(cells) + " |")
    wrong = [r for r in parts if r["named"] and not r["found"]]
    clean = [row for row in rows if "clean" in row]
    named = sum(bool(row["clean"]) for row in clean)
    lines += [
        "",
        f"Another frame named: {len(wrong)}. {len(clean)} exposures without a planted part: "
        f"{named} with a named frame.",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
