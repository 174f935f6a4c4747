"""A camera calibration script of the Damped Bundle Adjustment Toolbox becomes a project of ours.

What is read: cameras, image and control point files, and which interior parameters are estimated.
Its pixels count from the upper left corner with y down; image coordinates are x = u s and
y = -v s, s being the pixel size of its starting camera. Its lens model 3 is our `centred` model.

Source: Boerlin et al., Implementing Functional Modularity for Processing of General Photogrammetric
Data with the Damped Bundle Adjustment Toolbox, 2019, and the example script that comes with it.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon.mission.foreign_files import ForeignFileError, read_regular_file, within
from daemon.mission.foreign_xml import XmlError, parse_xml
from daemon.postflight.adjustment.csv_tables import ProjectError, is_row
from daemon.postflight.adjustment.project import CheckPoints
from daemon.postflight.adjustment.project_file import AdjustSection, CameraSection, ProjectFile
from daemon.postflight.importers.dbat_elements import camera_file_findings
from daemon.postflight.importers.dbat_settings import HERE, filtered, read_settings
from processing.bundle.network import (
    INTERIOR,
    Attitudes,
    CameraModel,
    ImagePoints,
    Images,
    Network,
    Points,
    Stations,
)
from processing.geometry.rotation import rotation_matrix

Array = NDArray[np.float64]

_MAX_BYTES = 100_000_000
ELEMENTS_MAX = 10_000
_TEXTS = {"id", "im", "label", "path"}
"""Columns that are no numbers."""

_SIGMAS = ("sx", "sy", "sz", "sxy", "sxyz")
_WHERE = "where"
"""Key of a row for its file and line."""


@dataclass(frozen=True)
class ImportedProject:
    """A project file and its network; orientations and points without starting values are NaN."""

    file: ProjectFile
    network: Network
    checks: CheckPoints
    notes: tuple[str, ...] = ()


def import_dbat(script: Path) -> ImportedProject:
    """Read a script and the files it names.

    Raises:
        ProjectError: files that are missing, or settings that we do not have.
    """
    root = _parsed(script)
    try:
        return _imported(script, root)
    except ProjectError:
        raise
    except (ValueError, ArithmeticError, LookupError) as error:
        raise ProjectError(
            [f"{script.name}: a number or a name of it cannot be used ({error})"]
        ) from error


def _imported(script: Path, root: ElementTree.Element) -> ImportedProject:
    given = root.find("input")
    if given is None:
        raise ProjectError([f"{script.name}: no input section; a DBAT script has one"])
    settings = read_settings(script.name, root)
    script = _at_base(script, given)
    camera = _camera(script, given)
    if _text(script, camera, "unit") != "mm":
        raise ProjectError([f"{script.name}: a camera in {camera.findtext('unit')} is not read"])
    size = _text(script, camera, "image").split(",")
    if len(size) != 2 or not all(cell.strip().isdigit() and int(cell) > 0 for cell in size):
        raise ProjectError(
            [f"{script.name}: <image> is {','.join(size)!r}; width and height in pixels are right"]
        )
    width, height = (int(cell) for cell in size)
    sensor = _text(script, camera, "sensor").split(",")
    pixel_mm = float(sensor[1]) / height
    if sensor[0].strip() != "auto":
        aspect = float(sensor[0]) / width / pixel_mm
        if abs(aspect - 1.0) > 1e-6:
            raise ProjectError([f"{script.name}: sensor {sensor} has no square pixels"])
    if _text(script, camera, "model") != "3":
        raise ProjectError([f"{script.name}: only lens model 3 can be imported"])
    focal = _text(script, camera, "focal")
    _refuse_value(f"{script.name}: <focal>", focal, is_sigma=False)
    if float(focal) <= 0.0:
        raise ProjectError([f"{script.name}: <focal> is {focal}; it is positive"])
    section = CameraSection(
        name=_text(script, camera, "name"),
        f_mm=float(focal),
        xp_mm=width / 2.0 * pixel_mm,
        yp_mm=-height / 2.0 * pixel_mm,
        model="centred",
        pixel_um=pixel_mm * 1e3,
        width_px=width,
        height_px=height,
        free=settings.free,
    )
    if settings.io_is_loaded:
        section = section.model_copy(update=_loaded(script, camera))
    name = root.findtext("meta/name") or script.stem
    file = ProjectFile(
        format=1, name=name.strip(), camera=(section,),
        adjust=AdjustSection(
            image_sigma_um=0.1 * pixel_mm * 1e3, minimum_norm=given.find("ctrl_pts") is None
        ),
    )  # fmt: skip
    network, checks = _network(script, given, section, pixel_mm)
    notes = (*settings.notes, *_notes_on_ends(script, given))
    return ImportedProject(file, network, checks, notes)


def _camera(script: Path, given: ElementTree.Element) -> ElementTree.Element:
    """The one camera, in the script or in a file of its own."""
    found = given.findall("cameras/camera")
    for file in given.findall("cameras/file"):
        path = _within(script, (file.text or "").strip())
        root = _parsed(path)
        if problems := camera_file_findings(path.name, root):
            raise ProjectError(problems)
        found += root.findall("cameras/camera")
    if len(found) != 1:
        raise ProjectError(
            [f"{script.name}: {len(found)} cameras; one can be imported: remove the others"]
        )
    for key, count in (("nK", 3), ("nP", 2)):
        stated = (found[0].findtext(key) or str(count)).strip()
        if stated != str(count):
            raise ProjectError(
                [
                    f"{script.name}: <{key}> is {stated}; {count} is read: state {count}, and hold "
                    "further coefficients with <K3>false</K3> and the like"
                ]
            )
    return found[0]


def _loaded(script: Path, camera: ElementTree.Element) -> dict[str, float]:
    """Calibrated values of a camera in place of its nominal ones."""
    calibrated = (camera.findtext("calibrated") or "yes").strip()
    if calibrated != "yes":
        raise ProjectError(
            [
                f"{script.name}: <calibrated> is {calibrated}, and the initial values of io are "
                "loaded from the camera: begin with default, or state yes"
            ]
        )
    values: dict[str, float] = {}
    for key, names in (("cc", ("f_mm",)), ("pp", ("xp_mm", "yp_mm")), ("P", ("p1", "p2"))):
        if text := camera.findtext(key):
            numbers = _numbers(script, key, text)
            if len(numbers) != len(names):
                raise ProjectError(
                    [f"{script.name}: <{key}> has {len(numbers)} values; {len(names)} are right"]
                )
            values |= dict(zip(names, numbers, strict=True))
    radial = _numbers(script, "K", camera.findtext("K") or "0,0,0")
    if len(radial) < 3:
        raise ProjectError([f"{script.name}: <K> has {len(radial)} coefficients; three are read"])
    if len(radial) > 3 and any(radial[3:]):
        raise ProjectError([f"{script.name}: <K> has {len(radial)} coefficients; three are read"])
    values |= dict(zip(("k1", "k2", "k3"), radial[:3], strict=False))
    if "yp_mm" in values:
        # Scripts have it negative as y of the image plane is, DBAT's results positive.
        values["yp_mm"] = -abs(values["yp_mm"])
    for key, neutral in (("skew", 0.0), ("aspect", 1.0)):
        if float(camera.findtext(key) or neutral) != neutral:
            raise ProjectError([f"{script.name}: <{key}> other than {neutral:g} is not read"])
    return values


def _network(
    script: Path, given: ElementTree.Element, section: CameraSection, pixel_mm: float
) -> tuple[Network, CheckPoints]:
    images = _tables(script, given, "images", ("id", "path"))
    seen = _tables(script, given, "image_pts", ("im", "id", "x", "y"), ("sxy", "sx", "sy"))
    control, check = _points(script, given, "ctrl_pts"), _points(script, given, "check_pts")
    prior = _prior_orientations(script, given)
    if not control and not prior:
        raise ProjectError([f"{script.name}: no control points; four are needed to begin"])
    image_names = [row["id"] for row in images]
    point_names = list(dict.fromkeys([*control, *(row["id"] for row in seen)]))
    image_at = {name: k for k, name in enumerate(image_names)}
    point_at = {name: k for k, name in enumerate(point_names)}
    missing = {row["im"]: row[_WHERE] for row in reversed(seen) if row["im"] not in image_at}
    if missing:
        raise ProjectError(
            [
                f"{where}: image {name!r} is not among the images"
                for name, where in [*missing.items()][:5]
            ]
        )
    uv = np.array([[float(row["x"]), float(row["y"])] for row in seen])
    sigma = np.array([_image_sigma(script, row) for row in seen]).reshape(-1, 2) * pixel_mm
    xyz, known = np.full((len(point_names), 3), np.nan), np.full((len(point_names), 3), np.nan)
    for name, (place, spread) in control.items():
        xyz[point_at[name]], known[point_at[name]] = place, spread
    n = len(image_names)
    index = np.arange(n)
    station, rotation = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan)
    for name, (at, turn) in prior.items():
        if name in image_at:
            station[image_at[name]], rotation[image_at[name]] = at, turn
    interior = np.array([getattr(section, name) for name in INTERIOR])
    network = Network(
        cameras=(
            CameraModel(
                section.name, section.f_mm, section.xp_mm, section.yp_mm, "centred",
                interior=interior, free=frozenset(section.free), pixel_mm=pixel_mm,
            ),
        ),
        stations=Stations(tuple(image_names), station, np.zeros(n, bool)),
        attitudes=Attitudes(tuple(image_names), rotation, np.zeros(n, bool)),
        images=Images(tuple(image_names), index, index, np.zeros(n, np.int64), np.full(n, -1)),
        points=Points(tuple(point_names), xyz, known, np.zeros(len(point_names), bool)),
        image_points=ImagePoints(
            np.array([image_at[row["im"]] for row in seen]),
            np.array([point_at[row["id"]] for row in seen]),
            uv * np.array([pixel_mm, -pixel_mm]),
            sigma,
        ),
    )  # fmt: skip
    named = {name: value for name, value in check.items() if name in point_at}
    places = np.array([place for place, _ in named.values()]).reshape(-1, 3)
    spreads = np.array([spread for _, spread in named.values()]).reshape(-1, 3)
    return network, CheckPoints(tuple(named), places, spreads)


def _image_sigma(script: Path, row: Mapping[str, str]) -> tuple[float, float]:
    own = [float(row[name]) for name in ("sx", "sy") if name in row and "sxy" not in row]
    if "sxy" in row:
        own = [float(row["sxy"])] * 2
    if len(own) == 2:
        if min(own) <= 0.0:
            raise ProjectError([f"{row[_WHERE]}: a standard deviation of 0; it is positive"])
        return own[0], own[1]
    raise ProjectError(
        [f"{script.name}: image points have no standard deviation; give a column or attribute sxy"]
    )


def _points(
    script: Path, given: ElementTree.Element, what: str
) -> dict[str, tuple[list[float], list[float]]]:
    """Control or check points by id: place and standard deviations, 0 where held."""
    if given.find(what) is None:
        return {}
    rows = _tables(
        script, given, what, ("id", "x", "y", "z"), ("label", "sx", "sy", "sz", "sxy", "sxyz")
    )
    found = {}
    for row in rows:
        common = row.get("sxyz", "0")
        plane = row.get("sxy", common)
        spread = [row.get("sx", plane), row.get("sy", plane), row.get("sz", common)]
        found[row["id"]] = ([float(row[k]) for k in "xyz"], [float(v) for v in spread])
    return filtered(script.name, given.findall(f"{what}/filter"), found)


def _prior_orientations(
    script: Path, given: ElementTree.Element
) -> dict[str, tuple[list[float], Array]]:
    """Initial orientations by image: R = Rx(omega) Ry(phi) Rz(kappa), camera to object."""
    if given.find("prior_eo") is None:
        return {}
    units = {(file.get("units") or "").strip() for file in given.findall("prior_eo/file")}
    if len(units) != 1 or units - {"degrees", "radians"}:
        found = ", ".join(repr(unit) for unit in sorted(units))
        raise ProjectError(
            [f"{script.name}: prior_eo in {found}; degrees or radians, one of them, are right"]
        )
    scale = math.pi / 180.0 if units == {"degrees"} else 1.0
    names = ("id", "x", "y", "z", "omega", "phi", "kappa")
    return {
        row["id"]: (
            [float(row[k]) for k in "xyz"],
            rotation_matrix(*(float(row[k]) * scale for k in names[4:])),
        )
        for row in _tables(script, given, "prior_eo", names)
    }


def _tables(
    script: Path,
    given: ElementTree.Element,
    what: str,
    needed: Sequence[str],
    optional: Sequence[str] = (),
) -> list[dict[str, str]]:
    """Rows of all files of a kind, by the column names of their formats, in any order.

    An attribute of a file that names a column (`sxy`) holds for all of its rows.
    """
    rows = []
    files = given.findall(f"{what}/file")
    if not files:
        raise ProjectError([f"{script.name}: no file of {what}"])
    for element in files:
        if not element.text:
            raise ProjectError([f"{script.name}: no file of {what}"])
        columns = [c.strip() for c in (element.get("format") or "").split(",")]
        known = ("format", "units") if what == "prior_eo" else ("format",)
        constant = {k: v for k, v in element.attrib.items() if k not in known}
        unknown = [c for c in (*columns, *constant) if c not in (*needed, *optional)]
        absent = [c for c in needed if c not in (*columns, *constant)]
        if unknown or absent or len(set(columns)) < len(columns):
            raise ProjectError(
                [
                    f"{script.name}: {what} of format {element.get('format')!r} are not read: "
                    f"unknown {unknown}, missing {absent}"
                ]
            )
        rows += _rows(_within(script, element.text.strip()), columns, constant)
    if "im" not in columns:
        ids = Counter(row["id"] for row in rows)
        if repeated := [name for name, count in ids.items() if count > 1]:
            raise ProjectError(
                [f"{script.name}: {what} {', '.join(repeated[:5])} more than once; name each once"]
            )
    return rows


def _rows(path: Path, columns: Sequence[str], constant: Mapping[str, str]) -> list[dict[str, str]]:
    rows = []
    for number, line in enumerate(_text_of(path).splitlines(), 1):
        bare = line.strip()
        if bare.startswith("#") and is_row(bare, columns):
            raise ProjectError(
                [
                    f"{path.name}:{number}: {bare.split(',')[0]!r} looks like a name, and # begins "
                    "a remark: write a space after the # of a remark, or rename it"
                ]
            )
        if not bare or bare.startswith("#"):
            continue
        cells = [cell.strip() for cell in line.split(",")]
        if len(cells) != len(columns):
            raise ProjectError(
                [f"{path.name}:{number}: {len(cells)} values; {len(columns)} are right"]
            )
        row = {**constant, **dict(zip(columns, cells, strict=True))}
        for column in row.keys() - _TEXTS:
            _refuse_value(f"{path.name}:{number}: {column}", row[column], column in _SIGMAS)
        rows.append({**row, _WHERE: f"{path.name}:{number}"})
    if not rows:
        raise ProjectError([f"{path.name}: no rows; a file of a script has some"])
    return rows


def _numbers(script: Path, key: str, text: str) -> list[float]:
    cells = [cell.strip() for cell in text.split(",")]
    for cell in cells:
        _refuse_value(f"{script.name}: <{key}>", cell, is_sigma=False)
    return [float(cell) for cell in cells]


def _notes_on_ends(script: Path, given: ElementTree.Element) -> tuple[str, ...]:
    """Tables whose last line has no end: the last number of a file that was cut is another one."""
    files = [one for what in ("ctrl_pts", "image_pts", "prior_eo") for one in given.iter(what)]
    paths = [
        _within(script, file.text.strip())
        for one in files
        for file in one.findall("file")
        if file.text
    ]
    return tuple(
        f"{path.name}: its last line has no end; was the file cut?"
        for path in dict.fromkeys(paths)
        if not _text_of(path).endswith(("\n", "\r"))
    )


def _refuse_value(what: str, text: str, is_sigma: bool) -> None:
    """Refuse what is no number in ASCII digits, and a negative standard deviation."""
    try:
        value = float(text) if text.isascii() and "_" not in text else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ProjectError([f"{what} is {text!r}; a number is right"])
    if is_sigma and value < 0.0:
        raise ProjectError([f"{what} is {text}; a standard deviation is not negative"])


def _at_base(script: Path, given: ElementTree.Element) -> Path:
    """The script as if it were in its base folder, to which names of files are relative."""
    base = given.get("base_dir", HERE).removeprefix(HERE).strip("/")
    return _within(script, base) / script.name if base not in ("", ".") else script


def _within(script: Path, name: str) -> Path:
    try:
        return within(script.parent, name.removeprefix(f"{HERE}/"), f"{script.name}: file")
    except ForeignFileError as error:
        raise ProjectError([str(error)]) from error


def _bytes_of(path: Path) -> bytes:
    try:
        return read_regular_file(path, _MAX_BYTES)
    except ForeignFileError as error:
        raise ProjectError([str(error)]) from error


def _text_of(path: Path) -> str:
    try:
        return _bytes_of(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ProjectError([f"{path}: cannot be read ({error})"]) from error


def _parsed(script: Path) -> ElementTree.Element:
    try:
        return parse_xml(_bytes_of(script), elements_max=ELEMENTS_MAX)
    except XmlError as error:
        raise ProjectError([f"{script.name}: {error}"]) from error


def _text(script: Path, element: ElementTree.Element, key: str) -> str:
    found = element.findtext(key)
    if not found:
        raise ProjectError([f"{script.name}: the camera has no <{key}>"])
    return found.strip()
