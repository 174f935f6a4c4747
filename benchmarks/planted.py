"""Wrong inputs planted into Level-1 frames of clean exposures: what the benchmarks of them share.

Exposures of every rig over some scenes are processed once; what a step of the pipeline was given is
kept, so that the step can be repeated with changed frames.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from benchmarks.silent_errors.clean import FIRST, first_without_smear
from benchmarks.silent_errors.exposures import remeasured
from benchmarks.silent_errors.limits import DMC, L, X
from daemon.cli.benchmark.measurement import machine
from processing.pipelines import stitched_stages
from processing.rig import Rig

Array = NDArray[Any]
Row = dict[str, Any]
Random = np.random.Generator
Planter = Callable[["GivenStep", Random], Iterator[Row]]

RIGS: Final = (X, L, DMC)


@dataclass(frozen=True)
class GivenStep:
    """What a step of the pipeline was given for a clean exposure, and the frames among it."""

    rig: Rig
    arguments: tuple[Any, ...]
    frames: Mapping[str, Array]

    @property
    def pan(self) -> list[str]:
        """Names of the PAN sensors."""
        return [s.name for cone in self.rig.pan_cones for s in cone.sensors]


def run(
    program: str,
    step: str,
    scenes: Sequence[str],
    planted: Planter,
    summary: Callable[[Sequence[Row]], str],
    *,
    exposures: int,
) -> None:
    """The command of a benchmark: plant, and print a summary or JSON.

    Args:
        program: name of the module after `benchmarks`.
        step: function of `processing.pipelines.stitched_stages` whose arguments are kept.
        scenes: over which exposures are rendered.
        planted: plants into one exposure and yields outcomes.
        summary: of all outcomes, in Markdown.
        exposures: of each rig and scene, by default.
    """
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.{program}")
    add = parser.add_argument
    help_text = f"Of each rig and scene (default: {exposures})."
    add("--exposures", type=int, default=exposures, help=help_text)
    add("--seed", type=int, default=5, help="Seed for all random generators (default: 5).")
    add("--json", action="store_true", help="Print one JSON object.")
    given = parser.parse_args()
    rows = list(_rows(step, scenes, planted, given.exposures, given.seed))
    print(json.dumps({"machine": machine(), "rows": rows}) if given.json else summary(rows))


def _rows(
    step: str, scenes: Sequence[str], planted: Planter, exposures: int, seed: int
) -> Iterator[Row]:
    random = np.random.default_rng(seed)
    number = 0
    for scene in scenes:
        for rig in RIGS:
            for _ in range(exposures):
                number += 1
                print(f"exposure {number}: {rig} over {scene}", file=sys.stderr, flush=True)
                for row in planted(_given(step, rig, scene, number), random):
                    yield {"rig": rig, "scene": scene, **row}


def _given(step: str, rig: str, scene: str, number: int) -> GivenStep:
    """Process a clean exposure, and keep what the step was given."""
    light = first_without_smear(rig, scene, FIRST + 10 * number)
    function, seen = getattr(stitched_stages, step), list[tuple[Any, ...]]()

    def recorded(*arguments: Any, **others: Any) -> Any:
        seen.append(arguments)
        return function(*arguments, **others)

    with patch.object(stitched_stages, step, recorded):
        remeasured(rig, light, 900 + number, scene=scene).process()
    of_rig, _, frames = seen[0][:3]
    return GivenStep(of_rig, seen[0], frames)


def share(outcomes: Sequence[bool]) -> str:
    """So many of so many.

    Example:
        >>> share([True, False, True])
        '2 of 3'
    """
    return f"{sum(outcomes)} of {len(outcomes)}"
