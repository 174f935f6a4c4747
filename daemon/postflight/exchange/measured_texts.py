"""Blocks with image measurements as files of BINGO, PATB, Pix4D and Inpho.

Pix4D gets measurements as they are and camera files with distortion. The others have no model of
ours: they get measurements that are corrected for distortion, and cameras without.

Source: the forms that `daemon.postflight.exchange.photogrammetry_reader` states; of `$PHOTO_POINTS`
of Inpho projects no description is public: point, x, y in mm, then 1.00, a kind and `{ * }`, as
public converters write and read them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.orientation.local_frame import FRAME_FILE
from daemon.postflight.exchange.block import (
    Block,
    BlockCamera,
    BlockError,
    BlockImage,
    BlockPoints,
    fitted,
)
from daemon.postflight.exchange.block_check import project_name
from daemon.postflight.exchange.photogrammetry import (
    ANGLES,
    DEFAULTS,
    UNITS,
    Angles,
    Unit,
    focal_mm,
    inpho_photo,
    inpho_project,
    orientation_line,
    patb_records,
    pitch_mm,
    table_texts,
)
from daemon.postflight.exchange.pix4d import EXTERNAL_HEADER, camera_text
from processing.geometry.rotation import omega_phi_kappa, phi_omega_kappa

Array = NDArray[np.float64]

MEASURED_PROGRAMS: Final = ("bingo", "patb", "pix4d", "inpho")
POINTS_FILE: Final = "object_points.txt"
_NUMBER_MAX: Final = 99_999_999
"""PATB knows points by numbers of eight digits."""
_DECIMALS: Final = 6
"""Of measurements in mm: 1 nm."""


def measured_texts(
    program: str, block: Block, angles: Angles | None, unit: Unit | None
) -> tuple[dict[str, str], dict[str, float]]:
    """The files of a program, and the largest residual of each camera's fit by its name, px.

    Args:
        program: of `MEASURED_PROGRAMS`.
        block: with measurements; without distortion except for Pix4D.
        angles: order for BINGO, None for its own.
        unit: of these angles, None for its own.

    Raises:
        BlockError: angles for a program that has its own, an order that needs the earth, names
            that are not unique without spaces, or a camera that does not fit.
    """
    if program != "bingo" and (angles is not None or unit is not None):
        raise BlockError(f"{program} has angles of its own; leave --angles and --unit out")
    if angles == "heading-roll-pitch":
        raise BlockError(
            "heading-roll-pitch needs a place on the earth for each image; choose "
            "omega-phi-kappa or phi-omega-kappa, or `syntopic export block`"
        )
    names = [project_name(image.name) for image in block.images]
    if len(set(names)) < len(names):
        raise BlockError("images under one name, with spaces as underscores; rename one of them")
    if "-99" in {*block.points.names, *names}:
        raise BlockError("-99 ends an image in these files; rename the point or image -99")
    residuals = dict.fromkeys((camera.name for camera in block.cameras), 0.0)
    if program == "pix4d":
        fits = {camera.name: fitted(camera, ("pinhole", "brown")) for camera in block.cameras}
        models = [model for _, model, _ in fits.values()]
        residuals = {name: worst_px for name, (_, _, worst_px) in fits.items()}
    block = replace(_named(block, names), points=_by_appearance(block.points))
    rows = [_rows(block, k) for k in range(len(block.images))]
    points = list(block.points.names)
    texts = table_texts(block, "")
    stated = "rotation matrix by rows, grid from camera"
    if program == "patb":
        points = _numbers(points)
        texts |= _patb_files(block, points, rows)
    elif program == "inpho":
        texts["block.prj"] = _inpho_project(block, points, rows)
    else:
        order: Angles = "omega-phi-kappa" if program == "pix4d" else angles or DEFAULTS["bingo"][0]
        in_unit: Unit = "deg" if program == "pix4d" else unit or DEFAULTS["bingo"][1]
        stated = f"{ANGLES[order]}\nunit: {in_unit}"
        lines = [
            orientation_line(image.name, image.centre_m, _angles(image, order, UNITS[in_unit]))
            for image in block.images
        ]
        texts["block_bingo.txt"] = _bingo_measurements(block, points, rows)
        if program == "bingo":
            texts["orientation.bingo"] = "\n".join(lines) + "\n"
        else:
            texts["external_camera_parameters.txt"] = "\n".join(
                [EXTERNAL_HEADER, *(" ".join(line.split()) for line in lines), ""]
            )
            texts |= {
                f"{camera.name}.cam": camera_text(
                    model, pitch_mm(camera), camera.width_px, camera.height_px
                )
                for camera, model in zip(block.cameras, models, strict=True)
            }
    texts["angles.txt"] = _conventions(block, stated)
    texts[POINTS_FILE] = _object_points(block, points)
    if block.frame is not None:
        origin = {
            "latitude_deg": block.frame.latitude_deg,
            "longitude_deg": block.frame.longitude_deg,
        }
        texts[FRAME_FILE] = json.dumps(origin) + "\n"
    return texts, residuals


_Row = tuple[int, float, float]
"""Point, x and y, mm from the middle of the image, y up."""


def _patb_files(
    block: Block, points: Sequence[str], rows: Sequence[Sequence[_Row]]
) -> dict[str, str]:
    """Orientations, and measurements in um: photo and focal length, its points, -99."""
    orientations, lines = [], []
    for number, (image, of_image) in enumerate(zip(block.images, rows, strict=True), 1):
        orientations.append(patb_records(number, image.centre_m, image.rotation))
        lines.append(f"{number:>10} {focal_mm(block.cameras[image.camera]) * 1e3:14.3f}")
        lines += [f"{points[p]:>10} {_um(x):>14} {_um(y):>14}" for p, x, y in of_image]
        lines.append(f"{-99:>10}")
    return {"orientation.ori": "".join(orientations), "block.im": "\n".join([*lines, ""])}


def _inpho_project(block: Block, points: Sequence[str], rows: Sequence[Sequence[_Row]]) -> str:
    photos = []
    for image, of_image in zip(block.images, rows, strict=True):
        camera = block.cameras[image.camera]
        measured = [
            f"{points[p]} {_mm(x)} {_mm(y)} 1.00 2 {{ * }}"
            for p, x, y in _about_principal_point(camera, of_image)
        ]
        photos.append(
            inpho_photo(
                image.name, image.name, camera, "", image.centre_m, image.rotation, measured
            )
        )
    return inpho_project(replace(block, name="block"), photos)


def _bingo_measurements(block: Block, points: Sequence[str], rows: Sequence[Sequence[_Row]]) -> str:
    """Image and camera, its points, and an empty line."""
    lines = []
    for image, of_image in zip(block.images, rows, strict=True):
        lines.append(f"{image.name} {block.cameras[image.camera].name}")
        lines += [f"{points[p]} {_mm(x)} {_mm(y)}" for p, x, y in of_image]
        lines.append("")
    return "\n".join(lines)


def _named(block: Block, names: Sequence[str]) -> Block:
    """The block with names of images and cameras without spaces."""
    images = zip(block.images, names, strict=True)
    return replace(
        block,
        images=tuple(replace(image, name=name) for image, name in images),
        cameras=tuple(replace(one, name=project_name(one.name)) for one in block.cameras),
    )


def _by_appearance(points: BlockPoints) -> BlockPoints:
    """Measurements by image, points in the order in which these have them: that of a reader."""
    order = np.lexsort((points.point, points.image))
    appeared, first = np.unique(points.point[order], return_index=True)
    kept = appeared[np.argsort(first)]
    rank = np.full(len(points.names), -1)
    rank[kept] = np.arange(len(kept))
    order = np.lexsort((rank[points.point], points.image))
    return BlockPoints(
        points.xyz_m[kept],
        tuple(points.names[k] for k in kept),
        points.image[order],
        rank[points.point[order]],
        points.px[order],
    )


def _rows(block: Block, image: int) -> list[_Row]:
    """Each measurement of an image."""
    points = block.points
    camera = block.cameras[block.images[image].camera]
    middle = np.array([(camera.width_px - 1) / 2.0, (camera.height_px - 1) / 2.0])
    own = np.flatnonzero(points.image == image)
    xy_mm = (points.px[own] - middle) * [1.0, -1.0] * pitch_mm(camera)
    return [
        (int(point), float(x), float(y))
        for point, (x, y) in zip(points.point[own], xy_mm, strict=True)
    ]


def _about_principal_point(camera: BlockCamera, rows: Sequence[_Row]) -> list[_Row]:
    """Rows about the principal point, the zero of an Inpho camera of ours."""
    x0_mm = (camera.model.cx_px - (camera.width_px - 1) / 2.0) * pitch_mm(camera)
    y0_mm = ((camera.height_px - 1) / 2.0 - camera.model.cy_px) * pitch_mm(camera)
    return [(point, x - x0_mm, y - y0_mm) for point, x, y in rows]


def _mm(value: float) -> str:
    return f"{round(value, _DECIMALS) + 0.0:.{_DECIMALS}f}"


def _um(value_mm: float) -> str:
    return f"{round(value_mm * 1e3, _DECIMALS - 3) + 0.0:.{_DECIMALS - 3}f}"


def _numbers(names: Sequence[str]) -> list[str]:
    """Names that PATB reads: as they are where all are numbers, otherwise numbers from 1."""
    if all(
        name.isascii()
        and name.isdigit()
        and str(int(name)) == name
        and 0 < int(name) <= _NUMBER_MAX
        for name in names
    ):
        return list(names)
    return [str(number) for number in range(1, len(names) + 1)]


def _angles(image: BlockImage, order: Angles, factor: float) -> tuple[float, float, float]:
    convert = omega_phi_kappa if order == "omega-phi-kappa" else phi_omega_kappa
    a, b, c = (math.degrees(angle) * factor for angle in convert(image.rotation))
    return a, b, c


def _conventions(block: Block, angles: str) -> str:
    frame = "that of the project" if block.frame is None else block.frame.name
    return (
        f"coordinate system: {frame}\n"
        f"angles: {angles}\n"
        "camera axes: x right, y up (flight direction), z back\n"
        "image coordinates: from the middle of the image, x right, y up\n"
        + "".join(f"note: {note}\n" for note in block.notes)
    )


def _object_points(block: Block, names: Sequence[str]) -> str:
    """Name in the files, X, Y, Z in m, and name in the project."""
    rows = zip(names, block.points.xyz_m.tolist(), block.points.names, strict=True)
    return "# point X Y Z name\n" + "".join(
        f"{name} {x:.4f} {y:.4f} {z:.4f} {own}\n" for name, (x, y, z), own in rows
    )


def what_to_know(program: str, block: Block) -> tuple[str, ...]:
    """What a reader of the files has to know: corrections, and points that got numbers."""
    own = list(block.points.names)
    notes = list(block.notes)
    if program == "patb" and _numbers(own) != own:
        notes.append(f"points have numbers in PATB's files; {POINTS_FILE} has their names")
    return tuple(notes)
