"""Whether the files of another program's block are whole, and what of them a project has not.

Counts that a file announces are compared with what was read. Where a format announces none, an
image without measurements, a point in fewer than two images and a last line without an end are
stated: a file that was cut has them.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.mission.foreign_files import open_regular_file
from daemon.postflight.exchange.block import Block, BlockError

_HEADER_NBYTES: Final = 8192
_ANNOUNCED: Final = re.compile(r"^# Number of (\w+): (\d+)(?:, mean .*?: (\S+))?\s*$", re.MULTILINE)
_COUNT_WITHIN: Final = 1e-5
"""Relative accuracy of a count computed from a mean that is written with six digits."""
_NAMED: Final = 5
_LINES_OF: Final[Mapping[str, tuple[str, ...]]] = {
    "colmap": ("cameras.txt", "images.txt", "points3D.txt", "rigs.txt", "frames.txt"),
    "opensfm": ("tracks.csv",),
    "bingo": ("*bingo*.txt", "*.dat", "orientation.bingo"),
    "patb": ("*.im", "*.ori"),
    "pix4d": ("*bingo*.txt", "*.dat", "*external_camera_parameters.txt"),
}
"""Files of lines in the folder of each program."""


def refuse_announced(path: Path, read: Mapping[str, int], observations: int | None = None) -> None:
    """Refuse a text file of COLMAP with other counts than its head announces.

    Args:
        path: the file.
        read: number of records that were read, by the word of the head ("images").
        observations: measurements of object points that were read; the head states their mean.

    Raises:
        BlockError: another number of records or measurements, with both numbers.
    """
    with open_regular_file(path, path.stat().st_size) as descriptor:
        head = os.read(descriptor, _HEADER_NBYTES).decode("utf-8", "replace")
    for what, count, mean in _ANNOUNCED.findall(head):
        if what not in read:
            continue
        if int(count) != read[what]:
            raise BlockError(
                f"{path}: announces {count} {what}, and {read[what]} are in it; it was cut or "
                f"edited: copy it again, or remove the line '# Number of {what}' from its head"
            )
        if mean and observations is not None:
            announced = round(float(mean) * int(count))
            if abs(announced - observations) > max(_COUNT_WITHIN * announced, 0.5):
                raise BlockError(
                    f"{path}: announces {announced} measurements, and {observations} were read; it "
                    f"was cut or edited: copy it again, or remove the line '# Number of {what}' "
                    "from its head"
                )


def refuse_other_tracks(
    folder: Path, measured: Sequence[tuple[int, int, int]], tracks: Sequence[tuple[int, int, int]]
) -> None:
    """Refuse a model whose points have other measurements than its images.

    Args:
        folder: of the model.
        measured: number of the point, number of the image and place in its line, by images.txt.
        tracks: the same by points3D.txt; none: the file states no tracks.

    Raises:
        BlockError: a measurement that only one of the two files has, with point and image.
    """
    if not tracks:
        return
    differing = sorted(set(measured) ^ set(tracks))
    if not differing:
        return
    point, image, _ = differing[0]
    holder, other = "points3D.txt", "images.txt"
    if differing[0] in set(measured):
        holder, other = other, holder
    raise BlockError(
        f"{folder}: {holder} has a measurement of point {point} in image {image}, which {other} "
        f"has not, and {len(differing)} measurements differ in all. One file was cut or edited, or "
        "they are of different models: copy all files of the model again"
    )


def refuse_other_images(folder: Path, file: str, listed: set[int], read: set[int]) -> None:
    """Refuse images that another file of the model lists and images.txt has not.

    Raises:
        BlockError: such images, with their numbers.
    """
    missing = sorted(listed - read)
    if missing:
        raise BlockError(
            f"{folder}: {file} lists {len(missing)} images that images.txt has not "
            f"({_listed([str(k) for k in missing])}); images.txt was cut, or the files are of "
            "different models: copy all files of the model again"
        )


def completeness_notes(path: Path, program: str, block: Block) -> tuple[str, ...]:
    """What the project of a block has not, and files whose last line has no end.

    Args:
        path: file or folder of the program.
        program: key of the reader.
        block: as read.

    Returns:
        Sentences with names.
    """
    notes = []
    points = block.points
    if len(points.image):
        bare = np.flatnonzero(np.bincount(points.image, minlength=len(block.images)) == 0)
        if len(bare):
            names = _listed([block.images[k].name for k in bare])
            notes.append(
                f"{len(bare)} of {len(block.images)} images have no measurement in the files: "
                f"{names}. If they should, a file was cut"
            )
        few = np.flatnonzero(_rays(block) < 2)
        if len(few):
            names = _listed([points.names[k] for k in few])
            notes.append(
                f"{len(few)} of {len(points.names)} points have fewer than two measurements and "
                f"are left out: {names}"
            )
    return (
        *notes,
        *(
            f"{file.name} ends within a line; if it was cut, copy it again"
            for file in _files_of_lines(path, program)
            if not _has_line_end(file)
        ),
    )


def _rays(block: Block) -> NDArray[np.int64]:
    return np.bincount(block.points.point, minlength=len(block.points.xyz_m))


def _files_of_lines(path: Path, program: str) -> list[Path]:
    if program in ("bundler", "bal"):
        return [path]
    folder = path if path.is_dir() else path.parent
    patterns = _LINES_OF.get(program, ())
    return sorted({file for pattern in patterns for file in folder.glob(pattern)})


def _has_line_end(path: Path) -> bool:
    size = path.stat().st_size
    with open_regular_file(path, size) as descriptor:
        return size == 0 or os.pread(descriptor, 1, size - 1) in (b"\n", b"\r")


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:_NAMED]) + (", ..." if len(names) > _NAMED else "")
