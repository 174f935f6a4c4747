"""Places of an orthomosaic: the folder of the results, and next to it the one of its tiles.

Tiles of an interrupted run stay in a folder that bears the hash of all inputs; those of other
inputs are removed.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from daemon.mission.layout import Mission
from daemon.mission.store import durable
from daemon.mission.store.output_places import refuse_foreign_files, refuse_mission_folder
from daemon.postflight.orthomosaic.triangulated import OrthomosaicError

WORK_SUFFIX: Final = ".work"
_CURE: Final = "give another folder with --out"
_RESULTS: Final = re.compile(
    r"(pan|rgb|cir)-(16|8)\.tif(\.aux\.xml|\.ovr|\.msk)?|orthomosaic\.json"
    r"|seams\.gpkg(-wal|-shm|-journal)?"
)
"""What is written, and what GDAL and SQLite put next to it."""
_TILES: Final = r"[0-9a-f]{24}-[a-z-]+"
_WORK: Final = re.compile(
    rf"{_TILES}/(\d+-\d+\.(npy|sha256)|\.[^/]+\.part)|[a-z]+-\d+\.plain\.tif[^/]*"
)


def refuse_foreign_places(final: Path, mission: Mission) -> None:
    """Refuse a folder, or a folder of tiles next to it, that holds what no orthomosaic has.

    Raises:
        OutputPlaceError: it does, or it is a part of a mission outside its export.
    """
    refuse_mission_folder(final, mission, cure=_CURE)
    refuse_foreign_files(final, _RESULTS, cure=_CURE)
    refuse_foreign_files(_work_of(final), _WORK, cure=_CURE)


@contextmanager
def work_folder(final: Path, key: str) -> Iterator[Path]:
    """The folder of the tiles with a key, held against other commands; others are removed.

    It stays when the block fails, and is removed when it ends.

    Args:
        final: folder of the results.
        key: of all that the tiles depend on.

    Raises:
        OrthomosaicError: another command makes the same orthomosaic.
        OSError: the disk refused.
    """
    work = _work_of(final)
    durable.make_directories(work)
    descriptor = os.open(work, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        _lock(descriptor, work, final)
        tiles = work / key
        durable.make_directories(tiles)
        for other in work.iterdir():
            if other != tiles:
                durable.remove_tree(other)
        yield tiles
        durable.remove_tree(work)
    finally:
        os.close(descriptor)


def _lock(descriptor: int, work: Path, final: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        is_held = work.stat().st_ino == os.fstat(descriptor).st_ino
    except (BlockingIOError, FileNotFoundError):
        is_held = False
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL):
            raise
        is_held = True  # a file system without locks
    if not is_held:
        raise OrthomosaicError(
            f"{final}: another command makes an orthomosaic there. Wait until it has ended, or "
            f"{_CURE}"
        )


def _work_of(final: Path) -> Path:
    return final.with_name(final.name + WORK_SUFFIX)
