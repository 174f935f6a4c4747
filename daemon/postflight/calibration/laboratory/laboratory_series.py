"""A laboratory series on disk: a folder with `series.json`, the rig file and images.

The list of images is checked completely, and all its mistakes are reported at once. Each
calibration reads the fields of its own kind of series.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Final

from daemon.errors import DaemonError
from processing.rig import Rig, load_rig
from processing.rig.toml_table import TomlTable

SERIES_FORMAT: Final = 1
SERIES_MAX_BYTES: Final = 50_000_000
_MAX_LISTED: Final = 20


class SeriesError(DaemonError, ValueError):
    """A series that cannot be used; one message a line for each mistake."""

    def __init__(self, problems: list[str]) -> None:
        more = len(problems) - _MAX_LISTED
        listed = problems[:_MAX_LISTED] + ([f"and {more} more"] if more > 0 else [])
        super().__init__("\n".join(listed))


@dataclass(frozen=True)
class LaboratorySeries:
    """Properties of the complete series. `table` answers for the keys of its kind, `images` are the
    single ones; `checked` ends the asking."""

    folder: Path
    rig: Rig
    date: str
    source: str
    simulated: bool
    serials: Mapping[str, str]
    table: TomlTable
    images: tuple[TomlTable, ...]

    def checked(self) -> None:
        """Refuse the series with every mistake found so far.

        Raises:
            SeriesError: a key was missing, of another kind, or unknown.
        """
        for image in self.images:
            image.refuse_unknown()
        self.table.refuse_unknown()
        if self.table.problems:
            raise SeriesError(self.table.problems)

    def file(self, image: TomlTable) -> Path:
        """The image's file."""
        return self.folder / within_folder(image, "file")


def within_folder(table: TomlTable, key: str) -> str:
    """A file name; it leaves the folder neither upwards nor to the root, else it is complained of
    and empty."""
    name = table.text(key)
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or not name:
        table.add_problem(key, "it is a name within the folder")
        return ""
    return name


def read_series(folder: Path, *, kind: str) -> LaboratorySeries:
    """Read `series.json` and `rig.toml` of a folder.

    Raises:
        SeriesError: the list is missing, damaged, or of another kind.
        processing.rig.RigError: the rig file cannot be used.
    """
    path = folder / "series.json"
    try:
        if path.stat().st_size > SERIES_MAX_BYTES:
            raise SeriesError([f"{path}: larger than {SERIES_MAX_BYTES} bytes; not a series"])
        content: Any = json.loads(path.read_bytes())
    except OSError as error:
        raise SeriesError(
            [f"{path}: cannot be read ({error.strerror}); give a folder with a series.json"]
        ) from error
    except (ValueError, RecursionError) as error:
        raise SeriesError([f"{path}: not valid JSON ({error})"]) from error
    if not isinstance(content, dict):
        raise SeriesError([f"{path}: holds no table; see docs/calibration.md"])
    problems: list[str] = []
    table = TomlTable(content, "", path.name, problems)
    if table.integer("format", SERIES_FORMAT) != SERIES_FORMAT:
        table.add_problem("format", f"this version reads format {SERIES_FORMAT}")
    found = table.text("kind")
    if found != kind:
        table.add_problem("kind", f"`syntopic calibrate {kind}` takes a series of kind {kind!r}")
        raise SeriesError(problems)
    serials = table.table("serials", optional=True)
    names = {name: serials.text(name, "") for name in serials.content}
    simulated = content.get("simulated", False) is True
    table.known_keys.add("simulated")
    return LaboratorySeries(
        folder=folder,
        rig=load_rig(folder / "rig.toml"),
        date=table.text("date"),
        source=table.text("source", ""),
        simulated=simulated,
        serials=names,
        table=table,
        images=tuple(table.tables("images")),
    )


def part_serials(rig: Rig, sensors: set[str]) -> dict[str, str]:
    """Serial numbers of the sensors named, of their lenses and probes, as the rig file has them."""
    result: dict[str, str] = {}
    for cone in rig.cones:
        for sensor in cone.sensors:
            if sensor.name in sensors:
                result[f"sensor {sensor.name}"] = sensor.serial
                result[f"lens {cone.name}"] = cone.lens.serial
                for probe in sorted({cone.probe, sensor.probe} - {""}):
                    result[f"probe {probe}"] = rig.probe_serials.get(probe, "")
    return result
