"""Pix4D's and Inpho's files, read back: cameras, orientations, and Pix4D's measurements.

Source: Pix4D support, "What does the Output Params Folder contain" and "What is the bingo file";
files of ApplicationsMaster (`$CAMERA`, `$PHOTO`, `$EXT_ORI`).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.exchange.block import Block, BlockCamera, BlockError, BlockImage
from daemon.postflight.exchange.colmap import CENTRE_PX
from daemon.postflight.exchange.photogrammetry import CAMERAS_FILE
from daemon.postflight.exchange.photogrammetry_reader import (
    BINGO_PATTERNS,
    bingo_measurements,
    cameras_of,
    measured_block,
    named_orientations,
    photos_of,
)
from daemon.postflight.exchange.text_lines import lines_of, numbers_of, only_file
from processing.geometry.forward_distortion import ForwardDistortion

Array = NDArray[np.float64]

_HEADER: Final = ("imageName", "X", "Y", "Z", "Omega", "Phi", "Kappa")
_CAM_KEYS: Final = ("F", "Px", "Py", "K1", "K2", "K3", "T1", "T2")
_ORTHOGONAL_TO: Final = 1e-5
_INPHO_READ: Final = frozenset({"$PROJECT", "$PHOTO", "$CAMERA"})
_SIDE_WITHIN: Final = 1e-3


def read_pix4d(folder: Path) -> Block:
    """Read `*external_camera_parameters.txt`, `cameras.txt`, `*.cam` and `*bingo*.txt`.

    Camera files and measurements may be missing: the camera then has no distortion, or the block no
    points. Without measurements, `photos.txt` names the camera of each image where there are
    several.

    Raises:
        BlockError: a file that is missing or not understood, or files that contradict each other.
    """
    cameras = {name: _with_cam(folder, one) for name, one in cameras_of(folder).items()}
    path = only_file(
        folder, ("*external_camera_parameters.txt",), "calibrated_external_camera_parameters.txt"
    )
    oriented = named_orientations(path, "XYZ", "deg", header=_HEADER)
    system = "that of the Pix4D project"
    if any(True for pattern in BINGO_PATTERNS for _ in folder.glob(pattern)):
        measurements = only_file(folder, BINGO_PATTERNS, "<name>_bingo.txt")
        measured = bingo_measurements(measurements, cameras)
        return measured_block(folder, cameras, oriented, measured, system, {})
    names = list(cameras)
    camera_of = dict(photos_of(folder, cameras).values())
    unknown = sorted(set(oriented) - set(camera_of)) if len(names) > 1 else []
    if unknown:
        raise BlockError(
            f"{folder}: {CAMERAS_FILE} has {len(names)} cameras, and photos.txt does not name "
            f"that of {', '.join(unknown[:5])}"
        )
    images = tuple(
        BlockImage(name, names.index(camera_of.get(name, names[0])), k, one.centre_m, one.rotation)
        for k, (name, one) in enumerate(oriented.items())
    )
    notes = (f"coordinate system: {system}",)
    return Block(folder.resolve().name, tuple(cameras.values()), images, notes=notes)


def _with_cam(folder: Path, camera: BlockCamera) -> BlockCamera:
    """A camera with the distortion of its camera file, where there is one."""
    path = folder / f"{camera.name}.cam"
    if not path.exists():
        return camera
    pitch = camera.pitch_mm or 1.0
    found: dict[str, float] = {}
    for number, words in lines_of(path):
        if words[0].startswith("#") or words[0] == "Pix4D":
            _agrees(path, " ".join(words), camera)
            continue
        if len(words) != 2 or words[0] not in _CAM_KEYS:
            raise BlockError(f"{path}: line {number}: {' '.join(words)[:60]!r} is not carried")
        (found[words[0]],) = numbers_of(path, number, words[1:])
    missing = [key for key in _CAM_KEYS if key not in found]
    if missing:
        raise BlockError(f"{path}: has no {', '.join(missing)}")
    f_px = found["F"] / pitch
    if f_px <= 0.0:
        raise BlockError(f"{path}: F is {found['F']:g}; it is positive")
    model = ForwardDistortion(
        f_px,
        f_px,
        found["Px"] / pitch - CENTRE_PX,
        found["Py"] / pitch - CENTRE_PX,
        k1=found["K1"],
        k2=found["K2"],
        k3=found["K3"],
        p1=found["T1"],
        p2=found["T2"],
    )
    return replace(camera, model=model)


def _agrees(path: Path, remark: str, camera: BlockCamera) -> None:
    """Whether the sensor's size in a remark is that of `cameras.txt`."""
    stated = re.search(r"sensor width of ([0-9.eE+-]+)x([0-9.eE+-]+)mm", remark)
    if stated is None:
        return
    own = [side * (camera.pitch_mm or 1.0) for side in (camera.width_px, camera.height_px)]
    sides = numbers_of(path, 1, [stated[1], stated[2]])
    if any(abs(a - b) > _SIDE_WITHIN * b for a, b in zip(sides, own, strict=True)):
        raise BlockError(
            f"{path}: a sensor of {sides[0]:g} x {sides[1]:g} mm; {CAMERAS_FILE} has "
            f"{own[0]:g} x {own[1]:g} mm"
        )


