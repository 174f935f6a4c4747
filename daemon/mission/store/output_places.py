"""Refusal of output places that hold what a command did not write.

A command replaces what an earlier run of it wrote, and nothing else: not the mission, not a file of
the same name by another program.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from re import Pattern

from daemon import DaemonError
from daemon.mission.layout import Mission

_HEAD_BYTES = 4096
_MISSION_FILE = "mission.json"


class OutputPlaceError(DaemonError):
    """An output place with content of somebody else; nothing was changed."""


def refuse_foreign_files(folder: Path, own: Pattern[str], *, cure: str = "") -> None:
    """Refuse a folder that will be replaced as a whole, but holds files of others.

    Args:
        folder: absent, empty, or with files of an earlier run only.
        own: matches paths, relative to the folder, of files that the command writes.
        cure: what else to do than to move it, such as "give another folder with --out".

    Raises:
        OutputPlaceError: it is a file, or holds a file that does not match.
    """
    if not folder.is_dir():
        if os.path.lexists(folder):
            raise OutputPlaceError(f"{folder} is there and no folder. {_move(cure)}")
        return
    for name in _files_of(folder):
        if not own.fullmatch(name):
            raise OutputPlaceError(
                f"{folder} holds {name}, which this command does not write; nothing was changed. "
                f"{_move(cure)}"
            )


def refuse_occupied(folder: Path, *, cure: str = "") -> None:
    """Refuse a folder for new files that is not empty.

    Raises:
        OutputPlaceError: it is a file, or holds something.
    """
    if folder.is_dir():
        with os.scandir(folder) as entries:
            first = next(entries, None)
        if first is not None:
            raise OutputPlaceError(
                f"{folder} is not empty; it holds {first.name}. Nothing was changed. {_move(cure)}"
            )
    elif os.path.lexists(folder):
        raise OutputPlaceError(f"{folder} is there and no folder. {_move(cure)}")


def refuse_foreign_file(path: Path, is_own: Callable[[bytes], bool], *, cure: str = "") -> None:
    """Refuse a file that will be replaced, but is not of this command.

    Args:
        path: absent, empty, or of an earlier run.
        is_own: of the first bytes of a file, whether this command wrote it.
        cure: what else to do than to move it, such as "give another name with --out".

    Raises:
        OutputPlaceError: it is something else.
    """
    if not os.path.lexists(path):
        return
    if not path.is_file():
        raise OutputPlaceError(f"{path} is there and no file. {_move(cure)}")
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if head and not is_own(head):
        raise OutputPlaceError(
            f"{path} was not written by this command; nothing was changed. {_move(cure)}"
        )


def refuse_mission_folder(folder: Path, mission: Mission, *, cure: str = "") -> None:
    """Refuse a folder that is a part of a mission other than one in its export, or contains one.

    Args:
        folder: for results.
        mission: that is read.
        cure: what to do.

    Raises:
        OutputPlaceError: it is.
    """
    place, source = folder.resolve(), mission.path.resolve()
    if source.is_relative_to(place):
        raise OutputPlaceError(f"{folder} contains the mission {source}; {cure}")
    for parent in (place, *place.parents):
        is_mission = parent == source or (parent / _MISSION_FILE).is_file()
        export = parent / mission.export_dir.name
        if is_mission and (place == export or not place.is_relative_to(export)):
            raise OutputPlaceError(
                f"{folder} is a part of the mission {parent}; results are in its export, or "
                f"elsewhere: {cure}"
            )


def _move(cure: str) -> str:
    return f"Move it, or {cure}" if cure else "Move it elsewhere"


def _files_of(folder: Path) -> Iterator[str]:
    """Relative paths of files, and of links, below a folder."""
    for where, folders, files in os.walk(folder):
        links = [name for name in folders if (Path(where) / name).is_symlink()]
        for name in sorted((*files, *links)):
            yield (Path(where) / name).relative_to(folder).as_posix()
