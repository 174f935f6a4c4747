"""`python -m benchmarks.planted_regions`: parts of frames that show other ground, and who is named.

A quarter of the width and height of Level-1 frames of clean exposures gets the content of another
place, in a PAN frame and every colour frame of each rig over each ground.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from benchmarks import planted
from benchmarks.planted import Array, GivenStep, Random, Row, share
from benchmarks.silent_errors.scenes import SCENES
from processing.geometry.placement import SensorPlacement
from processing.image.colour import ColourSettings, colour_heads, green_positions, register_band
from processing.matching.tie_points import TiePointSettings, match_tie_points
from processing.quality.other_ground import OtherGround, other_ground_regions
from processing.rig import Rig

TEXTURED: Final = ("landscape", "fields", "shadow", "traffic")
"""Scenes with texture everywhere."""


def main() -> None:
    step, scenes = "other_ground_regions", tuple(SCENES)
    planted.run("planted_regions", step, scenes, _of_exposure, summary, exposures=1)


def _of_exposure(given: GivenStep, random: Random) -> Iterator[Row]:
    rig, placements, frames = given.arguments[:3]
    yield {"clean": _named(named_regions(rig, placements, frames))}
    pan = given.pan
    for name in (str(random.choice(pan)), *(h.sensor.name for h in colour_heads(rig))):
        changed = {**frames, name: with_other_part(frames[name], random)}
        named = _named(named_regions(rig, placements, changed))
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
            cells.append(share(some))
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
