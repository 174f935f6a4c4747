"""Pictures of a board on disk: which head, which instant, which corners, and what is wrong.

A folder for each head, or the name of the head at the beginning or the end of the file's name;
pictures of one instant have the same name otherwise.
"""

from __future__ import annotations

import hashlib
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.store.level0 import read_description
from processing.calibration.board.adjustment import LEAST_VIEWS
from processing.calibration.board.views import BoardView, same_views
from processing.matching.board_corners import find_corners, grey_picture
from processing.matching.calibration_board import BoardError, CalibrationBoard
from processing.rig import Cone, Rig

SUFFIXES: Final = (".tif", ".tiff", ".png", ".jpg", ".jpeg", ".bmp", ".pgm")
PICTURE_MAX_BYTES: Final = 1_000_000_000
_BLUR_FACTOR: Final = 1.6
_BLUR_PX: Final = 2.4
_MAX_LISTED: Final = 12

Progress = Callable[[str, int, int], None]


class BoardCalibrationError(DaemonError, ValueError):
    """A calibration from a board that is refused; the message states what is missing."""


@contextmanager
def board_refusals() -> Iterator[None]:
    """Make a board or pictures that cannot be used a refusal of the command.

    Raises:
        BoardCalibrationError: in place of BoardError, with its sentences.
    """
    try:
        yield
    except BoardError as error:
        raise BoardCalibrationError(str(error)) from error


@dataclass(frozen=True)
class PictureFile:
    """A file with the head that took it and the name of its instant."""

    path: Path
    head: str
    exposure: str


@dataclass
class PictureSet:
    """Views found so far, and sentences on pictures that are not used."""

    views: list[BoardView] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    reasons: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    digests: dict[str, PictureFile] = field(default_factory=dict)


def picture_files(folder: Path, rig: Rig) -> list[PictureFile]:
    """The pictures of a folder by head and instant.

    Args:
        folder: of the pictures.
        rig: whose heads took them; heads have one sensor each.

    Raises:
        BoardError: heads of several sensors, folders or files of no head, or no picture.
    """
    several = [cone.name for cone in rig.cones if len(cone.sensors) > 1]
    if several:
        raise BoardError(
            f"cone {', '.join(several)} of {rig.name} has several sensors; use `syntopic calibrate "
            "lab`, which finds the place of each"
        )
    if not folder.is_dir():
        raise BoardError(f"{folder} is no folder; give the folder of the pictures")
    heads = {cone.name: cone.name for cone in rig.cones}
    heads |= {sensor.name: cone.name for cone in rig.cones for sensor in cone.sensors}
    found, problems = [], []
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        if path.is_dir():
            own = [p for p in sorted(path.iterdir()) if p.suffix.lower() in SUFFIXES]
            if path.name in heads:
                found += [PictureFile(p, heads[path.name], p.stem) for p in own]
            elif own:
                problems.append(
                    f"folder {path.name} holds pictures and is no head of {rig.name}: "
                    f"{', '.join(heads)}"
                )
        elif path.suffix.lower() in SUFFIXES:
            named = _named_head(path.stem, heads)
            if named is not None:
                found.append(PictureFile(path, *named))
            elif len(rig.cones) == 1:
                found.append(PictureFile(path, rig.cones[0].name, path.stem))
            else:
                problems.append(
                    f"{path.name} names no head: put pictures into folders {', '.join(heads)}, or "
                    f"name them like 0001_{rig.cones[0].name}{path.suffix}"
                )
    if problems:
        raise BoardError(*_limited(problems))
    return found


def _named_head(stem: str, heads: Mapping[str, str]) -> tuple[str, str] | None:
    """Head and instant of a file's name."""
    for name in sorted(heads, key=len, reverse=True):
        match = re.fullmatch(rf"{re.escape(name)}[-_.](.+)|(.+)[-_.]{re.escape(name)}", stem)
        if match:
            return heads[name], match[1] or match[2]
    return None


def read_views(
    files: Sequence[PictureFile], rig: Rig, board: CalibrationBoard, *, progress: Progress
) -> PictureSet:
    """Find the corners of all pictures, and leave out what would spoil a calibration.

    Args:
        files: the pictures.
        rig: the heads that took them.
        board: as drawn.
        progress: called with what is done, and counts.

    Raises:
        BoardError: pictures of another size, of another head or unreadable; or too few usable
            ones, with the most frequent cause.
    """
    if not files:
        raise BoardError(
            f"no pictures; files of {', '.join(SUFFIXES)} are read, in a folder for each head"
        )
    found = PictureSet()
    problems: list[str] = []
    for k, file in enumerate(files):
        progress("corners", k, len(files))
        try:
            add_picture(found, file, rig.cone(file.head), board)
        except BoardError as error:
            problems += error.problems
    if problems:
        raise BoardError(*_limited(problems))
    _leave_out_blurred(found)
    _leave_out_repeated(found, board)
    _refuse_too_few(found, files)
    return found


