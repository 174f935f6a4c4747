"""False alarms of healthy exposures: rendered over hard scenes, and drawn without rendering.

Each light serves several exposures, each with noise and calibration errors of its own. What a scene
itself does to an image (water without texture, haze) is expected; every other flag is a false
alarm.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.stats import chi2

from benchmarks.flags import MAX_TRUE_SMEAR_PX, true_smear_px
from benchmarks.silent_errors.cases import named_causes
from benchmarks.silent_errors.exposures import remeasured, retoned, world_of
from benchmarks.silent_errors.limits import DMC, MIDAS, L, X
from benchmarks.silent_errors.scenes import SCENES
from benchmarks.silent_errors.truth import CleanImage, compare
from processing.quality.report import Verdict

Row = dict[str, Any]

DRAWS: Final = 10
"""Exposures of one light."""
TONED_DRAWS: Final = 50
"""Drawn signals of one light."""
FIRST: Final = 100
RIGS: Final = (X, X, X, L, DMC)
"""Each light's rig in turn."""
STITCHED_LIGHTS: Final = 2 * len(RIGS) * len(SCENES)
"""Lights from this number on are of `midas-mini`, whose heads share no image."""


def clean_rows(count: int, seed: int, file: Path | None, *, toned: bool = False) -> Iterator[Row]:
    """Healthy exposures by seed; those that are in the file already are not rendered again.

    Args:
        count: exposures.
        seed: for all random generators.
        file: of rows, one JSON object a line.
        toned: many drawn signals of one light instead of a few read-outs of it as it is.
    """
    known = {}
    if file is not None and file.exists():
        known = {row["number"]: row for row in map(json.loads, file.read_text().splitlines())}
    for number in range(count):
        if number in known:
            yield known[number]
            continue
        row = clean_row(number, seed, toned=toned)
        if file is not None:
            with file.open("a") as out:
                out.write(json.dumps(row) + "\n")
        print(f"{number} {row['rig']} {row['scene']}: {row['alarm'] or 'none'}", file=sys.stderr)
        yield row


def clean_row(number: int, seed: int, *, toned: bool = False) -> Row:
    """One healthy exposure by number and seed: its flags, false alarms and normalised errors."""
    light = number // (TONED_DRAWS if toned else DRAWS)
    rig, scene = rig_and_scene(light)
    place = FIRST + 10 * light
    if rig != MIDAS:
        place = first_without_smear(rig, scene, place)
    draw = retoned if toned else remeasured
    emulated = draw(rig, place, seed * 1_000_000 + number, scene=scene)
    product = emulated.process()
    report = product.report
    found = compare(emulated, product, CleanImage())
    changing = [f.flag for f in report.findings if f.verdict is not Verdict.GOOD]
    unexpected = [str(f.name) for f in changing if not f & SCENES[scene].expected]
    named = {what: ", ".join(sorted(names)) for what, names in named_causes(report).items()}
    naming = [f"{what} {names}" for what, names in named.items() if changing]
    return {
        "number": number,
        "rig": rig,
        "scene": scene,
        "light": place,
        "verdict": report.verdict.value,
        "flags": ", ".join(str(flag.name) for flag in report.flags),
        "alarm": "; ".join([*unexpected, *naming]),
        "error_px": found.error_px,
        "stated_px": found.stated_px,
        "squares": None
        if found.normalised is None
        else float(np.sum(found.normalised.whitened**2)),
        "rank": 0 if found.normalised is None else len(found.normalised.whitened),
    }


def rig_and_scene(light: int) -> tuple[str, str]:
    """Rig and scene of a light by its number."""
    scenes = list(SCENES)
    if light >= STITCHED_LIGHTS:
        return MIDAS, scenes[light % len(scenes)]
    return RIGS[light % len(RIGS)], scenes[light // len(RIGS) % len(scenes)]


def first_without_smear(rig: str, scene: str, first: int) -> int:
    """The first exposure from `first` on without true smear: the mount's tremor smears some."""
    for number in range(first, first + 10):
        if true_smear_px(world_of(rig, number, scene), 0) < MAX_TRUE_SMEAR_PX:
            return number
    return first


def clean_summary(rows: Sequence[Row]) -> str:
    """Markdown: false alarms by scene, and normalised errors against chi-square."""
    lines = [
        "| scene | exposures | false alarms | mean square of normalised errors | 99.9 % interval "
        "| true px | stated px |",
        "|---|---|---|---|---|---|---|",
    ]
    for scene in (*SCENES, "all", "all without a flag"):
        some = [r for r in rows if r["scene"] == scene or scene.startswith("all")]
        if scene == "all without a flag":
            some = [r for r in some if not r["flags"]]
        placed = [r for r in some if r["rank"]]
        if not placed:
            continue
        rank = sum(r["rank"] for r in placed)
        low, high = (float(chi2.ppf(p, rank)) / rank for p in (0.0005, 0.9995))
        mean = sum(r["squares"] for r in placed) / rank
        true, stated = (
            float(np.sqrt(np.mean([r[key] ** 2 for r in placed])))
            for key in ("error_px", "stated_px")
        )
        alarms = sum(bool(r["alarm"]) for r in some)
        lines.append(
            f"| {scene} | {len(some)} | {alarms} | {mean:.3f} | {low:.3f} .. {high:.3f} "
            f"| {true:.3f} | {stated:.3f} |"
        )
    alarmed = Counter(f"{r['rig']} {r['scene']} {r['light']}: {r['alarm']}" for r in rows)
    lines += [
        f"{n} x {scene_text}" for scene_text, n in alarmed.items() if not scene_text.endswith(": ")
    ]
    return "\n".join(lines)
