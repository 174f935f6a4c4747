"""The work of matching photographs: features of each, then matches of each with later ones.

Features are stored in a folder that all processes reach: those of one photograph have 4 MB, and
each is compared with a dozen others.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.mission.store.durable import make_directories, replace_file
from daemon.mission.store.level0 import RasterError
from daemon.postflight.batch.batch_run import BatchOutcome, StepCompute
from daemon.postflight.batch.capacity import PROCESS_NBYTES, usable_cores
from daemon.postflight.batch.executor import BatchTask
from daemon.postflight.triangulation.triangulation import TriangulationError
from processing.matching.photograph_tracks import ImageFeatures, features_of, match_photographs
from processing.rig import VirtualImage

Indices = NDArray[np.int64]
Pairs = dict[tuple[int, int], Indices]

DETECTOR_NBYTES: Final = 1_000_000_000
"""Scales of an image of 2,400 px and of its doubled one, in 32 bits."""

_RANGE_PERCENT: Final = (0.1, 99.9)
"""Of the words of a 16-bit photograph that become black and white: few fill all their bits."""
_SAMPLED: Final = 4


@dataclass(frozen=True)
class UnmatchedPhotograph:
    """A photograph whose features are to be found; payload of a task."""

    exposure: Exposure
    image: VirtualImage


@dataclass(frozen=True)
class PhotographMatchingWork:
    """The number of a task is that of its photograph, the payload itself or its partners.

    `folder` has the features of each photograph.
    """

    mission: Mission
    folder: Path
    largest_px: int
    threads: int = 1

    @property
    def memory_nbytes(self) -> int:
        return PROCESS_NBYTES + DETECTOR_NBYTES + 4 * self.largest_px

    def open(self) -> PhotographMatchingAction:
        """Nothing is loaded."""
        cv2.setNumThreads(self.threads)
        return PhotographMatchingAction(self)


class PhotographMatchingAction:
    """Finds features of one photograph, or compares one with its partners, at a time."""

    def __init__(self, work: PhotographMatchingWork) -> None:
        self._work = work

    def clone(self) -> PhotographMatchingAction:
        """The same: it has no buffers."""
        return self

    def __call__(self, task: BatchTask) -> Pairs:
        """Matches of a photograph with its partners; of features nothing, for they are stored.

        Raises:
            RasterError: the photograph cannot be read.
            OSError: the disk refused.
        """
        work, number = self._work, task.number
        if isinstance(task.payload, UnmatchedPhotograph):
            pixels = original_pixels(
                work.mission, task.payload.exposure, task.payload.image, grey=True
            )
            store_features(work.folder, number, features_of(np.asarray(pixels, np.uint8)))
            return {}
        partners: Sequence[int] = task.payload
        features = [stored_features(work.folder, k) for k in (number, *partners)]
        pairs = match_photographs(features, [(0, k) for k in range(1, len(features))])
        return {(number, partners[k - 1]): found for (_, k), found in pairs.items()}


def matched_photographs(
    mission: Mission,
    photographs: Sequence[UnmatchedPhotograph],
    candidates: Sequence[tuple[int, int]],
    compute: StepCompute,
) -> tuple[list[ImageFeatures], Pairs]:
    """Features of photographs, and consistent matches of pairs of them.

    Args:
        mission: of the photographs.
        photographs: all of them.
        candidates: pairs of their indices (a, b), a < b.
        compute: where the steps "features" and "matching" are computed.

    Returns:
        Features by photograph, without their descriptors; matches by pair.

    Raises:
        TriangulationError: a photograph cannot be read.
    """
    partners: dict[int, list[int]] = {}
    for a, b in candidates:
        partners.setdefault(a, []).append(b)
    largest_px = max(one.image.width_px * one.image.height_px for one in photographs)
    make_directories(mission.export_dir)
    with tempfile.TemporaryDirectory(prefix=".features-", dir=mission.export_dir) as folder:
        work = PhotographMatchingWork(mission, Path(folder), largest_px, usable_cores())
        tasks = [BatchTask(k, one) for k, one in enumerate(photographs)]
        _refuse_failures(compute("features")(work, tasks))
        done = compute("matching")(work, [BatchTask(a, of) for a, of in partners.items()])
        _refuse_failures(done)
        found = [stored_features(work.folder, k).px for k in range(len(photographs))]
    nothing = np.zeros((0, 128), np.float32)
    pairs = {
        pair: done.results[pair[0]][pair] for pair in candidates if pair in done.results[pair[0]]
    }
    return [ImageFeatures(px, nothing) for px in found], pairs


def store_features(folder: Path, number: int, features: ImageFeatures) -> None:
    """Store the features of a photograph; a second attempt replaces them.

    Args:
        folder: of all of them.
        number: of the photograph.
        features: of it.

    Raises:
        OSError: the disk refused.
    """
    content = BytesIO()
    np.savez(content, px=features.px, descriptors=features.descriptors)
    replace_file(folder / f"{number:06d}.npz", content.getvalue())


def stored_features(folder: Path, number: int) -> ImageFeatures:
    """The features of a photograph.

    Args:
        folder: of all of them.
        number: of the photograph.

    Raises:
        OSError: they are not there.
    """
    with np.load(folder / f"{number:06d}.npz") as content:
        return ImageFeatures(content["px"], content["descriptors"])


def original_pixels(
    mission: Mission, exposure: Exposure, image: VirtualImage, *, grey: bool
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Pixels of a photograph as its sensor wrote them, (h, w) grey or (h, w, 3) red, green, blue.

    Grey ones have 8 bits: of 16-bit files the range that is used. Colours have the file's bits.

    Raises:
        RasterError: no image, damaged, or of another size.
    """
    path = mission.level0(exposure.number) / exposure.frames[0].file
    # Quirk: IMREAD_COLOR_RGB with IMREAD_ANYDEPTH disorders 16-bit samples.
    # Upstream: no report known (2026-11-29); OpenCV 5.0, TIFF decoder.
    how = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR
    pixels = cv2.imread(str(path), how | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise RasterError(f"{path}: no image that can be decoded; copy the original again")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise RasterError(f"{path}: pixels of {pixels.dtype}; write it with 8 or 16 bits")
    if pixels.shape[:2] != (image.height_px, image.width_px):
        raise RasterError(
            f"{path}: {pixels.shape[1]} x {pixels.shape[0]} px; the camera has {image.width_px} x "
            f"{image.height_px} px"
        )
    if grey and pixels.dtype == np.uint16:
        low, high = np.percentile(pixels[::_SAMPLED, ::_SAMPLED], _RANGE_PERCENT)
        scale = 255.0 / max(float(high - low), 1.0)
        pixels = np.clip((pixels - np.float32(low)) * np.float32(scale), 0, 255).astype(np.uint8)
    return np.ascontiguousarray(pixels if grey else pixels[..., ::-1])


def _refuse_failures(outcome: BatchOutcome) -> None:
    if outcome.failures:
        raise TriangulationError("; ".join(failure.cause for failure in outcome.failures))
