"""Rig files: read, validated with all mistakes at once, and found by name."""

from __future__ import annotations

import datetime
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    Strict,
    ValidationError,
)

from processing import ProcessingError
from processing.rig.model import (
    CALIBRATION_VALID_DAYS,
    IMAGE_MAX_PIXELS,
    UNCALIBRATED,
    Cone,
    Rig,
    Timing,
    VirtualImage,
)
from processing.rig.problem_sentences import (
    Finding,
    LineOf,
    Location,
    ProblemList,
    findings_of,
    key_of,
    line_finder,
    sentences,
    shown,
)
from processing.rig.toml_text import TomlError, read_toml
from processing.rig.value_types import Name, Positive, Text

RIG_FORMAT: Final = 1
CONES_MAX, SENSORS_MAX = 64, 256
DIRECTION: Final = "ideal_from_measured"
"""Of the lens corrections of a rig file; another one is refused."""


class RigError(ProblemList, ProcessingError, ValueError):
    """A rig file that cannot be used; `problems` holds one sentence for each mistake found."""


def _date(text: str) -> str:
    try:
        datetime.date.fromisoformat(text)
    except ValueError:
        raise ValueError("write YYYY-MM-DD") from None
    return text


def _of_a_calibration(text: str) -> str:
    if text.startswith(UNCALIBRATED):
        raise ValueError("leave out [calibration] for a rig that is uncalibrated")
    return text


def _fitting(image: VirtualImage) -> VirtualImage:
    """An image of as many pixels as fit into memory, and of whole colour pixels."""
    if image.width_px * image.height_px > IMAGE_MAX_PIXELS:
        raise ValueError(f"width_px times height_px is {IMAGE_MAX_PIXELS} at most")
    if not 1 <= image.colour_width_px * image.colour_height_px <= IMAGE_MAX_PIXELS:
        raise ValueError(f"the colour image has 1 to {IMAGE_MAX_PIXELS} pixels; see colour_ratio")
    for key in ("width_px", "height_px"):
        colour_px = getattr(image, key) / image.colour_ratio
        if not isinstance(image.colour_ratio, int) and abs(colour_px - round(colour_px)) > 1e-6:
            raise ValueError(f"{key} is no multiple of a colour_ratio of {image.colour_ratio:g}")
    return image


ConeName = Annotated[Text, AfterValidator(lambda name: name or None)]
"""The name of a cone, or an empty text where there is none."""


class _Table(BaseModel):
    model_config = ConfigDict(
        extra="forbid", frozen=True, defer_build=True, use_attribute_docstrings=True
    )


class CalibrationTable(_Table):
    """The calibration of a rig; it is trusted for `valid_days` after its date.

    A rig without this table is uncalibrated: its values are nominal, and no exposure is `good`.
    """

    id: Annotated[Text, AfterValidator(_of_a_calibration)]
    """Name of the calibration."""
    date: Annotated[Text, AfterValidator(_date)]
    """Date of the calibration, YYYY-MM-DD."""
    valid_days: Annotated[int, Strict(), Field(ge=1, le=2**53)] = CALIBRATION_VALID_DAYS
    """Days after which exposures are flagged `CALIBRATION_EXPIRED`."""


class DefaultsTable(_Table):
    """Values for all lenses and sensors that have none of their own."""

    lens: dict[str, Any] = {}
    """Keys of a lens, for every lens that has none of its own."""
    sensor: dict[str, Any] = {}
    """Keys of a sensor, for every sensor that has none of its own."""


