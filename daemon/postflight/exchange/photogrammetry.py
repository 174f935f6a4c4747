"""Exterior orientations for BINGO, PATB, BLUH, ImageStation and Inpho, with the camera block.

Images are in strict perspective: none of these files gets a distortion. Order and unit of angles
are chosen; each program has its own as the default, and `angles.txt` states them next to the files.

Source: PAT-B, BINGO and BLUH manuals, exterior orientation files; files of ApplicationsMaster
(`$CAMERA`, `$PHOTO`, `$EXT_ORI`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from daemon.orientation.exterior_orientation import ExteriorOrientation
from daemon.postflight.exchange.block import Block, BlockCamera, BlockError, BlockImage
from daemon.postflight.exchange.opensfm import yaw_pitch_roll_deg
from drivers.timescales.leap_seconds import leap_seconds_at
from processing.geometry.rotation import omega_phi_kappa, phi_omega_kappa

Array = NDArray[np.float64]
Angles = Literal["omega-phi-kappa", "phi-omega-kappa", "heading-roll-pitch"]
Unit = Literal["deg", "gon"]

ANGLES: Final[Mapping[Angles, str]] = {
    "omega-phi-kappa": "omega, phi, kappa of R = Rx(omega) Ry(phi) Rz(kappa), grid from camera",
    "phi-omega-kappa": "phi, omega, kappa of R = Ry(phi) Rx(omega) Rz(kappa), grid from camera",
    "heading-roll-pitch": "heading from true north, roll, pitch of the image against the local "
    "level, heading first, then pitch, then roll; zero where it looks down",
}
UNITS: Final[Mapping[Unit, float]] = {"deg": 1.0, "gon": 10.0 / 9.0}
DEFAULTS: Final[Mapping[str, tuple[Angles, Unit]]] = {
    "bingo": ("phi-omega-kappa", "gon"),
    "bluh": ("phi-omega-kappa", "gon"),
    "imagestation": ("omega-phi-kappa", "deg"),
    "patb": ("omega-phi-kappa", "deg"),
    "inpho": ("omega-phi-kappa", "deg"),
}
"""Order and unit that each program takes; PATB and Inpho read matrices."""
MATRIX_PROGRAMS: Final = ("patb", "inpho")
CAMERAS_FILE: Final = "cameras.txt"
"""The cameras next to files that do not state them: the programs ask for these values."""
_DECIMALS: Final = 9
"""Of mm and um of cameras: read and written again they are the same."""
_GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)


def photogrammetry_texts(
    program: str, block: Block, suffix: str, angles: Angles | None, unit: Unit | None
) -> dict[str, str]:
    """The files of a program.

    Args:
        program: key of `DEFAULTS`.
        block: perspective images, oriented in a coordinate system.
        suffix: of the image files' names.
        angles: order, None for the program's own.
        unit: None for the program's own.

    Raises:
        BlockError: images with distortion or without an orientation in a coordinate system, or
            angles for a program that reads matrices.
    """
    if any(camera.rays is not None for camera in block.cameras):
        raise BlockError(
            f"{program} gets images in strict perspective; choose --images perspective"
        )
    if program in MATRIX_PROGRAMS and (angles is not None or unit is not None):
        raise BlockError(f"{program} reads rotation matrices; leave --angles and --unit out")
    order, in_unit = angles or DEFAULTS[program][0], unit or DEFAULTS[program][1]
    rows: list[tuple[int, BlockImage, ExteriorOrientation]] = []
    for number, image in enumerate(block.images, 1):
        if image.eo is None:
            raise BlockError(f"image {image.name} has no orientation in a coordinate system")
        rows.append((number, image, image.eo))
    if block.georeference is None:
        raise BlockError("the coordinate system of the orientations is not known")
    texts = table_texts(block, suffix)
    if program == "inpho":
        texts[f"{block.name}.prj"] = _inpho(block, suffix)
    elif program == "patb":
        texts["orientation.ori"] = "".join(
            patb_records(n, eo.centre_m, eo.rotation) for n, _, eo in rows
        )
    else:
        lines = (
            orientation_line(
                f"{n:10d}" if program == "bluh" else image.name,
                eo.centre_m,
                angles_of(eo, order, in_unit),
            )
            for n, image, eo in rows
        )
        texts[f"orientation.{program}"] = "\n".join(lines) + "\n"
    is_matrix = program in MATRIX_PROGRAMS
    stated = "rotation matrix by rows, grid from camera" if is_matrix else ANGLES[order]
    system = block.georeference
    texts["angles.txt"] = (
        f"coordinate system: {system.name}, heights {system.height_system}\n"
        f"angles: {stated}\n"
        + ("" if is_matrix else f"unit: {in_unit}\n")
        + "camera axes: x right, y up (flight direction), z back\n"
    )
    return texts


def table_texts(block: Block, suffix: str) -> dict[str, str]:
    """`photos.txt`, number, file and camera of each image, and `cameras.txt`.

    Raises:
        BlockError: a camera without a pixel size.
    """
    photos = (
        f"{n} {image.name}{suffix} {block.cameras[image.camera].name}\n"
        for n, image in enumerate(block.images, 1)
    )
    cameras = "".join(_camera_row(camera) for camera in block.cameras)
    header = "# name f_mm x0_mm y0_mm pixel_um columns rows\n"
    return {"photos.txt": "".join(photos), CAMERAS_FILE: header + cameras}


def angles_of(eo: ExteriorOrientation, order: Angles, unit: Unit) -> tuple[float, float, float]:
    """Three angles of an orientation in an order and a unit."""
    if order == "heading-roll-pitch":
        yaw, pitch, roll = yaw_pitch_roll_deg(eo.enu_from_camera)
        degrees = (yaw, roll, pitch)
    else:
        convert = omega_phi_kappa if order == "omega-phi-kappa" else phi_omega_kappa
        first, second, third = (math.degrees(angle) for angle in convert(eo.rotation))
        degrees = (first, second, third)
    a, b, c = (value * UNITS[unit] for value in degrees)
    return a, b, c


def orientation_line(name: str, centre_m: Array, angles: tuple[float, float, float]) -> str:
    """Name or number, place with 4 decimals, and three angles with 7, without a line end."""
    place = "".join(f" {value:14.4f}" for value in centre_m)
    return name + place + "".join(f" {angle:13.7f}" for angle in angles)


def patb_records(number: int, centre_m: Array, rotation: Array) -> str:
    """Three records (I16,16x,3F16.5 / 5F16.12 / 4F16.12), the matrix (3, 3) by rows."""
    r = [float(value) for value in rotation.reshape(-1)]
    place = "".join(f"{value:16.5f}" for value in centre_m)
    first = "".join(f"{value:16.12f}" for value in r[:5])
    second = "".join(f"{value:16.12f}" for value in r[5:])
    return f"{number:16d}{'':16}{place}\n{first}\n{second}\n"


def _inpho(block: Block, suffix: str) -> str:
    photos = []
    for image in block.images:
        eo = image.eo
        if eo is None:
            raise BlockError(f"image {image.name} has no orientation in a coordinate system")
        seconds = eo.gps_ns // 1_000_000_000 - leap_seconds_at(eo.gps_ns)
        at = f"{_GPS_EPOCH + timedelta(seconds=seconds):%H:%M:%S %d/%m/%Y}"
        camera = block.cameras[image.camera]
        file = f"images/{image.name}{suffix}"
        photos.append(inpho_photo(image.name, file, camera, at, eo.centre_m, eo.rotation))
    return inpho_project(block, photos)


def inpho_project(block: Block, photos: Sequence[Sequence[str]]) -> str:
    """A project of photos, with the cameras of the block.

    Raises:
        BlockError: a camera without a pixel size.
    """
    lines = [
        "$PROJECT 5.0.0",
        f"  $PROJECT_NAME : {block.name}",
        "  $LINEAR_UNITS_OF_OBJECT : m",
        "  $LINEAR_UNITS_OF_IMAGE : mm",
        "  $ANGULAR_UNITS : deg",
        "$END",
    ]
    for photo in photos:
        lines += photo
    for camera in block.cameras:
        lines += _camera(camera)
    return "\n".join(lines) + "\n"


def inpho_photo(
    name: str,
    file: str,
    camera: BlockCamera,
    at: str,
    centre_m: Array,
    rotation: Array,
    points: Sequence[str] = (),
) -> list[str]:
    """Lines of a photo: its file, its orientation of an instant, and its measurements."""
    place = " ".join(f"{value:.5f}" for value in centre_m)
    measured = ["  $PHOTO_POINTS :", *(f"    {row}" for row in points), "  $END_POINTS"]
    return [
        "$PHOTO",
        f"  $PHOTO_NUM : {name}",
        f"  $PHOTO_FILE : {file}",
        f"  $CAMERA_ID : {camera.name}",
        "  $ORI_STAT : Initial",
        f"  $EXT_ORI : {at}".rstrip(),
        f"    {focal_mm(camera):.6f} {place}",
        *("    " + " ".join(f"{value:.12f}" for value in row) for row in rotation.tolist()),
        *(measured if points else ()),
        "$END",
    ]


def _camera(camera: BlockCamera) -> list[str]:
    per_mm = 1.0 / pitch_mm(camera)
    model = camera.model
    return [
        "$CAMERA",
        f"  $TYPE : {camera.name}",
        "  $BRAND : Custom",
        "  $KIND : CCDFrame",
        "  $CCD_INTERIOR_ORIENTATION :",
        f"    {per_mm:.12f} 0.000000000000 {model.cx_px:.6f}",
        f"    0.000000000000 {-per_mm:.12f} {model.cy_px:.6f}",
        f"  $CCD_COLUMNS : {camera.width_px}",
        f"  $CCD_ROWS : {camera.height_px}",
        "  $PIXEL_REFERENCE : CenterTopLeft",
        f"  $FOCAL_LENGTH : {focal_mm(camera):.6f}",
        "  $PRINCIPAL_POINT_PPA : 0.000000 0.000000",
        "  $GPS_ANTENNA_OFFSET : 0.000000 0.000000 0.000000",
        "  $CAMERA_MOUNT_ROTATION : 0.000000",
        "$END",
    ]


def _camera_row(camera: BlockCamera) -> str:
    """A line of `cameras.txt`: the principal point from the middle of the image, y up."""
    model, pitch = camera.model, pitch_mm(camera)
    x0_mm = (model.cx_px - (camera.width_px - 1) / 2.0) * pitch
    y0_mm = ((camera.height_px - 1) / 2.0 - model.cy_px) * pitch
    values = (focal_mm(camera), x0_mm, y0_mm, pitch * 1e3)
    numbers = " ".join(repr(round(float(value), _DECIMALS) + 0.0) for value in values)
    return f"{camera.name} {numbers} {camera.width_px} {camera.height_px}\n"


def pitch_mm(camera: BlockCamera) -> float:
    """Pixel size, mm.

    Raises:
        BlockError: it is not known.
    """
    if camera.pitch_mm is None:
        raise BlockError(f"camera {camera.name} has no pixel size")
    return camera.pitch_mm


def focal_mm(camera: BlockCamera) -> float:
    """Principal distance, mm."""
    return camera.model.fx_px * pitch_mm(camera)
