"""`python -m benchmarks.geometry_table`: stitched geometry against truth.

Over dC, displacement and scenes. Every exposure is rendered by the emulator (real imagery, relief,
lens, drift, TDI, PRNU, noise, the errors a calibration has) and evaluated by its truth; cone
rotations, the displaced master sensor and the direction of its displacement are drawn for each.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.rendered import (
    errors_of,
    process,
    radiometry_of,
    take,
    with_random_rotations,
    world_settings,
)
from daemon.cli.benchmark.measurement import machine
from processing.pipelines.stitched import Pipeline, PipelineSettings
from processing.rig import Rig, load_rig, shipped_rigs
from sim_hw.world.scene import Scene, open_scene
from sim_hw.world.snapshots import RigElectronics
from sim_hw.world.world import World

MINIS = tuple(f"ultracam-{name}-mini" for name in ("x", "xp", "d", "l", "lp"))
DC_K = (-20.0, -10.0, 0.0, 10.0, 20.0)
DISPLACED_PX = (0.0, 0.1, 0.3, 1.0, 3.0)
RETAIN_HEADS_BELOW_PX = 5000
"""The maps of the sensors of wider images would fill the memory."""
ROTATION_RAD = 0.3e-3
"""Standard deviation of the cones' rotations: what the shipped rig files have."""
BARS_PX = {"d": (0.05, 0.15), "x": (0.05, 0.15), "l": (0.10, 0.30)}
"""Inner RMS and worst by the letter after "ultracam-"."""


@dataclass(frozen=True)
class Row:
    """One exposure; errors in PAN pixels, `fixed` the earlier method on the same tie points."""

    rig: str
    scene: int
    dc_k: float
    displaced: str
    displaced_px: float
    inner_rms_px: float
    inner_max_px: float
    absolute_rms_px: float
    absolute_max_px: float
    fixed_rms_px: float
    fixed_max_px: float
    tie_points: int
    flags: str


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.geometry_table")
    add = parser.add_argument
    add("--rig", action="append", help="a stitched rig; repeat for several (default: the minis)")
    add("--dc", type=float, action="append", help="K above calibration; repeat (default: 5 steps)")
    add("--displaced", type=float, action="append", help="px; repeat (default: 0, 0.1, 0.3, 1, 3)")
    add("--scenes", type=int, default=2, help="differently quilted scenes for each")
    add("--scene-cache", type=Path, help="folder where built scenes are kept")
    add("--json", action="store_true", help="print one JSON object with every exposure")
    given = parser.parse_args()
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="syntopic-table-") as folder:
        for rig in given.rig or MINIS:
            rows += fly(
                rig,
                given.dc or DC_K,
                given.displaced or DISPLACED_PX,
                scenes=range(1, given.scenes + 1),
                cache=given.scene_cache or Path(folder),
            )
    if given.json:
        print(json.dumps({"machine": machine(), "rows": [asdict(row) for row in rows]}))
    else:
        print(tables(rows))
    sys.exit(1 if any(not within(row) for row in rows) else 0)


def fly(
    rig: str,
    dc_k: Sequence[float],
    displaced_px: Sequence[float],
    *,
    scenes: Iterable[int],
    cache: Path,
) -> list[Row]:
    """Render and evaluate one exposure for every dC, displacement and scene."""
    file = shipped_rigs()[rig]
    cache.mkdir(parents=True, exist_ok=True)
    heads: RigElectronics | None = None
    rows: list[Row] = []
    for number in scenes:
        scene: Scene | None = None
        for dc in dc_k:
            for size in displaced_px:
                seed = 1000 * number + len(rows)
                rotated_rig = with_random_rotations(
                    file, cache / f"{rig}-turned.toml", seed=seed, sigma_rad=ROTATION_RAD
                )
                moved = displacement(load_rig(rotated_rig), size, seed=seed)
                world = World(world_settings(rotated_rig, seed, dc_k=dc, displaced_px=moved))
                # Heads and scene do not depend on where the cones look.
                heads = heads or RigElectronics(
                    world, seed=1, keep=world.image.width_px < RETAIN_HEADS_BELOW_PX
                )
                if scene is None:
                    first = World(world_settings(rotated_rig, number))
                    scene = open_scene(first.scene_settings, cache)
                rows.append(evaluate(world, heads, scene, number=number, moved=moved, size_px=size))
                print(rows[-1], file=sys.stderr, flush=True)
    return rows


