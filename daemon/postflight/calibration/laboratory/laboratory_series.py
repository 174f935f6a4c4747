"""A laboratory series on disk: a folder with `series.json`, the rig file and images.

The keys of the images are declared by the calibration of each kind of series.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, ClassVar, Final, Generic, Literal, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Strict,
    ValidationError,
    ValidationInfo,
)

from daemon import DaemonError
from processing.rig import Rig, load_rig
from processing.rig.problem_sentences import findings_of, sentences, shown
from processing.rig.value_types import Flag, Text

SERIES_MAX_BYTES: Final = 50_000_000
_MAX_LISTED: Final = 20


class SeriesError(DaemonError, ValueError):
    """A series that cannot be used; one message a line for each mistake."""

    def __init__(self, problems: list[str]) -> None:
        more = len(problems) - _MAX_LISTED
        listed = problems[:_MAX_LISTED] + ([f"and {more} more"] if more > 0 else [])
        super().__init__("\n".join(listed))


class SeriesFile(BaseModel):
    """The keys of `series.json` that every kind of series has; `images` are of its kind."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    KIND: ClassVar[str]
    RENAMED: ClassVar[Mapping[str, str]] = {}
    """Former keys, and their present names."""

    format: Literal[1] = 1
    kind: Text
    date: Text
    source: Text = ""
    simulated: Flag = False
    serials: dict[str, Text] = {}


Series = TypeVar("Series", bound=SeriesFile)


@dataclass(frozen=True)
class LaboratorySeries(Generic[Series]):
    """A series of one kind with its rig; `file` is the content of `series.json`."""

    rig: Rig
    file: Series


def _path_in_folder(name: str, info: ValidationInfo) -> str:
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or not name:
        raise ValueError("it is a name within the folder")
    folder: Path = (info.context or {})["folder"]
    return str(folder / name)


def _sensor_of_rig(name: str, info: ValidationInfo) -> str:
    known: list[str] = (info.context or {})["sensors"]
    if name not in known:
        raise ValueError(f"a sensor of the rig is one of {', '.join(known)}")
    return name


PathInFolder = Annotated[Path, Strict(False), BeforeValidator(_path_in_folder)]
"""A file of the series; its name leaves the folder neither upwards nor to the root."""
SensorOfRig = Annotated[Text, AfterValidator(_sensor_of_rig)]


def read_series(folder: Path, model: type[Series]) -> LaboratorySeries[Series]:
    """Read `series.json` and `rig.toml` of a folder.

    Args:
        folder: holds both and the images.
        model: the keys of the kind of series that is needed.

    Raises:
        SeriesError: the list is missing, damaged, of another kind, or has mistakes: all of them.
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
    if isinstance(content, dict) and content.get("kind") != model.KIND:
        text = f"is {shown(content.get('kind'))}; this calibration takes {model.KIND!r}"
        raise SeriesError(sentences([(("kind",), text)], path.name))
    rig = load_rig(folder / "rig.toml")
    context = {"folder": folder, "sensors": [sensor.name for sensor in rig.sensors]}
    try:
        return LaboratorySeries(rig, model.model_validate(content, context=context))
    except ValidationError as error:
        raise SeriesError(sentences(findings_of(error, model.RENAMED), path.name)) from error


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
