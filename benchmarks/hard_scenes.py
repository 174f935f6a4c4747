"""`python -m benchmarks.hard_scenes`: evaluate scenes that are hard to stitch.

Each is rendered for `ultracam-x-mini` at a dC of 12 K and compared with the truth: the image is
right, or its report states that it is not to be trusted.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import cv2

from benchmarks.rendered import errors_of, process, radiometry_of, take, world_settings
from daemon.cli.benchmark.measurement import machine
from processing.pipelines.stitched import Pipeline, PipelineSettings, Product
from processing.quality.figures.stitching import (
    DisplacedSensorFigures,
    PoorestOverlapFigures,
    PrecisionFigures,
    SupportFigures,
    TiePointFigures,
)
from processing.quality.report import NO_FLAGS, Flag
from processing.rig import find_rig
from sim_hw.world.ground_types import GROUNDS
from sim_hw.world.snapshots import RigElectronics
from sim_hw.world.world import World

RIG = "ultracam-x-mini"
SEED = 5
DC_K = 12.0
RIGHT_PX = (0.05, 0.15)
"""Inner RMS and worst pixel of an image that counts as right."""
INFORMATIVE_FLAGS = Flag.TIE_POINTS | Flag.SIGMA0 | Flag.UNDEREXPOSED | Flag.OVEREXPOSED | Flag.BLUR
"""Flags of an image whose geometry must be checked."""
SIGMAS = 3.0
PICTURE_PX = 232
PICTURE_QUALITY = 60


@dataclass(frozen=True)
class HardScene:
    """A ground, what hides it, and what moved in the camera."""

    description: str
    ground: str = "landscape"
    cloud_over: str | None = None
    displaced_px: Mapping[str, tuple[float, float]] = field(default_factory=dict)


MOVED = {"SU02": (2.1, -2.1)}
SCENES: Mapping[str, HardScene] = {
    **{name: HardScene(ground.description, name) for name, ground in GROUNDS.items()},
    "cloud-corner": HardScene("a cloud under sensor SU00", cloud_over="SU00"),
    "cloud-side": HardScene("a cloud under sensor SU10", cloud_over="SU10"),
    "cloud-middle": HardScene("a cloud under sensor SU30", cloud_over="SU30"),
    "water-moved": HardScene("the sea, SU02 off by 3 px", "open-water", displaced_px=MOVED),
    "rows-moved": HardScene("rows, SU02 off by 3 px", "rows", displaced_px=MOVED),
    "traffic-moved": HardScene("traffic, SU02 off by 3 px", "traffic", displaced_px=MOVED),
}


@dataclass(frozen=True)
class Outcome:
    """One scene's figures; errors in PAN pixels, `stated_px` the report's sigma of a coordinate."""

    scene: str
    inner_rms_px: float
    inner_max_px: float
    absolute_rms_px: float
    absolute_max_px: float
    fixed_rms_px: float
    stated_px: float
    tie_points: int
    tie_points_min_overlap: int
    weak_sensors: str
    displaced: str
    flags: Flag
    verdict: str

    @property
    def right(self) -> bool:
        return self.inner_rms_px < RIGHT_PX[0] and self.inner_max_px < RIGHT_PX[1]

    @property
    def flagged(self) -> bool:
        return bool(self.flags & INFORMATIVE_FLAGS)

    @property
    def is_consistent(self) -> bool:
        """Whether the error is within three of the standard deviations stated."""
        return self.absolute_rms_px < SIGMAS * math.sqrt(2.0) * self.stated_px


class Camera:
    """The one camera that sees all scenes."""

    def __init__(self, scenes: Path, *, without: Collection[str] = ()) -> None:
        self.scenes, self.without = scenes, without
        first = World(world_settings(RIG, SEED))
        self.heads = RigElectronics(first, seed=1, without=without)
        self.pipeline = Pipeline(
            find_rig(RIG), radiometry_of(self.heads), PipelineSettings(baselines=True)
        )

    def evaluate(self, name: str) -> tuple[Outcome, Product]:
        """Render, stitch and evaluate a scene."""
        scene = SCENES[name]
        world = World(
            world_settings(
                RIG,
                SEED,
                dc_k=DC_K,
                ground=scene.ground,
                cloud_over=scene.cloud_over,
                displaced_px=dict(scene.displaced_px),
            )
        )
        exposure = take(world, self.scenes, without=self.without)
        product = process(self.pipeline, self.heads, exposure, seed=SEED)
        free, fixed = (errors_of(product.geometry[m], exposure.snapshot) for m in ("free", "fixed"))
        figures, flags = product.report.figures, product.report.flags
        if self.without:
            flags &= ~Flag.FRAME_MISSING
        points, poorest = figures.of(TiePointFigures), figures.of(PoorestOverlapFigures)
        outcome = Outcome(
            scene=name,
            inner_rms_px=float(free["inner_rms_px"]),
            inner_max_px=float(free["inner_max_px"]),
            absolute_rms_px=float(free["absolute_rms_px"]),
            absolute_max_px=float(free["absolute_max_px"]),
            fixed_rms_px=float(fixed["inner_rms_px"]),
            stated_px=float(figures.of(PrecisionFigures).stitched_sigma_px or math.nan),
            tie_points=(points.tie_points_pp or 0) + (points.tie_points_pc or 0),
            tie_points_min_overlap=poorest.tie_points_min_overlap or 0,
            weak_sensors=", ".join(figures.of(SupportFigures).resting_on_calibration),
            displaced=figures.of(DisplacedSensorFigures).displaced_sensor or "",
            flags=flags or NO_FLAGS,
            verdict=product.report.verdict.value,
        )
        return outcome, product


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.hard_scenes")
    add = parser.add_argument
    add("--scene", action="append", choices=list(SCENES), help="only these; repeat")
    add("--pictures", type=Path, help="folder for a small picture of each scene")
    add("--scene-cache", type=Path, help="folder where built scenes are kept")
    add("--json", action="store_true", help="print one JSON object")
    given = parser.parse_args()
    outcomes = []
    with tempfile.TemporaryDirectory(prefix="syntopic-hard-") as folder:
        camera = Camera(given.scene_cache or Path(folder))
        for name in given.scene or SCENES:
            outcome, product = camera.evaluate(name)
            outcomes.append(outcome)
            print(outcome, file=sys.stderr, flush=True)
            if given.pictures is not None:
                write_picture(product, given.pictures / f"{name}.jpg")
    if given.json:
        scenes = [asdict(o) | {"flags": _names(o.flags)} for o in outcomes]
        print(json.dumps({"machine": machine(), "scenes": scenes}))
    else:
        print(table(outcomes))
    sys.exit(0 if all((o.right or o.flagged) and o.is_consistent for o in outcomes) else 1)


def write_picture(product: Product, path: Path) -> None:
    """The quick look, small enough to be kept."""
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = product.quicklook
    height = round(PICTURE_PX * picture.shape[0] / picture.shape[1])
    small = cv2.resize(picture, (PICTURE_PX, height), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(path), small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, PICTURE_QUALITY])


def table(outcomes: Collection[Outcome]) -> str:
    """Markdown, a line for each scene."""
    lines = [
        "| scene | | inner RMS / worst | absolute RMS | stated sigma | fixed, inner RMS | "
        "tie points (poorest overlap) | rests on calibration | verdict and flags |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| `{o.scene}`: {SCENES[o.scene].description} | "
        f"![{o.scene}](../../images/hard-scenes/{o.scene}.jpg) | "
        f"{o.inner_rms_px:.3f} / {o.inner_max_px:.3f} | {o.absolute_rms_px:.3f} | "
        f"{o.stated_px:.3f} | {o.fixed_rms_px:.3f} | {o.tie_points:,} ({o.tie_points_min_overlap}) "
        f"| {_weak_sensors_text(o.weak_sensors)} | {o.verdict}{_flag_text(o)} |"
        for o in outcomes
    ]
    return "\n".join(lines)


def _weak_sensors_text(sensors: str) -> str:
    names = [name for name in sensors.split(", ") if name]
    return "all" if len(names) == 9 else ", ".join(names) or "–"


def _flag_text(outcome: Outcome) -> str:
    flagged = [f"`{name}`" for name in _names(outcome.flags)]
    if outcome.displaced:
        flagged.append(f"names {outcome.displaced}")
    return f": {', '.join(flagged)}" if flagged else ""


def _names(flags: Flag) -> list[str]:
    return [str(flag.name) for flag in flags]


if __name__ == "__main__":
    main()