def displacement(rig: Rig, size_px: float, *, seed: int) -> dict[str, tuple[float, float]]:
    """One of the master cone's sensors moved by so much in a direction drawn from the seed."""
    random = np.random.default_rng([seed, 13])
    master = [sensor.name for sensor in rig.cone(rig.master_cone).sensors]
    name, angle = str(random.choice(master)), float(random.uniform(0.0, 2 * math.pi))
    return {name: (size_px * math.cos(angle), size_px * math.sin(angle))} if size_px else {}


def evaluate(
    world: World,
    heads: RigElectronics,
    scene: Scene,
    *,
    number: int,
    moved: Mapping[str, tuple[float, float]],
    size_px: float,
) -> Row:
    """Take, stitch and evaluate one exposure."""
    exposure = take(world, Path(), scene=scene)
    pipeline = Pipeline(world.rig, radiometry_of(heads), PipelineSettings(baselines=True))
    product = process(pipeline, heads, exposure, seed=world.settings.seed)
    free, fixed = (errors_of(product.geometry[m], exposure.snapshot) for m in ("free", "fixed"))
    return Row(
        rig=world.rig.name,
        scene=number,
        dc_k=world.settings.dc_k,
        displaced=next(iter(moved), ""),
        displaced_px=size_px,
        inner_rms_px=float(free["inner_rms_px"]),
        inner_max_px=float(free["inner_max_px"]),
        absolute_rms_px=float(free["absolute_rms_px"]),
        absolute_max_px=float(free["absolute_max_px"]),
        fixed_rms_px=float(fixed["inner_rms_px"]),
        fixed_max_px=float(fixed["inner_max_px"]),
        tie_points=len(product.tie_points),
        flags=", ".join(str(flag.name) for flag in product.report.flags),
    )


def within(row: Row) -> bool:
    """Whether an exposure keeps the bars of its rig."""
    rms, worst = BARS_PX[row.rig.removeprefix("ultracam-")[0]]
    return row.inner_rms_px < rms and row.inner_max_px < worst


def tables(rows: Sequence[Row]) -> str:
    """Markdown: a line for each rig, then for each rig dC against displacement."""
    lines = [
        "| rig | exposures | inner RMS, worst exposure | worst pixel | absolute RMS, worst "
        "exposure | fixed method, inner RMS | within the bars |",
        "|---|---|---|---|---|---|---|",
    ]
    for rig in dict.fromkeys(row.rig for row in rows):
        of_rig = [row for row in rows if row.rig == rig]
        fixed = [row.fixed_rms_px for row in of_rig]
        lines.append(
            f"| `{rig}` | {len(of_rig)} | {_worst(of_rig, 'inner_rms_px')} | "
            f"{_worst(of_rig, 'inner_max_px')} | {_worst(of_rig, 'absolute_rms_px')} | "
            f"{min(fixed):.3f} to {max(fixed):.3f} | {sum(map(within, of_rig))} |"
        )
    for rig in dict.fromkeys(row.rig for row in rows):
        lines += ["", *_table([row for row in rows if row.rig == rig])]
    return "\n".join(lines)


def _table(rows: Sequence[Row]) -> list[str]:
    sizes = sorted({row.displaced_px for row in rows})
    lines = [
        f"`{rows[0].rig}`: inner RMS / worst pixel / absolute RMS; the fixed method's inner RMS",
        "",
        "| dC | " + " | ".join(f"{size:g} px displaced" for size in sizes) + " |",
        "|---" * (len(sizes) + 1) + "|",
    ]
    for dc in sorted({row.dc_k for row in rows}):
        cells = []
        for size in sizes:
            found = [r for r in rows if r.dc_k == dc and r.displaced_px == size]
            worst: dict[str, Any] = {
                name: _worst(found, name)
                for name in ("inner_rms_px", "inner_max_px", "absolute_rms_px", "fixed_rms_px")
            }
            cells.append(
                "{inner_rms_px} / {inner_max_px} / {absolute_rms_px}; {fixed_rms_px}".format(
                    **worst
                )
                if found
                else ""
            )
        lines.append(f"| {dc:+g} K | " + " | ".join(cells) + " |")
    return lines


def _worst(rows: Sequence[Row], name: str) -> str:
    return f"{max((getattr(row, name) for row in rows), default=math.nan):.3f}"


if __name__ == "__main__":
    main()
