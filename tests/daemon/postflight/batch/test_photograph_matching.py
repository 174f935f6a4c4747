"""Photographs are matched on executors with the result of one call in this process."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from daemon.mission.layout import Mission
from daemon.postflight.batch.batch_run import (
    BatchOutcome,
    StepCompute,
    completed,
    in_this_process,
    run_batch,
)
from daemon.postflight.batch.executor import BatchExecutor, BatchTask, BatchWork
from daemon.postflight.batch.local_processes import LocalProcessExecutor
from daemon.postflight.triangulation.photograph_matching import (
    UnmatchedPhotograph,
    matched_photographs,
    original_pixels,
)
from daemon.postflight.triangulation.triangulation import TriangulationError
from processing.matching.photograph_tracks import features_of, match_photographs
from processing.rig import VirtualImage
from tests.daemon.postflight.batch.test_commands_on_executors import OtherProcess

Flown = tuple[Mission, list[UnmatchedPhotograph]]

IMAGE = VirtualImage(360, 270, 5.0, 5.0)
PAIRS = [(0, 1), (0, 2), (1, 3), (2, 3)]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Four photographs of one ground of blobs, each shifted by a third."""
    mission = Mission(tmp_path_factory.mktemp("field"), "field")
    noise = np.random.default_rng(5).normal(0.0, 1.0, (500, 900)).astype(np.float32)
    ground = cv2.GaussianBlur(noise, (0, 0), 2.5)
    grey = np.clip(128 + 45 * ground / ground.std(), 0, 255).astype(np.uint8)
    photographs = []
    for number in range(1, 5):
        left, top = 110 * (number - 1), 40 * (number % 2)
        mission.level0(number).mkdir(parents=True)
        pixels = grey[top : top + IMAGE.height_px, left : left + IMAGE.width_px]
        cv2.imwrite(str(mission.level0(number) / "C1.png"), pixels)
        exposure: Any = SimpleNamespace(number=number, frames=[SimpleNamespace(file="C1.png")])
        photographs.append(UnmatchedPhotograph(exposure, IMAGE))
    return mission, photographs


def on(executor: BatchExecutor) -> StepCompute:
    def compute(work: BatchWork, tasks: Sequence[BatchTask]) -> BatchOutcome:
        return completed(run_batch(executor, work, tasks))

    return lambda _step: compute


def matched(flown: Flown, compute: StepCompute) -> list[bytes]:
    features, pairs = matched_photographs(*flown, PAIRS, compute)
    assert not list(flown[0].export_dir.iterdir())  # the features are removed
    return [*(one.px.tobytes() for one in features), *(p.tobytes() for p in pairs.values())]


def test_matches_are_those_of_one_call(flown: Flown) -> None:
    mission, photographs = flown
    direct = [
        features_of(original_pixels(mission, one.exposure, one.image, grey=True))
        for one in photographs
    ]
    expected = match_photographs(direct, PAIRS)
    features, pairs = matched_photographs(mission, photographs, PAIRS, lambda _s: in_this_process)
    assert list(pairs) == list(expected) and len(pairs) >= 3
    assert all(np.array_equal(pairs[pair], expected[pair]) for pair in expected)
    for own, of_call in zip(features, direct, strict=True):
        np.testing.assert_array_equal(own.px, of_call.px)
    assert matched(flown, lambda _step: on(OtherProcess(1))("")) == matched(
        flown, lambda _step: in_this_process
    )


@pytest.mark.soak
def test_processes_match_with_the_same_bytes(
    flown: Flown,
) -> None:
    own = matched(flown, lambda _step: in_this_process)
    assert matched(flown, lambda _step: on(LocalProcessExecutor(2))("")) == own


def test_a_photograph_that_cannot_be_read_is_named(flown: Flown, tmp_path: Path) -> None:
    mission = Mission(tmp_path, "empty")
    with pytest.raises(TriangulationError, match=r"C1\.png: no image that can be decoded"):
        matched_photographs(mission, flown[1], PAIRS, lambda _step: in_this_process)