def add_picture(found: PictureSet, file: PictureFile, cone: Cone, board: CalibrationBoard) -> str:
    """Read one picture and add its view; returns what it shows in one sentence.

    Raises:
        BoardError: it is not of this head.
    """
    where = f"{file.head}, picture {file.exposure}"
    pixels = _pixels(file, cone)
    digest = hashlib.sha256(pixels.tobytes()).hexdigest()
    other = found.digests.setdefault(digest, file)
    if other is not file:
        if other.head != file.head:
            raise BoardError(
                f"{where}: {file.path.name} is the same picture as {other.head}/{other.path.name}"
            )
        sentence = f"{where}: is the same picture as {other.exposure}"
        found.left_out.append(sentence)
        return sentence
    corners = find_corners(board, grey_picture(pixels, cone.sensors[0].colour_filter_array))
    if isinstance(corners, str):
        found.left_out.append(f"{where}: {corners}")
        found.reasons[file.head][corners] += 1
        return f"{where}: {corners}"
    found.views.append(BoardView(file.head, file.exposure, corners))
    return f"{where}: {len(corners.index)} corners"


def _pixels(file: PictureFile, cone: Cone) -> NDArray[Any]:
    sensor = cone.sensors[0]
    if file.path.stat().st_size > PICTURE_MAX_BYTES:
        raise BoardError(f"{file.path}: larger than {PICTURE_MAX_BYTES} bytes; not a picture")
    if file.path.suffix.lower() in (".tif", ".tiff"):
        named = read_description(file.path).get("sensor")
        if named is not None and named != sensor.name:
            raise BoardError(f"{file.path}: is a frame of {named}, not of {sensor.name}")
    flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        pixels = cv2.imdecode(np.frombuffer(file.path.read_bytes(), np.uint8), flags)
    except (OSError, cv2.error):
        pixels = None
    if pixels is None:
        raise BoardError(f"{file.path}: cannot be read as a picture; remove it or take it again")
    if pixels.shape[:2] != (sensor.height_px, sensor.width_px):
        height, width = pixels.shape[:2]
        raise BoardError(
            f"{file.path}: has {width} x {height} px, head {cone.name} {sensor.width_px} x "
            f"{sensor.height_px}: a picture of another head, scaled, cropped or rotated"
        )
    return np.asarray(pixels)


def _leave_out_blurred(found: PictureSet) -> None:
    for head in dict.fromkeys(view.head for view in found.views):
        own = [view for view in found.views if view.head == head]
        usual = float(np.nanpercentile([view.corners.edge_px for view in own], 25))
        limit = max(_BLUR_FACTOR * usual, _BLUR_PX)
        for view in own:
            if view.corners.edge_px > limit:
                _drop(
                    found,
                    view,
                    f"is blurred: edges of {view.corners.edge_px:.1f} px, the others of "
                    f"{usual:.1f} px; hold board and head still, or shorten the exposure",
                )


def _leave_out_repeated(found: PictureSet, board: CalibrationBoard) -> None:
    for head in dict.fromkeys(view.head for view in found.views):
        own = [view for view in found.views if view.head == head]
        for later, earlier in same_views(board, own):
            _drop(found, own[later], f"shows the board where {own[earlier].exposure} does")


def _drop(found: PictureSet, view: BoardView, reason: str) -> None:
    found.views.remove(view)
    found.left_out.append(f"{view.head}, picture {view.exposure}: {reason}")
    found.reasons[view.head][reason.partition(":")[0]] += 1


def _refuse_too_few(found: PictureSet, files: Sequence[PictureFile]) -> None:
    problems = []
    taken = Counter(file.head for file in files)
    for head, count in taken.items():
        usable = sum(view.head == head for view in found.views)
        if usable < LEAST_VIEWS:
            causes = [f"{n} x {text}" for text, n in found.reasons[head].most_common(3)]
            problems.append(
                f"{head}: {usable} of {count} picture{'s' * (count != 1)} can be used, "
                f"{LEAST_VIEWS} at least are needed (ten or more are better)"
                + (f". Pictures: {'; '.join(causes)}" if causes else "")
            )
    if problems:
        raise BoardError(*problems)


def common_exposures(views: Sequence[BoardView]) -> int:
    """How many instants have views of two heads or more."""
    heads = defaultdict(set)
    for view in views:
        heads[view.exposure].add(view.head)
    return sum(len(own) > 1 for own in heads.values())


def _limited(problems: Sequence[str]) -> list[str]:
    more = len(problems) - _MAX_LISTED
    return [*problems[:_MAX_LISTED], *([f"and {more} more"] if more > 0 else [])]
