"""Blocks of BINGO and PATB: orientations, image measurements and cameras of a folder.

Object points are intersected from the orientations, and whatever contradicts them (exchanged axes,
another order or unit of angles) is refused: neither file states its conventions itself.

Source: BINGO image coordinates as Pix4D documents its `bingo.txt` (image and camera, then point,
x, y in mm from the middle of the image); PATB exterior orientation, three records a photo, as PCI
Geomatics documents it; PATB image coordinates, photo and focal length, then point, x, y, ended by
-99, as PAT-B's manual has them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePath
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.exchange.block import (
    Block,
    BlockCamera,
    BlockError,
    BlockImage,
)
from daemon.postflight.exchange.coordinate_unit import NOT_STATED, frame_next_to, is_in_metres
from daemon.postflight.exchange.intersected_points import (
    Measured,
    OtherConventionError,
    intersected,
)
from daemon.postflight.exchange.other_readings import TRIED_PX, Reading, refuse_other_reading
from daemon.postflight.exchange.photogrammetry import ANGLES, CAMERAS_FILE, UNITS, Unit
from daemon.postflight.exchange.text_lines import lines_of, numbers_of, only_file
from processing.geometry.forward_distortion import (
    ForwardDistortion,
)
from processing.geometry.rotation import rotation_from_angles

Array = NDArray[np.float64]

_FOCAL_WITHIN: Final = 1e-3
_END: Final = "-99"
_ORTHOGONAL_TO: Final = 1e-5
_FULL_UNITS: Final[Mapping[str, float]] = {
    "deg": UNITS["deg"],
    "gon": UNITS["gon"],
    "rad": math.pi / 180.0,
}
_ORDERS: Final = {"omega-phi-kappa": "XYZ", "phi-omega-kappa": "YXZ"}
BINGO_PATTERNS: Final = ("*bingo*.txt", "*.dat")


@dataclass(frozen=True)
class Oriented:
    """Place and rotation, grid from camera, of an image by its name or number."""

    centre_m: Array
    rotation: Array


def read_bingo(folder: Path) -> Block:
    """Read `*bingo*.txt` or `*.dat` with measurements, the orientation, and `cameras.txt`.

    The orientation is `orientation.bingo` with `angles.txt`, as `export block` writes them.

    Raises:
        BlockError: a file that is missing or not understood, or files that contradict each other.
    """
    cameras = cameras_of(folder)
    order, unit, system = _stated(folder)
    path = only_file(folder, ("orientation.bingo",), "that of `export block`")
    measurements = only_file(folder, BINGO_PATTERNS, "<name>_bingo.txt")
    measured = bingo_measurements(measurements, cameras)
    oriented = named_orientations(path, order, unit)
    readings = angle_readings(path, order, unit)
    is_metric = is_in_metres(folder, system)
    return measured_block(
        folder, cameras, oriented, measured, system, {}, readings, is_metric=is_metric
    )


def angle_readings(
    path: Path, order: str, unit: str, *, header: Sequence[str] = ()
) -> list[Reading]:
    """Orientations of a file in the other orders and units of angles."""
    called = {axes: name for name, axes in _ORDERS.items()}

    def rotations(axes: str, in_unit: str) -> dict[str, Array]:
        found = named_orientations(path, axes, in_unit, header=header)
        return {key: one.rotation for name, one in found.items() for key in (name, _stem(name))}

    return [
        Reading(
            f"{called[axes]} in {in_unit}",
            f"state order and unit of {path.name} as they are, not {called[order]} in {unit}",
            partial(rotations, axes, in_unit),
        )
        for axes in sorted(called, key=lambda one: one != order)
        for in_unit in _FULL_UNITS
        if (axes, in_unit) != (order, unit)
    ]


def read_patb(folder: Path) -> Block:
    """Read `*.im` with measurements, `*.ori` with the orientation, and `cameras.txt`.

    Raises:
        BlockError: a file that is missing or not understood, or files that contradict each other.
    """
    cameras = cameras_of(folder)
    oriented = _three_records(only_file(folder, ("*.ori",), "orientation.ori"))
    photos = photos_of(folder, cameras)
    measured = _patb(only_file(folder, ("*.im",), "<name>.im"), cameras, photos)
    system = _stated(folder)[2] if (folder / "angles.txt").exists() else "not stated in the files"
    names = {number: name for number, (name, _) in photos.items()}
    is_metric = is_in_metres(folder, system)
    return measured_block(
        folder, cameras, oriented, measured, system, names, (), is_metric=is_metric
    )


def cameras_of(folder: Path) -> dict[str, BlockCamera]:
    """`cameras.txt`: name, f, principal point, mm, pixel size, um, columns, rows."""
    path = folder / CAMERAS_FILE
    if not path.exists():
        raise BlockError(
            f"{folder}: has no {CAMERAS_FILE}, and neither program's files state the camera; write "
            "one line for each: name, f in mm, x0 and y0 of the principal point in mm, pixel size "
            "in um, columns, rows"
        )
    cameras: dict[str, BlockCamera] = {}
    for number, words in lines_of(path):
        if words[0].startswith("#"):
            continue
        if len(words) != 7:
            raise BlockError(f"{path}: line {number}: {len(words)} columns; 7 are right")
        f_mm, x0, y0, pitch_um, width, height = numbers_of(path, number, words[1:])
        sides = (round(width), round(height))
        if not (f_mm > 0.0 and pitch_um > 0.0 and sides == (width, height) and min(sides) > 0):
            raise BlockError(f"{path}: line {number}: f, pixel size and sides are positive")
        if words[0] in cameras:
            raise BlockError(f"{path}: line {number}: camera {words[0]} is there twice")
        pitch, f_px = pitch_um * 1e-3, f_mm / (pitch_um * 1e-3)
        centre = ((width - 1) / 2.0 + x0 / pitch, (height - 1) / 2.0 - y0 / pitch)
        model = ForwardDistortion(f_px, f_px, *centre)
        cameras[words[0]] = BlockCamera(words[0], *sides, model, pitch)
    if not cameras:
        raise BlockError(f"{path}: names no camera")
    return cameras


def photos_of(folder: Path, cameras: Mapping[str, BlockCamera]) -> dict[str, tuple[str, str]]:
    """File and camera of each photo's number, of `photos.txt` where there is one."""
    path = folder / "photos.txt"
    photos: dict[str, tuple[str, str]] = {}
    for number, words in lines_of(path) if path.exists() else []:
        if len(words) != 3:
            raise BlockError(
                f"{path}: line {number}: {len(words)} columns; number, file and camera are right"
            )
        photos[words[0]] = (words[1], _known_camera(path, number, words[2], cameras))
    return photos


