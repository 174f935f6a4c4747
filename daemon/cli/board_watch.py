"""`syntopic calibrate board --watch`: pictures as they arrive, and what is still missing."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

from daemon.terminal.console import Console

if TYPE_CHECKING:
    from daemon.postflight.calibration.board.pictures import PictureSet
    from processing.matching.calibration_board import CalibrationBoard
    from processing.rig import Rig

_POLL_S: Final = 0.3
_COMPLETE_AFTER_S: Final = 0.6
"""Age of a file's last change after which it counts as complete."""
_UNREADABLE_S: Final = 5.0


def watch_pictures(
    folder: Path, rig: Rig, board: CalibrationBoard, *, console: Console, timeout_s: float
) -> None:
    """Follow a folder until every head is covered, or no picture has arrived for `timeout_s`.

    Args:
        folder: into which pictures arrive.
        rig: the heads that take them.
        board: as drawn.
        console: where each picture and the requests are printed.
        timeout_s: wait without a new picture.

    Raises:
        BoardError: a picture that is of no head of the rig.
    """
    from daemon.postflight.calibration.board.pictures import (
        PictureSet,
        add_picture,
        picture_files,
    )
    from processing.matching.calibration_board import BoardError

    seen: set[Path] = set()
    pictures = PictureSet()
    last = time.monotonic()
    console.print(f"Waiting for pictures in {folder}; Ctrl-C ends.", soft_wrap=True)
    while time.monotonic() - last < timeout_s:
        for file in picture_files(folder, rig):
            if file.path in seen:
                continue
            age_s = time.time() - file.path.stat().st_mtime
            if age_s < _COMPLETE_AFTER_S:
                continue
            try:
                sentence = add_picture(pictures, file, rig.cone(file.head), board)
            except BoardError as error:
                if "cannot be read" in str(error) and age_s < _UNREADABLE_S:
                    continue
                sentence = str(error)
            seen.add(file.path)
            last = time.monotonic()
            console.print(sentence, markup=False, highlight=False, soft_wrap=True)
            requests = requests_of(pictures, rig, board)
            for request in requests:
                console.print(f"  {request}", style="yellow", markup=False, soft_wrap=True)
            if not requests:
                console.print("Every head is covered.", style="green")
                return
        time.sleep(_POLL_S)
    console.print(f"No new picture for {timeout_s:g} s.", style="yellow")


def requests_of(pictures: PictureSet, rig: Rig, board: CalibrationBoard) -> list[str]:
    """What to take next, one sentence for each head, and for heads without a common instant."""
    from daemon.postflight.calibration.board.pictures import common_exposures
    from processing.calibration.board.views import coverage_of, pose_of

    requests = []
    for cone in rig.cones:
        own = [view for view in pictures.views if view.head == cone.name]
        coverage = coverage_of(cone, own, [pose_of(cone, board, v.corners) for v in own])
        if coverage.missing:
            requests.append(f"{cone.name} needs {'; '.join(coverage.missing)}")
    if len(rig.cones) > 1 and common_exposures(pictures.views) < 5:
        requests.append(
            f"heads together: {common_exposures(pictures.views)} of 5 instants at which two "
            "heads see "
            "the board"
        )
    return requests