@dataclass(frozen=True)
class _Section:
    """A section of an Inpho project: values by key, and the lines below each key."""

    kind: str
    line: int
    values: Mapping[str, str]
    rows: Mapping[str, list[list[float]]]


def read_inpho(path: Path) -> Block:
    """Read cameras and photos of an Inpho project (`*.prj`), as `export block` writes it.

    Raises:
        BlockError: no such file, sections or keys that are not carried, or a photo without an
            orientation or a known camera.
    """
    if path.is_dir():
        path = only_file(path, ("*.prj",), "<name>.prj")
    sections = _sections(path)
    cameras = {one.values["$TYPE"]: _inpho_camera(path, one) for one in sections["$CAMERA"]}
    names = list(cameras)
    images = []
    for k, one in enumerate(sections["$PHOTO"]):
        camera, name = one.values.get("$CAMERA_ID", ""), one.values.get("$PHOTO_NUM", "")
        rows = one.rows.get("$EXT_ORI", [])
        if camera not in cameras or [len(row) for row in rows] != [4, 3, 3, 3]:
            raise BlockError(
                f"{path}: line {one.line}: photo {name} has no $EXT_ORI of focal length, place "
                f"and matrix, or its camera {camera!r} is not in the file"
            )
        rotation = np.array(rows[1:])
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ORTHOGONAL_TO:
            raise BlockError(f"{path}: line {one.line}: photo {name}: no rotation matrix")
        images.append(BlockImage(name, names.index(camera), k, np.array(rows[0][1:]), rotation))
    if not images:
        raise BlockError(f"{path}: has no $PHOTO with an orientation")
    notes = ("coordinate system: not stated in the file",)
    return Block(path.stem, tuple(cameras.values()), tuple(images), notes=notes)


def _sections(path: Path) -> dict[str, list[_Section]]:
    found: dict[str, list[_Section]] = {"$PHOTO": [], "$CAMERA": [], "$PROJECT": []}
    kind, begun, key = "", 0, ""
    values: dict[str, str] = {}
    rows: dict[str, list[list[float]]] = {}
    for number, words in lines_of(path):
        if not kind:
            kind, begun, key, values, rows = words[0], number, "", {}, {}
            if kind not in _INPHO_READ:
                raise BlockError(f"{path}: line {number}: section {kind[:40]} is not carried")
        elif words[0] == "$END":
            found[kind].append(_Section(kind, begun, values, rows))
            kind = ""
        elif words[0].startswith("$"):
            key = words[0]
            if key == "$PHOTO_POINTS":
                raise BlockError(f"{path}: line {number}: {key}: measurements are not carried")
            values[key] = " ".join(words[2:])
        else:
            rows.setdefault(key, []).append(numbers_of(path, number, words))
    if kind:
        raise BlockError(f"{path}: section {kind} of line {begun} has no $END; copy it again")
    return found


def _inpho_camera(path: Path, section: _Section) -> BlockCamera:
    """Focal length in mm, pixels by the affine of `$CCD_INTERIOR_ORIENTATION`."""
    values, rows = section.values, section.rows.get("$CCD_INTERIOR_ORIENTATION", [])
    where = f"{path}: line {section.line}: camera {values.get('$TYPE', '')}"
    try:
        focal_mm = float(values["$FOCAL_LENGTH"])
        width, height = int(values["$CCD_COLUMNS"]), int(values["$CCD_ROWS"])
        x0, y0 = (float(word) for word in values["$PRINCIPAL_POINT_PPA"].split())
        (a, b, c), (d, e, f) = rows
    except (KeyError, ValueError) as error:
        raise BlockError(f"{where}: {error!r}; it is not understood") from error
    if values.get("$PIXEL_REFERENCE") != "CenterTopLeft" or "$DISTORTION_TYPE" in values:
        raise BlockError(f"{where}: $PIXEL_REFERENCE CenterTopLeft without distortion is read")
    if b or d or a <= 0.0 or abs(a + e) > 1e-9 * a or focal_mm <= 0.0:
        raise BlockError(f"{where}: square pixels, rows downwards, and a positive f are read")
    centre = (c + a * x0, f + e * y0)
    model = ForwardDistortion(focal_mm * a, focal_mm * a, *centre)
    return BlockCamera(values["$TYPE"], width, height, model, 1.0 / a)
