"""The stated coordinate system of a block: whether its coordinates are in metres, its frame."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

from daemon.mission.foreign_files import ForeignFileError, read_regular_file
from daemon.orientation.geodesy import CRS, CRSError
from daemon.orientation.local_frame import FRAME_FILE, LocalFrame
from daemon.postflight.exchange.block import BlockError

NOT_STATED: Final = "the files do not state the unit of coordinates"
_WKT_PATTERN: Final = "*.prj"
_WKT_MAX_BYTES: Final = 100_000


def is_in_metres(path: Path, system: str) -> bool:
    """Whether a coordinate system is one in metres; false where it is not understood.

    Args:
        path: of the files, for the message.
        system: name, code or WKT; of `<system>, heights ...` the first part.

    Raises:
        BlockError: a system in feet, degrees or another unit, in plan or in height.
    """
    name = system if "[" in system else system.split(",", 1)[0].strip()
    try:
        crs = CRS(name)
    except CRSError:
        return False
    units = {axis.unit_name for part in (crs.sub_crs_list or [crs]) for axis in part.axis_info}
    if units - {"metre"}:
        raise BlockError(
            f"{path}: coordinates of {crs.name} are in {', '.join(sorted(units))}, and metres are "
            "read; convert the orientations to a system in metres"
        )
    return bool(units)


def stated_system(folder: Path) -> str:
    """WKT of the one `*.prj` of a folder; empty without one, or with several.

    Raises:
        BlockError: the file cannot be read.
    """
    found = sorted(folder.glob(_WKT_PATTERN))
    if len(found) != 1:
        return ""
    try:
        return read_regular_file(found[0], _WKT_MAX_BYTES).decode("utf-8-sig", "replace").strip()
    except ForeignFileError as error:
        raise BlockError(str(error)) from error


def frame_next_to(file: Path) -> LocalFrame | None:
    """The local frame that `frame.json` next to a file states; None without.

    Raises:
        BlockError: it cannot be read.
    """
    path = file.parent / FRAME_FILE
    try:
        stated = json.loads(path.read_text("utf-8"))
        return LocalFrame(float(stated["latitude_deg"]), float(stated["longitude_deg"]))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BlockError(
            f"{path}: {error}; remove it, or take that of `syntopic triangulate`"
        ) from error
