"""The work of `syntopic orthomosaic`: cells of one image, then pixels of one tile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from daemon.mission.layout import Mission
from daemon.postflight.batch.batch_run import Compute, in_this_process
from daemon.postflight.batch.capacity import PROCESS_NBYTES
from daemon.postflight.batch.executor import BatchTask
from daemon.postflight.orthomosaic.cells import ImageCells, cells_of
from daemon.postflight.orthomosaic.inputs import (
    OrthoBlock,
    block_for_orthomosaic,
)
from daemon.postflight.orthomosaic.tiles import TileJob, store_tile
from daemon.postflight.orthomosaic.triangulated import OrthomosaicError

PIXEL_NBYTES: Final = 24
"""Of one pixel of an image that is read whole, with colour, its pansharpened bands and their
means."""


@dataclass(frozen=True)
class OrthomosaicRequest:
    """Files and options by which the inputs of an orthomosaic are collected; absolute paths.

    See `daemon.postflight.orthomosaic.inputs.block_for_orthomosaic`.
    """

    mission: Path
    triangulation: Path | None = None
    elevation: Path | None = None
    plane_height_m: float | None = None
    gsd_m: float | None = None
    crs: str | None = None
    trajectory_file: Path | None = None
    mount_file: Path | None = None

    def block(self) -> OrthoBlock:
        """Collect the inputs.

        Raises:
            OrthomosaicError: no usable images, no orientations, or a ground that does not fit.
        """
        options = {name: value for name, value in vars(self).items() if name != "mission"}
        return block_for_orthomosaic(Mission.open(self.mission), **options)


@dataclass(frozen=True)
class OrthomosaicWork:
    """What all images and tiles of an orthomosaic have in common.

    The payload of a task is the index of an image, or a `TileJob`. `key` is that of the inputs,
    `folder` has the tiles. `block` is as collected; another process collects it again and compares
    the key, in which versions of code and libraries are.
    """

    request: OrthomosaicRequest
    key: str
    bands: Sequence[str]
    folder: Path
    image_nbytes: int
    threads: int = 1
    block: OrthoBlock | None = None

    @property
    def memory_nbytes(self) -> int:
        return PROCESS_NBYTES + self.image_nbytes

    def open(self) -> OrthomosaicAction:
        """Collect the inputs.

        Raises:
            OrthomosaicError: they are not those of the command.
        """
        block = self.block
        if block is None:
            block = self.request.block()
            if block.key() != self.key:
                raise OrthomosaicError(
                    f"{self.request.mission}: a process found other inputs, code or libraries than "
                    "this command. Install the same versions on all machines, change no file "
                    "meanwhile, and run the same command again"
                )
        return OrthomosaicAction(self, block)

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "block": None}


class OrthomosaicAction:
    """Looks at one image, or makes one tile, at a time."""

    def __init__(self, work: OrthomosaicWork, block: OrthoBlock) -> None:
        self._work, self._block = work, block

    def clone(self) -> OrthomosaicAction:
        """The same: it has no buffers."""
        return self

    def __call__(self, task: BatchTask) -> ImageCells | None:
        """The cells of an image; of a tile nothing, for it is stored.

        Raises:
            RasterError: an image cannot be read.
            OSError: the disk refused.
        """
        work, block = self._work, self._block
        if isinstance(task.payload, TileJob):
            store_tile(block, work.bands, task.payload, work.folder)
            return None
        return cells_of(block, block.images[task.payload], work.bands)


def work_of(
    request: OrthomosaicRequest, block: OrthoBlock, bands: Sequence[str], folder: Path
) -> OrthomosaicWork:
    """The work on a block that was collected.

    Args:
        request: by which it was.
        block: what was found.
        bands: "pan", and colour bands that every image has.
        folder: of the tiles.
    """
    pixels = max(image.pose.width_px * image.pose.height_px for image in block.images)
    return OrthomosaicWork(
        request, block.key(), bands, folder.absolute(), PIXEL_NBYTES * pixels, block=block
    )


def survey_images(work: OrthomosaicWork, block: OrthoBlock, compute: Compute) -> list[ImageCells]:
    """What every image shows, in order.

    Args:
        work: on the block.
        block: whose images.
        compute: where they are looked at.

    Raises:
        OrthomosaicError: an image cannot be read.
    """
    done = compute(work, [BatchTask(k, k) for k in range(len(block.images))])
    if done.failures:
        causes = "; ".join(
            f"{block.images[one.exposure].name}: {one.cause}" for one in done.failures
        )
        raise OrthomosaicError(f"{block.mission.path}: {causes}")
    return [done.results[k] for k in range(len(block.images))]


def make_tiles(
    work: OrthomosaicWork, jobs: Sequence[TileJob], compute: Compute = in_this_process
) -> None:
    """Compute and store tiles.

    Args:
        work: on the block.
        jobs: tiles that are not stored.
        compute: where they are made.

    Raises:
        OrthomosaicError: a tile could not be made; those that are stored stay.
    """
    if not jobs:
        return
    done = compute(work, [BatchTask(k, job) for k, job in enumerate(jobs)])
    if done.failures:
        raise OrthomosaicError(
            f"{work.request.mission}: {len(done.failures)} of {len(jobs)} tiles were not made: "
            f"{done.failures[0].cause}. Tiles that are stored stay; run the same command again"
        )
