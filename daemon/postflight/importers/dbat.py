"""A camera calibration script of the Damped Bundle Adjustment Toolbox becomes a project of ours.

What is read: cameras, image and control point files, and which interior parameters are estimated.
Its pixels count from the upper left corner with y down; image coordinates are x = u s and
y = -v s, s being the pixel size of its starting camera. Its lens model 3 is our `centred` model.

Source: Boerlin et al., Implementing Functional Modularity for Processing of General Photogrammetric
Data with the Damped Bundle Adjustment Toolbox, 2019, and the example script that comes with it.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon.mission.foreign_files import ForeignFileError, read_regular_file, within
from daemon.mission.foreign_xml import XmlError, parse_xml
from daemon.postflight.adjustment.csv_tables import ProjectError
from daemon.postflight.adjustment.project import CheckPoints
from daemon.postflight.adjustment.project_file import AdjustSection, CameraSection, ProjectFile
from processing.bundle.network import (
    Attitudes,
    CameraModel,
    ImagePoints,
    Images,
    Network,
    Points,
    Stations,
)

Array = NDArray[np.float64]

_MAX_BYTES = 100_000_000
ELEMENTS_MAX = 10_000
_FREE = ("dx0", "dy0", "df", "k1", "k2", "k3", "p1", "p2", "b1")
"""Everything but skew, as its calibration scripts estimate."""


@dataclass(frozen=True)
class ImportedProject:
    """A project file and its network; orientations and points without starting values are NaN."""

    file: ProjectFile
    network: Network
    checks: CheckPoints


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
    camera = given.find("cameras/camera")
    if camera is None or len(given.findall("cameras/camera")) != 1:
        raise ProjectError([f"{script.name}: one camera can be imported"])
    width, height = (int(v) for v in _text(script, camera, "image").split(","))
    sensor = _text(script, camera, "sensor").split(",")
    pixel_mm = float(sensor[1]) / height
    if sensor[0].strip() != "auto":
        aspect = float(sensor[0]) / width / pixel_mm
        if abs(aspect - 1.0) > 1e-6:
            raise ProjectError([f"{script.name}: sensor {sensor} has no square pixels"])
    if _text(script, camera, "model") != "3":
        raise ProjectError([f"{script.name}: only lens model 3 can be imported"])
    section = CameraSection(
        name=_text(script, camera, "name"),
        f_mm=float(_text(script, camera, "focal")),
        xp_mm=width / 2.0 * pixel_mm,
        yp_mm=-height / 2.0 * pixel_mm,
        model="centred",
        pixel_um=pixel_mm * 1e3,
        width_px=width,
        height_px=height,
        free=_FREE,
    )
    name = root.findtext("meta/name") or script.stem
    file = ProjectFile(
        format=1, name=name.strip(), camera=(section,),
        adjust=AdjustSection(image_sigma_um=0.1 * pixel_mm * 1e3),
    )  # fmt: skip
    network, checks = _network(script, given, section, pixel_mm)
    return ImportedProject(file, network, checks)


def _network(
    script: Path, given: ElementTree.Element, section: CameraSection, pixel_mm: float
) -> tuple[Network, CheckPoints]:
    images = _rows(script, given, "images", "id,path")
    seen = _rows(script, given, "image_pts", "im,id,x,y,sxy")
    control = _control(script, given)
    image_names = [row[0] for row in images]
    point_names = list(dict.fromkeys([*control, *(row[1] for row in seen)]))
    image_at = {name: k for k, name in enumerate(image_names)}
    point_at = {name: k for k, name in enumerate(point_names)}
    missing = sorted({row[0] for row in seen} - set(image_names))
    if missing:
        raise ProjectError([f"{script.name}: image points of images {missing[:5]} not listed"])
    uv = np.array([[float(row[2]), float(row[3])] for row in seen])
    sigma = np.array([float(row[4]) for row in seen]) * pixel_mm
    xyz, known = np.full((len(point_names), 3), np.nan), np.full((len(point_names), 3), np.nan)
    for name, (place, spread) in control.items():
        xyz[point_at[name]], known[point_at[name]] = place, spread
    n = len(image_names)
    index = np.arange(n)
    network = Network(
        cameras=(
            CameraModel(
                section.name, section.f_mm, section.xp_mm, section.yp_mm, "centred",
                free=frozenset(section.free), pixel_mm=pixel_mm,
            ),
        ),
        stations=Stations(tuple(image_names), np.full((n, 3), np.nan), np.zeros(n, bool)),
        attitudes=Attitudes(tuple(image_names), np.full((n, 3, 3), np.nan), np.zeros(n, bool)),
        images=Images(tuple(image_names), index, index, np.zeros(n, np.int64), np.full(n, -1)),
        points=Points(tuple(point_names), xyz, known, np.zeros(len(point_names), bool)),
        image_points=ImagePoints(
            np.array([image_at[row[0]] for row in seen]),
            np.array([point_at[row[1]] for row in seen]),
            uv * np.array([pixel_mm, -pixel_mm]),
            np.stack([sigma, sigma], axis=1),
        ),
    )  # fmt: skip
    return network, CheckPoints((), np.zeros((0, 3)), np.zeros((0, 3)))


def _control(script: Path, given: ElementTree.Element) -> dict[str, tuple[list[float], float]]:
    element = given.find("ctrl_pts/file")
    if element is None:
        raise ProjectError([f"{script.name}: no control points; four are needed to begin"])
    kind = (element.get("format") or "").replace(" ", "")
    found = {}
    for row in _rows(script, given, "ctrl_pts", kind):
        if kind == "id,label,x,y,z":
            found[row[0]] = ([float(v) for v in row[2:5]], 0.0)
        elif kind == "id,label,x,y,z,sxyz":
            found[row[0]] = ([float(v) for v in row[2:5]], float(row[5]))
        else:
            raise ProjectError([f"{script.name}: control points of format {kind!r} are not read"])
    return found


def _rows(script: Path, given: ElementTree.Element, what: str, kind: str) -> list[list[str]]:
    element = given.find(f"{what}/file")
    if element is None or not element.text:
        raise ProjectError([f"{script.name}: no file of {what}"])
    if (element.get("format") or "").replace(" ", "") != kind:
        raise ProjectError([f"{script.name}: {what} are read in the format {kind!r} only"])
    path = _within(script, element.text.strip())
    width = kind.count(",") + 1
    rows = []
    for number, line in enumerate(_text_of(path).splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        cells = [cell.strip() for cell in line.split(",")]
        if len(cells) != width:
            raise ProjectError([f"{path.name}:{number}: {len(cells)} values; {width} are right"])
        rows.append(cells)
    return rows


def _within(script: Path, name: str) -> Path:
    try:
        return within(script.parent, name, f"{script.name}: file")
    except ForeignFileError as error:
        raise ProjectError([str(error)]) from error


def _bytes_of(path: Path) -> bytes:
    try:
        return read_regular_file(path, _MAX_BYTES)
    except ForeignFileError as error:
        raise ProjectError([str(error)]) from error


def _text_of(path: Path) -> str:
    try:
        return _bytes_of(path).decode("utf-8")
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