class RigFile(_Table):
    """A camera of several heads (docs/reference/formats.md)."""

    format: Literal[1] = 1
    """Version of the format."""
    name: Name
    """Name of the rig, of its missions and records."""
    title: Text = ""
    """Name for people."""
    timing: Timing
    """Whether cones fire at one place (syntopic) or at one instant (synchronous)."""
    frame_interval_s: Positive
    """Shortest time between two exposures."""
    master_cone: ConeName | None = None
    """Cone of the virtual image plane, or from which angles count; empty: a virtual camera."""
    colour_master_cone: ConeName | None = None
    """Cone that the other colours are registered to."""
    reference_cone: Text
    """Cone whose strobe the receiver stamps."""
    calibration: CalibrationTable | None = None
    """Calibration; without it the rig is uncalibrated."""
    virtual_image: Annotated[VirtualImage, AfterValidator(_fitting)] | None = None
    """Stitched image; without it heads or bands are images of their own."""
    serial: Text = ""
    """Serial number of the rig as a whole."""
    probe_serials: dict[str, Text] = {}
    """Serial number of each probe by its name."""
    defaults: DefaultsTable = DefaultsTable()
    """Values for all lenses and sensors."""
    cone: Annotated[tuple[Cone, ...], Field(min_length=1, max_length=CONES_MAX)]
    """The cones."""

    @property
    def rig(self) -> Rig:
        """The rig that the file describes."""
        calibration = self.calibration
        return Rig(
            name=self.name,
            title=self.title,
            timing=self.timing,
            frame_interval_s=self.frame_interval_s,
            master_cone=self.master_cone,
            colour_master_cone=self.colour_master_cone,
            reference_cone=self.reference_cone,
            calibration_id=UNCALIBRATED if calibration is None else calibration.id,
            calibration_date="" if calibration is None else calibration.date,
            calibration_valid_days=(
                CALIBRATION_VALID_DAYS if calibration is None else calibration.valid_days
            ),
            virtual_image=self.virtual_image,
            cones=self.cone,
            serial=self.serial,
            probe_serials=self.probe_serials,
        )


def shipped_rigs() -> dict[str, Path]:
    """Rig files that come with the package.

    Returns:
        Paths by name, sorted.
    """
    return {path.stem: path for path in sorted((Path(__file__).parent / "files").glob("*.toml"))}


def find_rig(name_or_path: str) -> Rig:
    """Load a shipped rig by its name, or any rig file by its path.

    Args:
        name_or_path: a shipped rig has precedence over a file of the same name.

    Returns:
        The rig.

    Raises:
        RigError: no such rig, or a file with mistakes (all of them listed).

    Example:
        >>> rig = find_rig("ultracam-x")
        >>> len(rig.cones), len(rig.sensors), rig.master_cone
        (8, 13, '0')
    """
    shipped = shipped_rigs()
    if name_or_path in shipped:
        return load_rig(shipped[name_or_path])
    path = Path(name_or_path)
    if path.suffix == ".toml" or path.exists():
        return load_rig(path)
    known = ", ".join(shipped)
    raise RigError([f"rig {name_or_path!r} is neither a file nor one of: {known}"])


def load_rig(path: Path) -> Rig:
    """Read and validate a rig file.

    Args:
        path: of a TOML file of at most `toml_text.FILE_MAX_BYTES`.

    Returns:
        The rig.

    Raises:
        RigError: with one sentence per mistake: file, key, value, and what would be right.
    """
    try:
        content, data = read_toml(path, "a rig file")
    except TomlError as error:
        raise RigError([str(error)]) from error
    return rig_from_mapping(content, path.name, line_finder(data))


def rig_from_mapping(content: Mapping[str, Any], file: str, line_of: LineOf | None = None) -> Rig:
    """Build a rig from parsed TOML.

    Args:
        content: tables of the file.
        file: its name in the error sentences.
        line_of: finds the line of a key for the sentences.

    Returns:
        The rig.

    Raises:
        RigError: with one sentence per mistake.
    """
    findings: list[Finding] = []
    rig_file: RigFile | None = None
    cones = [_with_defaults(cone, content) for cone in _tables(content, "cone")]
    given = dict(content)
    if cones and len(cones) == len(content["cone"]):
        given["cone"] = cones
    try:
        rig_file = RigFile.model_validate(given)
    except ValidationError as error:
        findings += dict.fromkeys(
            (_in_defaults(location, content), text) for location, text in findings_of(error)
        )
    findings += [*_lens_findings(content), *_name_findings(content, cones)]
    if rig_file is None or findings:
        raise RigError(sentences(findings, file, line_of))
    rig = rig_file.rig
    if rig.is_calibrated:
        return rig
    return replace(rig, calibration_id=f"{UNCALIBRATED}-{_digest(content)}")


def _digest(content: Mapping[str, Any]) -> str:
    """Eight hexadecimal digits of the values of a file, whatever its form and comments."""
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.sha256(text.encode("utf-8")).hexdigest()[:8]


def _tables(content: Mapping[str, Any], key: str) -> list[Mapping[str, Any]]:
    """The tables of a list; none where it is none."""
    listed = content.get(key)
    return [one for one in listed if isinstance(one, Mapping)] if isinstance(listed, list) else []


def _table(content: Mapping[str, Any], *keys: str) -> Mapping[str, Any]:
    """The table below these keys; empty where there is none."""
    for key in keys:
        found = content.get(key)
        content = found if isinstance(found, Mapping) else {}
    return content


