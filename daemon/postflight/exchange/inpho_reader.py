"""Projects of Inpho's ApplicationsMaster (`*.prj`), read back: cameras and orientations.

Every key is one that is read, one whose value must be the stated one, or one that names and dates
something. Others are refused by name.

Source: files of ApplicationsMaster (`$PROJECT`, `$CAMERA`, `$PHOTO`, `$EXT_ORI`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.exchange.block import Block, BlockCamera, BlockError, BlockImage
from daemon.postflight.exchange.block_check import is_rotation
from daemon.postflight.exchange.coordinate_unit import frame_next_to
from daemon.postflight.exchange.intersected_points import Measured
from daemon.postflight.exchange.photogrammetry_reader import Oriented, measured_block
from daemon.postflight.exchange.text_lines import lines_of, numbers_of, only_file
from processing.geometry.forward_distortion import ForwardDistortion

Array = NDArray[np.float64]

_ORTHOGONAL_TO: Final = 1e-5
_FOCAL_WITHIN_MM: Final = 1e-3
"""Largest difference of the focal length of an orientation from that of its camera."""
_READ: Final[Mapping[str, frozenset[str]]] = {
    "$PROJECT": frozenset(
        {"$LINEAR_UNITS_OF_OBJECT", "$LINEAR_UNITS_OF_IMAGE", "$ANGULAR_UNITS"},
    ),
    "$PHOTO": frozenset({"$PHOTO_NUM", "$CAMERA_ID", "$ORI_STAT", "$EXT_ORI", "$PHOTO_POINTS"}),
    "$CAMERA": frozenset(
        {
            *("$TYPE", "$KIND", "$CCD_INTERIOR_ORIENTATION", "$CCD_COLUMNS", "$CCD_ROWS"),
            *("$PIXEL_REFERENCE", "$FOCAL_LENGTH", "$PRINCIPAL_POINT_PPA", "$DISTORTION_TYPE"),
            "$CAMERA_MOUNT_ROTATION",
        }
    ),
}
"""Sections that are carried, and the keys of each that are read."""
IGNORED: Final[Mapping[str, frozenset[str]]] = {
    "$PROJECT": frozenset({"$PROJECT_NAME", "$STARTING_DATE", "$LAST_CHANGE"}),
    "$PHOTO": frozenset({"$PHOTO_FILE"}),
    "$CAMERA": frozenset({"$DATE", "$BRAND", "$GPS_ANTENNA_OFFSET"}),
}
"""Keys that change neither cameras nor orientations."""
_UNITS: Final = {
    "$LINEAR_UNITS_OF_OBJECT": "m",
    "$LINEAR_UNITS_OF_IMAGE": "mm",
    "$ANGULAR_UNITS": "deg",
}
_ORIENTED: Final = ("", "Initial", "Adjusted")
_MEASUREMENTS: Final = "$PHOTO_POINTS"
_END_OF_MEASUREMENTS: Final = "$END_POINTS"


@dataclass(frozen=True)
class _Section:
    """A section of an Inpho project: values by key, and the lines below each key."""

    kind: str
    line: int
    values: Mapping[str, str]
    rows: Mapping[str, list[list[float]]]
    points: Mapping[str, tuple[float, float]] | None = None


def read_inpho(path: Path) -> Block:
    """Read cameras, photos and their measurements of an Inpho project (`*.prj`), as we write it.

    Raises:
        BlockError: no such file, sections, keys, units or states that are not carried, or a photo
            without an orientation or a known camera.
    """
    if path.is_dir():
        path = only_file(path, ("*.prj",), "<name>.prj")
    sections = _sections(path)
    _check_units(path, sections["$PROJECT"])
    cameras: dict[str, BlockCamera] = {}
    for one in sections["$CAMERA"]:
        camera = _camera(path, one)
        if camera.name in cameras:
            raise BlockError(
                f"{path}: line {one.line}: camera {camera.name} is there twice; keep one of them"
            )
        cameras[camera.name] = camera
    principal_points = {
        one.values["$TYPE"]: numbers_of(path, one.line, one.values["$PRINCIPAL_POINT_PPA"].split())
        for one in sections["$CAMERA"]
    }
    images: dict[str, BlockImage] = {}
    measured: dict[str, Measured] = {}
    for one in sections["$PHOTO"]:
        image = _photo(path, one, cameras, len(images))
        if image.name in images:
            raise BlockError(
                f"{path}: line {one.line}: photo {image.name} is there twice; keep one of them"
            )
        images[image.name] = image
        if one.points is not None:
            camera = list(cameras.values())[image.camera]
            point_mm = principal_points[camera.name]
            points = _from_middle(camera, point_mm, one.points)
            measured[image.name] = Measured(camera.name, points)
    if not images:
        raise BlockError(f"{path}: has no $PHOTO with an orientation; there is nothing to import")
    if measured:
        oriented = {name: Oriented(one.centre_m, one.rotation) for name, one in images.items()}
        system = "not stated in the file"
        block = measured_block(
            path.parent, cameras, oriented, measured, system, {}, (), is_metric=True
        )
        return replace(block, name=path.stem)
    notes = ("coordinate system: not stated in the file",)
    frame = frame_next_to(path)
    return Block(path.stem, tuple(cameras.values()), tuple(images.values()), frame, notes=notes)


def _sections(path: Path) -> dict[str, list[_Section]]:
    found: dict[str, list[_Section]] = {kind: [] for kind in _READ}
    kind, begun, key = "", 0, ""
    values: dict[str, str] = {}
    rows: dict[str, list[list[float]]] = {}
    points: dict[str, tuple[float, float]] | None = None
    for number, words in lines_of(path):
        if not kind:
            kind, begun, key, values, rows = words[0], number, "", {}, {}
            points = None
            if kind not in _READ:
                raise BlockError(
                    f"{path}: line {number}: section {kind[:40]} is not carried; remove it"
                )
        elif words[0] == "$END":
            if key == _MEASUREMENTS:
                raise BlockError(
                    f"{path}: line {number}: {_MEASUREMENTS} of line {begun} has no "
                    f"{_END_OF_MEASUREMENTS}; copy it again"
                )
            found[kind].append(_Section(kind, begun, values, rows, points))
            kind = ""
        elif key == _MEASUREMENTS and words[0] == _END_OF_MEASUREMENTS:
            key = ""
        elif words[0].startswith("$"):
            key = words[0]
            _check_key(path, number, kind, key, values)
            values[key] = " ".join(words[2:])
            if key == _MEASUREMENTS:
                points = {}
        elif key == _MEASUREMENTS and points is not None:
            _measure(path, number, words, points)
        else:
            rows.setdefault(key, []).append(numbers_of(path, number, words))
    if kind:
        raise BlockError(f"{path}: section {kind} of line {begun} has no $END; copy it again")
    return found


def _check_key(path: Path, number: int, kind: str, key: str, values: Mapping[str, str]) -> None:
    where = f"{path}: line {number}: {key[:40]}"
    if key not in _READ[kind] and key not in IGNORED[kind]:
        raise BlockError(
            f"{where} of {kind} is not carried; remove the line if it changes neither cameras nor "
            "orientations"
        )
    if key in values:
        raise BlockError(f"{where} is there twice in this {kind}; keep one of them")


def _measure(
    path: Path, number: int, words: list[str], points: dict[str, tuple[float, float]]
) -> None:
    """Point, x, y in mm of the photo, weight, and what is not read: kind and description."""
    where = f"{path}: line {number}: {' '.join(words)[:60]}"
    if len(words) < 3:
        raise BlockError(f"{where}: point, x and y are needed; export the project again")
    if words[0] in points:
        raise BlockError(f"{path}: line {number}: point {words[0]} is twice in this photo")
    x, y, *weight = numbers_of(path, number, words[1:4])
    if weight not in ([], [1.0]):
        raise BlockError(
            f"{where}: a weight other than 1 is not carried; give the block one accuracy, and "
            "--image-sigma states it"
        )
    points[words[0]] = (x, y)


def _from_middle(
    camera: BlockCamera,
    principal_point_mm: Sequence[float],
    points: Mapping[str, tuple[float, float]],
) -> dict[str, tuple[float, float]]:
    """Measurements as mm from the middle of the image, y up.

    In the file they are of the system in which the principal point is stated, and which
    `$CCD_INTERIOR_ORIENTATION` carries to pixels.
    """
    model, pitch_mm = camera.model, camera.pitch_mm or 1.0
    x0_mm, y0_mm = principal_point_mm
    right = (model.cx_px - (camera.width_px - 1) / 2.0) * pitch_mm - x0_mm
    up = ((camera.height_px - 1) / 2.0 - model.cy_px) * pitch_mm - y0_mm
    return {name: (x + right, y + up) for name, (x, y) in points.items()}


def _check_units(path: Path, projects: list[_Section]) -> None:
    if len(projects) != 1:
        raise BlockError(
            f"{path}: {len(projects)} sections $PROJECT; one is needed, which states the units"
        )
    (project,) = projects
    for key, unit in _UNITS.items():
        stated = project.values.get(key, "")
        if stated != unit:
            raise BlockError(
                f"{path}: line {project.line}: {key} is {stated or 'not stated'}; {unit} is read: "
                "export the project in these units"
            )


def _photo(
    path: Path, section: _Section, cameras: Mapping[str, BlockCamera], number: int
) -> BlockImage:
    values = section.values
    camera, name = values.get("$CAMERA_ID", ""), values.get("$PHOTO_NUM", "")
    where = f"{path}: line {section.line}: photo {name}"
    if values.get("$ORI_STAT", "") not in _ORIENTED:
        raise BlockError(
            f"{where}: $ORI_STAT is {values['$ORI_STAT'][:40]}; Initial and Adjusted are read: "
            "remove the photo, or orient it"
        )
    rows = section.rows.get("$EXT_ORI", [])
    if camera not in cameras or [len(row) for row in rows] != [4, 3, 3, 3]:
        raise BlockError(
            f"{where} has no $EXT_ORI of focal length, place and matrix, or its camera {camera!r} "
            "is not in the file; export the project again"
        )
    rotation = np.array(rows[1:])
    if not is_rotation(rotation, _ORTHOGONAL_TO):
        raise BlockError(
            f"{where}: no rotation matrix (scaled, sheared or mirrored); export the project again"
        )
    model, pitch_mm = cameras[camera].model, cameras[camera].pitch_mm or 1.0
    focal_mm = model.fx_px * pitch_mm
    if abs(rows[0][0] - focal_mm) > _FOCAL_WITHIN_MM:
        raise BlockError(
            f"{where}: its $EXT_ORI has a focal length of {rows[0][0]:g} mm, and camera {camera} "
            f"{focal_mm:g} mm; orientation and camera are of different adjustments: export both "
            "again"
        )
    index = list(cameras).index(camera)
    return BlockImage(name, index, number, np.array(rows[0][1:]), rotation)


def _camera(path: Path, section: _Section) -> BlockCamera:
    """Focal length in mm, pixels by the affine of `$CCD_INTERIOR_ORIENTATION`."""
    values, rows = section.values, section.rows.get("$CCD_INTERIOR_ORIENTATION", [])
    name = values.get("$TYPE", "")
    if not name:
        raise BlockError(
            f"{path}: line {section.line}: a $CAMERA without $TYPE, which is its name; add it as "
            "the photos' $CAMERA_ID has it"
        )
    where = f"{path}: line {section.line}: camera {name}"
    missing = [
        key
        for key in (
            *("$FOCAL_LENGTH", "$CCD_COLUMNS", "$CCD_ROWS", "$PRINCIPAL_POINT_PPA"),
            *("$PIXEL_REFERENCE", "$CAMERA_MOUNT_ROTATION"),
        )
        if key not in values
    ]
    if missing:
        raise BlockError(f"{where}: has no {', '.join(missing)}; export the project again")
    try:
        focal_mm, mount = float(values["$FOCAL_LENGTH"]), float(values["$CAMERA_MOUNT_ROTATION"])
        width, height = int(values["$CCD_COLUMNS"]), int(values["$CCD_ROWS"])
        x0, y0 = (float(word) for word in values["$PRINCIPAL_POINT_PPA"].split())
        (a, b, c), (d, e, f) = rows
    except ValueError as error:
        raise BlockError(
            f"{where}: a value is not understood ({error}); export the project again"
        ) from error
    if values["$PIXEL_REFERENCE"] != "CenterTopLeft" or "$DISTORTION_TYPE" in values:
        raise BlockError(
            f"{where}: $PIXEL_REFERENCE CenterTopLeft without distortion is read; export images "
            "without distortion"
        )
    if values.get("$KIND", "CCDFrame") != "CCDFrame":
        raise BlockError(
            f"{where}: $KIND {values['$KIND'][:40]}; frame cameras (CCDFrame) are read"
        )
    if mount != 0.0:
        raise BlockError(
            f"{where}: $CAMERA_MOUNT_ROTATION is {mount:g}; 0 is read: export the orientations of "
            "the images instead of those of the mount"
        )
    if not (math.isfinite(focal_mm) and focal_mm > 0.0):
        raise BlockError(
            f"{where}: $FOCAL_LENGTH is {focal_mm:g}; it is finite and positive: correct it"
        )
    if b or d or a <= 0.0 or abs(a + e) > 1e-9 * a:
        raise BlockError(
            f"{where}: $CCD_INTERIOR_ORIENTATION other than of square pixels with rows downwards "
            "is not read; export the project with such pixels"
        )
    centre = (c + a * x0, f + e * y0)
    model = ForwardDistortion(focal_mm * a, focal_mm * a, *centre)
    return BlockCamera(name, width, height, model, 1.0 / a)
