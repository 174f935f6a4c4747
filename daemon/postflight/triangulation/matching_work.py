"""The work of matching a block: tie points of one image with all later ones that overlap it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daemon.mission.layout import Mission
from daemon.mission.store.level0 import read_description, read_tiff
from daemon.postflight.batch.batch_run import Compute, in_this_process
from daemon.postflight.batch.capacity import PROCESS_NBYTES
from daemon.postflight.batch.executor import BatchTask
from daemon.postflight.triangulation.block_heights import heights_of
from daemon.postflight.triangulation.triangulation import ImageBlock, TriangulationError
from processing.bundle.normal_equations import refuse_large_block
from processing.geometry.terrain_rays import HeightModel
from processing.matching.block_matching import (
    BlockMatching,
    BlockTiePoints,
    ImageMatches,
    joined_matches,
    match_image,
)
from processing.rig import VirtualImage

Array = NDArray[np.float64]
Picture = NDArray[np.float32]

CACHED_IMAGES = 12
PIXEL_NBYTES = 4


@dataclass(frozen=True)
class MatchedFile:
    """The raster of an image: `name` without suffix, in Level-2 of an exposure.

    `is_stitched`: it has PAN alone; of a head's the green band is taken, else the first.
    """

    exposure: int
    name: str
    is_stitched: bool


@dataclass(frozen=True)
class MatchingWork:
    """Images with start orientations in a local frame; the number of a task is that of its image.

    `station_m` (n, 3), `rotation` (n, 3, 3) from camera, `ground_m` the height of the ground,
    `heights` that of a height model.
    """

    mission: Mission
    image: VirtualImage
    files: Sequence[MatchedFile]
    station_m: Array
    rotation: Array
    ground_m: float
    settings: BlockMatching
    threads: int = 1
    heights: HeightModel | None = None

    @property
    def memory_nbytes(self) -> int:
        images = min(CACHED_IMAGES, len(self.files)) + 2
        return PROCESS_NBYTES + images * PIXEL_NBYTES * self.image.width_px * self.image.height_px

    def open(self) -> MatchingAction:
        """Load the kernels by matching two small images."""
        _match_noise(self.settings)
        return MatchingAction(self)


class MatchingAction:
    """Matches one image at a time; a dozen of images are kept in memory."""

    def __init__(self, work: MatchingWork) -> None:
        self._work = work
        self._images: OrderedDict[int, Picture] = OrderedDict()

    def clone(self) -> MatchingAction:
        """Another action with its own images."""
        return MatchingAction(self._work)

    def __call__(self, task: BatchTask) -> ImageMatches:
        """Places of the image's features in later images.

        Raises:
            RasterError: an image cannot be read.
        """
        work = self._work
        return match_image(
            task.number, self.pixels, work.image, work.station_m, work.rotation, work.ground_m,
            work.settings, work.heights,
        )  # fmt: skip

    def pixels(self, k: int) -> Picture:
        """Pixels of an image, NaN without data.

        Raises:
            RasterError: the image cannot be read.
        """
        if k in self._images:
            self._images.move_to_end(k)
            return self._images[k]
        work, file = self._work, self._work.files[k]
        path = work.mission.level2(file.exposure) / f"{file.name}.tif"
        bands = [] if file.is_stitched else read_description(path).get("bands", [])
        plane = bands.index("green") if "green" in bands else 0 if len(bands) > 1 else None
        pixels = read_tiff(
            path, width_px=work.image.width_px, height_px=work.image.height_px, plane=plane
        )
        self._images[k] = np.where(pixels == 0, np.nan, pixels).astype(np.float32)
        if len(self._images) > CACHED_IMAGES:
            self._images.popitem(last=False)
        return self._images[k]


def _match_noise(settings: BlockMatching) -> None:
    """Match two images of noise, so that kernels are loaded for the arguments of a block."""
    image = VirtualImage(400, 300, 10.0, 10.0)
    noise = np.random.default_rng(1).normal(8000.0, 500.0, (300, 400)).astype(np.float32)
    station_m = np.array([[0.0, 0.0, 100.0], [0.2, 0.0, 100.0]])
    rotation = np.tile(np.eye(3), (2, 1, 1))
    match_image(0, lambda _k: noise, image, station_m, rotation, 0.0, settings)


def match_mission_block(
    block: ImageBlock, settings: BlockMatching, compute: Compute = in_this_process
) -> BlockTiePoints:
    """Tie points of all overlapping images of a block.

    Args:
        block: whose images.
        settings: how to match.
        compute: where images are matched.

    Raises:
        NetworkError: more images than are adjusted at once; nothing is matched.
        TriangulationError: an image could not be matched, with the cause.
    """
    refuse_large_block(6 * len(block.names))
    work = _work(block, settings)
    done = compute(work, [BatchTask(k) for k in range(len(work.files))])
    if done.failures:
        causes = (f"{block.names[one.exposure]}: {one.cause}" for one in done.failures)
        raise TriangulationError(f"{block.mission.path}: not matched: {'; '.join(causes)}")
    return joined_matches([done.results[k] for k in range(len(work.files))])


def image_loader(block: ImageBlock, settings: BlockMatching) -> Callable[[int], Picture]:
    """Reads pixels of a block's images by index, NaN without data; keeps the latest dozen."""
    return _work(block, settings).open().pixels


def _work(block: ImageBlock, settings: BlockMatching) -> MatchingWork:
    files = [
        MatchedFile(eo.exposure, "pan" if eo.is_virtual else eo.cone, eo.is_virtual)
        for eo in block.oriented
    ]
    mission = Mission(block.mission.path.absolute(), block.mission.id)
    return MatchingWork(
        mission, block.image, files, block.station_m, block.rotation, block.ground_m, settings,
        heights=heights_of(block),
    )  # fmt: skip