def _stated(folder: Path) -> tuple[str, Unit, str]:
    """Order of axes, unit, and coordinate system that `angles.txt` states."""
    path = folder / "angles.txt"
    if not path.exists():
        raise BlockError(
            f"{folder}: has no angles.txt, and orientation.bingo does not state the order and unit "
            "of its angles; write it as `syntopic export block --to bingo` does"
        )
    text = "\n".join(" ".join(words) for _, words in lines_of(path))
    rows = dict(row.split(": ", 1) for row in text.split("\n") if ": " in row)
    order = next((k for k, stated in ANGLES.items() if rows.get("angles") == stated), None)
    unit: Unit = "gon" if rows.get("unit") == "gon" else "deg"
    if rows.get("angles", "").startswith("rotation matrix"):
        return "matrix", unit, rows.get("coordinate system", "")
    if order not in _ORDERS or rows.get("unit") not in UNITS:
        raise BlockError(
            f"{path}: angles {rows.get('angles', 'not stated')!r}, unit "
            f"{rows.get('unit', 'not stated')!r}; {' or '.join(_ORDERS)} in deg or gon are read"
        )
    return _ORDERS[order], unit, rows.get("coordinate system", "")


def named_orientations(
    path: Path, axes: str, unit: str, *, header: Sequence[str] = ()
) -> dict[str, Oriented]:
    """Name, place and three angles in each line, the first one the header where there is one."""
    rows = lines_of(path)
    if header and (not rows or tuple(rows.pop(0)[1]) != tuple(header)):
        raise BlockError(f"{path}: does not begin with {' '.join(header)}")
    if axes not in _ORDERS.values():
        raise BlockError(f"{path}: angles.txt states a matrix, and this file has angles")
    found: dict[str, Oriented] = {}
    for number, words in rows:
        if len(words) != 7:
            raise BlockError(f"{path}: line {number}: {len(words)} columns; 7 are right")
        values = numbers_of(path, number, words[1:])
        angles = np.radians(np.array(values[3:]) / _FULL_UNITS[unit])
        rotation = rotation_from_angles(axes, angles.tolist())
        _add(found, path, number, words[0], np.array(values[:3]), np.asarray(rotation))
    return found


