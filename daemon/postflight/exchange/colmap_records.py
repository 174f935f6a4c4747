"""Records of COLMAP's model files as words: text, or binary with the same order of values.

Source: COLMAP documentation, "Output Format"; its `src/colmap/scene/reconstruction_io_binary.cc`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Final

from daemon.mission.foreign_files import ForeignFileError, read_regular_file
from daemon.postflight.exchange.block import BlockError

MODEL_MAX_BYTES: Final = 2_000_000_000
_MODELS: Final[Mapping[int, tuple[str, int]]] = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
}
"""Camera models by number, with their numbers of parameters."""
_SENSORS: Final = {0: "CAMERA", 1: "IMU"}
_NAME_MAX: Final = 4096
_ENDING: Final = {True: ".bin", False: ".txt"}


def is_binary(folder: Path) -> bool:
    """Whether a folder has a binary model and no text model."""
    return (folder / "cameras.bin").exists() and not (folder / "cameras.txt").exists()


def has_part(folder: Path, part: str) -> bool:
    """Whether a model has a part, such as "rigs"."""
    return _file(folder, part).exists()


def records(
    folder: Path, part: str, *, keeps_empty: bool = False
) -> Iterator[tuple[str, list[str]]]:
    """Place and words of every record of a part of a model, such as "images".

    Of a binary model they are those of the text model. An image has two records.

    Args:
        folder: of the model.
        part: "cameras", "images", "points3D", "rigs" or "frames".
        keeps_empty: empty lines of a text file, too.

    Raises:
        BlockError: no such file, or one that cannot be read.
    """
    path = _file(folder, part)
    if is_binary(folder):
        yield from _binary(path, part)
        return
    try:
        text = read_regular_file(path, MODEL_MAX_BYTES).decode("utf-8-sig")
    except (ForeignFileError, UnicodeDecodeError) as error:
        raise BlockError(f"{path}: {error}; a COLMAP model has this file") from error
    for number, line in enumerate(text.splitlines(), 1):
        if not line.startswith("#") and (keeps_empty or line.strip()):
            yield f"{path}, line {number}", line.split()


def _file(folder: Path, part: str) -> Path:
    return folder / f"{part}{_ENDING[is_binary(folder)]}"


class _Bytes:
    """Values of a binary file, one after the other, little-endian."""

    def __init__(self, path: Path) -> None:
        try:
            self._data = read_regular_file(path, MODEL_MAX_BYTES)
        except ForeignFileError as error:
            raise BlockError(f"{path}: {error}; a COLMAP model has this file") from error
        self._path, self._at = path, 0

    def take(self, kinds: str) -> tuple[int | float, ...]:
        """Values by the letters of `struct`."""
        one = struct.Struct("<" + kinds)
        if self._at + one.size > len(self._data):
            raise self.ends_early()
        values = one.unpack_from(self._data, self._at)
        self._at += one.size
        return values

    def count(self, kind: str, nbytes_each: int) -> int:
        """A number of records, which the rest of the file can hold."""
        (number,) = self.take(kind)
        if number * nbytes_each > len(self._data) - self._at:
            raise self.ends_early()
        return int(number)

    def name(self) -> str:
        """A text up to the next byte 0."""
        end = self._data.find(b"\0", self._at, self._at + _NAME_MAX)
        if end < 0:
            raise self.ends_early()
        text = self._data[self._at : end]
        self._at = end + 1
        try:
            return text.decode("utf-8")
        except UnicodeDecodeError as error:
            raise BlockError(f"{self._path}: a name that is no UTF-8; copy it again") from error

    def finish(self) -> None:
        """Refuse bytes behind the last record."""
        if rest := len(self._data) - self._at:
            raise BlockError(
                f"{self._path}: {rest} bytes behind its last record; it is of another version of "
                "COLMAP, or damaged: export the model again, or as text"
            )

    def ends_early(self) -> BlockError:
        return BlockError(
            f"{self._path}: ends before its last record, or is of another version of COLMAP; copy "
            "it again, or export the model as text"
        )


def _binary(path: Path, part: str) -> Iterator[tuple[str, list[str]]]:
    source = _Bytes(path)
    read, least_nbytes = _PARTS[part]
    for number in range(source.count("Q", least_nbytes)):
        for words in read(path, source):
            yield f"{path}, record {number + 1}", words
    source.finish()


def _words(values: tuple[int | float, ...]) -> list[str]:
    return [repr(value) for value in values]


def _camera(path: Path, source: _Bytes) -> Iterator[list[str]]:
    number, model, width, height = source.take("IiQQ")
    if int(model) not in _MODELS:
        raise BlockError(
            f"{path}: camera {number} has model {model}, which is not known; export the model as "
            "text"
        )
    name, count = _MODELS[int(model)]
    yield [str(number), name, str(width), str(height), *_words(source.take(f"{count}d"))]


def _image(_path: Path, source: _Bytes) -> Iterator[list[str]]:
    number, *pose, camera = source.take("I7dI")
    yield [str(number), *_words(tuple(pose)), str(camera), source.name()]
    count = source.count("Q", 24)
    yield _words(source.take("ddq" * count))


def _point(_path: Path, source: _Bytes) -> Iterator[list[str]]:
    head = source.take("Q3d3Bd")
    count = source.count("Q", 8)
    yield _words((*head, *source.take(f"{2 * count}I")))


def _rig(path: Path, source: _Bytes) -> Iterator[list[str]]:
    number, count = source.take("II")
    words = [str(number), str(count)]
    for sensor in range(int(count)):
        kind, identity = source.take("iI")
        words += [_sensor(path, int(kind)), str(identity)]
        if sensor > 0:
            (has_pose,) = source.take("B")
            words.append(str(has_pose))
            words += _words(source.take("7d")) if has_pose else []
    yield words


def _frame(path: Path, source: _Bytes) -> Iterator[list[str]]:
    number, rig, *pose, count = source.take("II7dI")
    words = [str(number), str(rig), *_words(tuple(pose)), str(count)]
    for _ in range(int(count)):
        kind, identity, data = source.take("iIQ")
        words += [_sensor(path, int(kind)), str(identity), str(data)]
    yield words


def _sensor(path: Path, kind: int) -> str:
    if kind not in _SENSORS:
        raise BlockError(
            f"{path}: a sensor of type {kind}; cameras (0) and inertial units (1) are known"
        )
    return _SENSORS[kind]


_PARTS: Final[Mapping[str, tuple[Callable[[Path, _Bytes], Iterator[list[str]]], int]]] = {
    "cameras": (_camera, 48),
    "images": (_image, 73),
    "points3D": (_point, 51),
    "rigs": (_rig, 8),
    "frames": (_frame, 68),
}
"""Reader of a record of each part, and its least number of bytes."""