def _with_defaults(cone: Mapping[str, Any], content: Mapping[str, Any]) -> dict[str, Any]:
    """A cone whose lens and sensors have the values of `[defaults]`, and its probe, as theirs."""
    full = dict(cone)
    if isinstance(cone.get("lens"), Mapping):
        full["lens"] = {**_table(content, "defaults", "lens"), **cone["lens"]}
        full["lens"].pop("direction", None)
    sensors = _tables(cone, "sensor")
    if sensors and len(sensors) == len(cone["sensor"]):
        inherited = {key: cone[key] for key in ("probe", "calibration_c") if key in cone}
        defaults = _table(content, "defaults", "sensor")
        full["sensor"] = [{**inherited, **defaults, **sensor} for sensor in sensors]
    return full


def _in_defaults(location: Location, content: Mapping[str, Any]) -> tuple[int | str, ...]:
    """The place of a key in the file: in `[defaults]` if the lens or sensor itself has none."""
    match location:
        case ("cone", int(i), "lens", str(key), *rest):
            own, defaults = content["cone"][i]["lens"], ("defaults", "lens")
        case ("cone", int(i), "sensor", int(j), str(key), *rest):
            own, defaults = content["cone"][i]["sensor"][j], ("defaults", "sensor")
        case _:
            return tuple(location)
    in_defaults = key not in own and key in _table(content, *defaults)
    return (*defaults, key, *rest) if in_defaults else tuple(location)


def _lens_findings(content: Mapping[str, Any]) -> Iterator[Finding]:
    """Lens corrections of another direction than those of this program."""
    places: list[tuple[tuple[int | str, ...], Mapping[str, Any]]] = [
        (("cone", i, "lens"), _table(cone, "lens"))
        for i, cone in enumerate(_tables(content, "cone"))
    ]
    for place, lens in [(("defaults", "lens"), _table(content, "defaults", "lens")), *places]:
        if lens.get("direction", DIRECTION) != DIRECTION:
            text = f"is {shown(lens['direction'])}; a lens correction here is {DIRECTION}"
            yield (*place, "direction"), text


def _name_findings(
    content: Mapping[str, Any], cones: Sequence[Mapping[str, Any]]
) -> Iterator[Finding]:
    """Names that are used twice or name nothing, and what a rig of its kind cannot do without."""
    sensors = [(i, j, s) for i, c in enumerate(cones) for j, s in enumerate(_tables(c, "sensor"))]
    if len(sensors) > SENSORS_MAX:
        yield ("cone",), f"has {len(sensors)} sensors; a rig has {SENSORS_MAX} at most"
        return
    names = [cone.get("name") for cone in cones]
    places: dict[str, dict[Any, Location]] = {"cone": {}, "sensor": {}}
    for kind, name, place in chain(
        (("cone", name, ("cone", i, "name")) for i, name in enumerate(names)),
        (("sensor", s.get("name"), ("cone", i, "sensor", j, "name")) for i, j, s in sensors),
    ):
        if isinstance(name, str) and places[kind].setdefault(name, place) != place:
            yield place, f"is {name!r}, as is {key_of(places[kind][name])}; names are unique"
    for key in ("master_cone", "colour_master_cone", "reference_cone"):
        name = content.get(key)
        if isinstance(name, str) and name not in names and (name or key == "reference_cone"):
            listed = ", ".join(map(str, names)) or "none"
            yield (key,), f"is {shown(name)}; it names a cone of this rig: {listed}"
    stitched = isinstance(content.get("virtual_image"), Mapping)
    if not content.get("master_cone"):
        pan = [cone for cone in cones if cone.get("role") == "pan"]
        hint = "is missing; it names the cone whose layer is the virtual image"
        if not stitched or len(pan) < 2:
            yield ("master_cone",), hint
        elif content.get("timing") != "synchronous":
            alone = "Only a synchronous rig of converging PAN heads has none"
            yield ("master_cone",), f"{hint}. {alone}"
    probes = [
        table["probe"]
        for table in (*cones, *(sensor for _, _, sensor in sensors))
        if isinstance(table.get("probe"), str) and table["probe"]
    ]
    for name in _table(content, "probe_serials"):
        if name not in probes:
            listed = ", ".join(dict.fromkeys(probes)) or "none"
            yield ("probe_serials", name), f"is of no probe here: {listed}"
    for i, j, sensor in sensors:
        if stitched and sensor.get("justified") == "left":
            place = _in_defaults(("cone", i, "sensor", j, "justified"), content)
            yield place, "is 'left'; a rig with [virtual_image] has right-justified words"