def _three_records(path: Path) -> dict[str, Oriented]:
    rows = lines_of(path)
    if len(rows) % 3:
        raise BlockError(f"{path}: {len(rows)} lines; PATB has three records a photo")
    found: dict[str, Oriented] = {}
    for first, second, third in zip(rows[::3], rows[1::3], rows[2::3], strict=True):
        number, words = first
        if (len(words), len(second[1]), len(third[1])) != (4, 5, 4):
            raise BlockError(
                f"{path}: line {number}: records of {len(words)}, {len(second[1])} and "
                f"{len(third[1])} numbers; photo, X, Y, Z, then 5 and 4 of the matrix are right"
            )
        turn = numbers_of(path, *second) + numbers_of(path, *third)
        rotation = np.array(turn).reshape(3, 3)
        off = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if off > _ORTHOGONAL_TO or np.linalg.det(rotation) < 0.0:
            raise BlockError(f"{path}: line {number}: photo {words[0]}: no rotation matrix")
        place = np.array(numbers_of(path, number, words[1:]))
        _add(found, path, number, words[0], place, rotation)
    return found


def _add(
    found: dict[str, Oriented], path: Path, number: int, name: str, place: Array, turn: Array
) -> None:
    if name in found:
        raise BlockError(f"{path}: line {number}: image {name} is there twice")
    found[name] = Oriented(place, turn)


def bingo_measurements(path: Path, cameras: Mapping[str, BlockCamera]) -> dict[str, Measured]:
    """Image and camera in a line, then its points; -99 or an empty line may end an image."""
    found: dict[str, dict[str, tuple[float, float]]] = {}
    camera_of: dict[str, str] = {}
    current = ""
    for number, words in lines_of(path):
        if words[0] == _END:
            continue
        if len(words) == 2:
            current, camera = words
            if current in found:
                raise BlockError(f"{path}: line {number}: image {current} is there twice")
            camera_of[current] = _known_camera(path, number, camera, cameras)
            found[current] = {}
        elif len(words) == 3 and current:
            _measure(path, number, words, found[current], 1.0)
        else:
            raise BlockError(
                f"{path}: line {number}: {len(words)} columns; image and camera, or point, x, y in "
                "mm are read, and further columns are not carried"
            )
    return {name: Measured(camera_of[name], points) for name, points in found.items()}


def _known_camera(path: Path, number: int, name: str, cameras: Mapping[str, BlockCamera]) -> str:
    if name not in cameras:
        raise BlockError(
            f"{path}: line {number}: camera {name} is not in {CAMERAS_FILE}, which has "
            f"{', '.join(cameras)}"
        )
    return name


def _patb(
    path: Path, cameras: Mapping[str, BlockCamera], photos: Mapping[str, tuple[str, str]]
) -> dict[str, Measured]:
    """Photo and focal length, then its points, ended by -99; both in mm, or both in um."""
    found: dict[str, dict[str, tuple[float, float]]] = {}
    camera_of: dict[str, str] = {}
    current, mm = "", 1.0
    for number, words in lines_of(path):
        if words[0] == _END:
            current = ""
        elif not current:
            if len(words) != 2:
                raise BlockError(
                    f"{path}: line {number}: {len(words)} columns; photo and focal length are "
                    "read, and further columns are not carried"
                )
            current = words[0]
            if current in found:
                raise BlockError(f"{path}: line {number}: photo {current} is there twice")
            (focal,) = numbers_of(path, number, words[1:])
            own = photos[current][1] if current in photos else None
            known = cameras if own is None else {own: cameras[own]}
            camera_of[current], mm = _camera_of_focal(path, number, focal, known)
            found[current] = {}
        elif len(words) == 3 or (len(words) == 4 and words[3] in ("0", "1")):
            _measure(path, number, words[:3], found[current], mm)
        else:
            raise BlockError(
                f"{path}: line {number}: {' '.join(words)[:60]!r}; point, x, y are read. A weight "
                "group other than 0 or 1 is not carried; give the block one accuracy, and "
                "--image-sigma states it"
            )
    if current:
        raise BlockError(f"{path}: photo {current} does not end with {_END}; copy it again")
    return {name: Measured(camera_of[name], points) for name, points in found.items()}


