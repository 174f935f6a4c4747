"""Which file of a folder holds the frame of which sensor, where no record names the files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from daemon.mission.canonical_json import RecordError

SUFFIX = ".tif"
_SUFFIXES = (".tif", ".tiff")


def frame_files(folder: Path, sensors: Sequence[str]) -> dict[str, str]:
    """The TIFF of each sensor by its name, `.tif` or `.tiff` in any case (`SU30.TIF`).

    Args:
        folder: of one exposure.
        sensors: names of the rig's sensors.

    Returns:
        File name by sensor, in the order of `sensors`; sensors without a file are left out.

    Raises:
        RecordError: two files of one sensor, or a TIFF that names no sensor of the rig.
    """
    by_stem: dict[str, list[str]] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in _SUFFIXES:
            by_stem.setdefault(path.stem, []).append(path.name)
    found: dict[str, list[str]] = {name: by_stem.pop(name, []) for name in sensors}
    other_case = {name.casefold(): name for name in sensors if not found[name]}
    problems = []
    for stem, files in by_stem.items():
        sensor = other_case.get(stem.casefold())
        if sensor is None:
            problems += [
                f"{folder.name}/{file}: no sensor of the rig has this name; the rig has "
                f"{', '.join(sensors)}"
                for file in files
            ]
        else:
            found[sensor] += files
    problems += [
        f"{folder.name}: {' and '.join(files)} are both frames of {sensor}; keep one"
        for sensor, files in found.items()
        if len(files) > 1
    ]
    if problems:
        raise RecordError(problems)
    return {sensor: files[0] for sensor, files in found.items() if files}


def other_spelling(path: Path) -> str | None:
    """The file that differs from a missing one only in case or suffix; None where there is none."""
    try:
        names = sorted(other.name for other in path.parent.iterdir())
    except OSError:
        return None
    wanted = path.stem.casefold()
    return next(
        (
            name
            for name in names
            if Path(name).stem.casefold() == wanted and Path(name).suffix.lower() in _SUFFIXES
        ),
        None,
    )
