"""Bundles of Bundler (`bundle.out`) and of Bundle Adjustment in the Large (BAL).

Both look along -z with y up, have f, k1, k2 for each image, and count image coordinates from the
middle of the image, x right, y up. Neither states the size of the images.

Source: Bundler v0.4 user's manual, "Output format and scene representation"; data format of the
page "Bundle Adjustment in the Large".
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon.mission.foreign_files import ForeignFileError, read_regular_file
from daemon.postflight.exchange.block import (
    Block,
    BlockCamera,
    BlockError,
    BlockImage,
    BlockPoints,
)
from daemon.postflight.exchange.block_check import is_rotation
from processing.geometry.forward_distortion import ForwardDistortion
from processing.geometry.rotation import rotations_from_vectors

Array = NDArray[np.float64]

BUNDLE_MAX_BYTES = 2_000_000_000
COUNT_MAX = 50_000_000
REACH_MAX_PX = 1e6
"""Distance of a measurement from the middle of its image that no camera has."""
_MARK = "# Bundle file v0.3"


class _EndsEarlyError(BlockError):
    """A number that is needed behind the last one of a file."""


def read_bundler(path: Path) -> Block:
    """Read a `bundle.out`; images without a focal length are left out.

    Raises:
        BlockError: not such a file, or one that ends early.
    """
    text = _text(path)
    if not text.startswith(_MARK):
        raise BlockError(f"{path}: does not begin with {_MARK!r}; give a bundle.out of Bundler")
    numbers = _numbers(path, text.partition("\n")[2])
    images, points = _count(path, numbers), _count(path, numbers)
    cameras: list[tuple[float, float, float]] = []
    found: list[tuple[str, Array, Array]] = []
    index: dict[int, int] = {}
    for k in range(images):
        f, k1, k2 = (next(numbers) for _ in range(3))
        rotation = np.array([next(numbers) for _ in range(9)]).reshape(3, 3)
        shift = np.array([next(numbers) for _ in range(3)])
        if f > 0.0:
            index[k] = len(found)
            if not is_rotation(rotation):
                raise BlockError(
                    f"{path}: image {k}: its matrix is no rotation (scaled, sheared or mirrored); "
                    "export the bundle again"
                )
            cameras.append((f, k1, k2))
            found.append((f"image{k:06d}", rotation, shift))
    xyz, seen = [], []
    for p in range(points):
        xyz.append([next(numbers) for _ in range(3)])
        for _ in range(3):
            next(numbers)
        for _ in range(_count(path, numbers)):
            image = _index(path, f"point {p}: image", next(numbers), images)
            next(numbers)
            x, y = (next(numbers) for _ in range(2))
            if image not in index:
                raise BlockError(
                    f"{path}: point {p} is seen by image {image}, which has no f; remove its "
                    "measurements"
                )
            seen.append((index[image], p, x, y))
    _refuse_rest(path, numbers)
    left_out = images - len(found)
    notes = (f"{left_out} images without a focal length are left out",) if left_out else ()
    return _block(path, cameras, found, xyz, seen, notes)


def read_bal(path: Path) -> Block:
    """Read a BAL problem (`problem-*.txt`).

    Raises:
        BlockError: not such a file, or one that ends early.
    """
    numbers = _numbers(path, _text(path))
    images, points, count = (_count(path, numbers) for _ in range(3))
    seen = []
    for _ in range(count):
        image, point, x, y = (next(numbers) for _ in range(4))
        seen.append(
            (
                _index(path, "an observation of image", image, images),
                _index(path, "an observation of point", point, points),
                x,
                y,
            )
        )
    cameras, found = [], []
    for k in range(images):
        values = [next(numbers) for _ in range(9)]
        rotation = rotations_from_vectors(np.array(values[:3]))
        cameras.append((values[6], values[7], values[8]))
        found.append((f"image{k:06d}", rotation, np.array(values[3:6])))
    xyz = [[next(numbers) for _ in range(3)] for _ in range(points)]
    _refuse_rest(path, numbers)
    return _block(path, cameras, found, xyz, seen, ())


def _block(
    path: Path,
    cameras: list[tuple[float, float, float]],
    found: list[tuple[str, Array, Array]],
    xyz: list[list[float]],
    seen: list[tuple[int, int, float, float]],
    notes: tuple[str, ...],
) -> Block:
    if not found:
        raise BlockError(f"{path}: no oriented image; there is nothing to import")
    distinct = list(dict.fromkeys(cameras))
    size = _size(path, seen)
    centre = ((size[0] - 1) / 2.0, (size[1] - 1) / 2.0)
    # Rays of Bundler are -p: with y down and z forward the polynomial is the same.
    models = tuple(
        BlockCamera(f"camera{k + 1}", *size, ForwardDistortion(f, f, *centre, k1=k1, k2=k2))
        for k, (f, k1, k2) in enumerate(distinct)
    )
    images = tuple(
        BlockImage(name, distinct.index(own), k, -rotation.T @ shift, np.asarray(rotation.T))
        for k, ((name, rotation, shift), own) in enumerate(zip(found, cameras, strict=True))
    )
    measured = np.array([(x + centre[0], centre[1] - y) for *_, x, y in seen]).reshape(-1, 2)
    points = BlockPoints(
        np.array(xyz).reshape(-1, 3),
        tuple(f"p{k}" for k in range(len(xyz))),
        np.array([image for image, *_ in seen], dtype=np.int64),
        np.array([point for _, point, *_ in seen], dtype=np.int64),
        measured,
    )
    return Block(
        path.stem, models, images, points=points,
        notes=(
            *notes,
            "the file states no size of the images: that of the measurements is used",
            "the file states neither the frame nor the scale of its coordinates",
        ),
        is_metric=False,
    )  # fmt: skip


def _size(path: Path, seen: list[tuple[int, int, float, float]]) -> tuple[int, int]:
    """Columns and rows about the middle that hold all measurements."""
    reach = np.abs(np.array([(x, y) for *_, x, y in seen]).reshape(-1, 2)).max(axis=0, initial=1.0)
    if reach.max() > REACH_MAX_PX:
        raise BlockError(
            f"{path}: a measurement is {reach.max():g} px from the middle of its image; "
            f"{REACH_MAX_PX:g} px are the limit: correct it, or export the file again"
        )
    return 2 * int(np.ceil(reach[0])) + 2, 2 * int(np.ceil(reach[1])) + 2


def _text(path: Path) -> str:
    try:
        return read_regular_file(path, BUNDLE_MAX_BYTES).decode("ascii", "replace")
    except ForeignFileError as error:
        raise BlockError(f"{error}") from error


def _numbers(path: Path, text: str) -> Iterator[float]:
    words = text.split()
    for at, word in enumerate(words, 1):
        try:
            value = float(word)
        except ValueError as error:
            if at == len(words) and not text[-1].isspace():
                # A number that was cut within, such as "-" or "1e".
                break
            raise BlockError(f"{path}: {word!r} where a number is needed") from error
        if not np.isfinite(value):
            raise BlockError(f"{path}: {word!r} where a finite number is needed")
        yield value
    raise _EndsEarlyError(f"{path}: ends before its last number; copy it again")


def _index(path: Path, what: str, value: float, count: int) -> int:
    if not (0 <= value < count and value == int(value)):
        raise BlockError(
            f"{path}: {what} {value:g}; whole numbers from 0 to {count - 1} are right: export the "
            "file again"
        )
    return int(value)


def _refuse_rest(path: Path, numbers: Iterator[float]) -> None:
    """Refuse numbers behind the last one that the counts announce."""
    try:
        value = next(numbers)
    except _EndsEarlyError:
        return
    raise BlockError(
        f"{path}: {value:g} is behind the last number that its counts announce; the counts or the "
        "numbers are wrong: export the file again"
    )


def _count(path: Path, numbers: Iterator[float]) -> int:
    value = next(numbers)
    if not (0 <= value <= COUNT_MAX and value == int(value)):
        raise BlockError(f"{path}: {value:g} where a count is needed")
    return int(value)