def _camera_of_focal(
    path: Path, number: int, focal: float, cameras: Mapping[str, BlockCamera]
) -> tuple[str, float]:
    """The one camera of a focal length in mm or um, and the mm of that unit."""
    found = [
        (name, mm)
        for name, camera in cameras.items()
        for mm in (1.0, 1e-3)
        if abs(focal * mm / _focal_mm(camera) - 1.0) < _FOCAL_WITHIN
    ]
    if len(found) != 1:
        listed = ", ".join(f"{name} {_focal_mm(c):.4f}" for name, c in cameras.items())
        raise BlockError(
            f"{path}: line {number}: focal length {focal:g} is that of {len(found)} cameras in mm "
            f"or um; {CAMERAS_FILE} has {listed}"
        )
    return found[0]


def _focal_mm(camera: BlockCamera) -> float:
    return camera.model.fx_px * (camera.pitch_mm or 1.0)


def _measure(
    path: Path,
    number: int,
    words: Sequence[str],
    points: dict[str, tuple[float, float]],
    mm: float,
) -> None:
    if words[0] in points:
        raise BlockError(f"{path}: line {number}: point {words[0]} is twice in this image")
    x, y = numbers_of(path, number, words[1:])
    points[words[0]] = (x * mm, y * mm)


def measured_block(
    folder: Path,
    cameras: Mapping[str, BlockCamera],
    oriented: Mapping[str, Oriented],
    measured: Mapping[str, Measured],
    system: str,
    names: Mapping[str, str],
    readings: Iterable[Reading],
    *,
    is_metric: bool,
) -> Block:
    """A block with points intersected from its measurements.

    Raises:
        BlockError: images without orientation, or rays that do not meet; it names the reading in
            which they do.
    """
    oriented = _by_names_of(measured, oriented)
    without = sorted(set(measured) - set(oriented))
    if without:
        raise BlockError(
            f"{folder}: {len(without)} images with measurements have no orientation: "
            f"{', '.join(without[:5])}"
        )
    notes = [f"coordinate system: {system}; the curvature of the earth is not modelled"]
    unmeasured = sorted(set(oriented) - set(measured))
    if unmeasured:
        notes.append(f"{len(unmeasured)} images without measurements: {', '.join(unmeasured[:5])}")
    index = {name: k for k, name in enumerate(cameras)}
    images = tuple(
        BlockImage(
            names.get(name, name),
            index[one.camera],
            k,
            oriented[name].centre_m,
            oriented[name].rotation,
        )
        for k, (name, one) in enumerate(measured.items())
    )
    if not images:
        raise BlockError(f"{folder}: no image has measurements")
    every = tuple(cameras.values())
    try:
        points, median_px = intersected(folder, every, images, measured)
    except OtherConventionError as error:
        refuse_other_reading(folder, every, images, measured, error.median_px, readings)
        raise
    if median_px > TRIED_PX:
        refuse_other_reading(folder, every, images, measured, median_px, readings)
    single = sorted({point for one in measured.values() for point in one.points} - {*points.names})
    if single:
        notes.append(
            f"{len(single)} points are measured in one image only and are left out: "
            f"{', '.join(single[:5])}"
        )
    notes.append(
        f"points are intersected from the orientations, which they fit with a median of "
        f"{median_px:.2f} px"
    )
    name = folder.resolve().name
    frame = frame_next_to(folder / CAMERAS_FILE)
    is_metric = is_metric or frame is not None
    if not is_metric:
        notes.insert(0, NOT_STATED)
    return Block(name, every, images, frame, points=points, notes=tuple(notes), is_metric=is_metric)


def _by_names_of(
    measured: Mapping[str, Measured], oriented: Mapping[str, Oriented]
) -> Mapping[str, Oriented]:
    """Orientations by the names of the measurements, which may have no suffix of a file."""
    if set(measured) <= set(oriented):
        return oriented
    by_stem = {_stem(name): one for name, one in oriented.items()}
    return by_stem if len(by_stem) == len(oriented) else oriented


def _stem(name: str) -> str:
    return PurePath(name).stem
