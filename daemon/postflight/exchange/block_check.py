"""What holds for every imported block, whatever format it came from.

Cameras have a size and a finite principal distance, images have names of their own and a proper
rotation, and coordinates are finite.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import numpy as np

from daemon.postflight.exchange.block import Block, BlockCamera, BlockError

ORTHOGONAL_TO: Final = 1e-4
"""Largest element of R R' - I with which a matrix of a file is a rotation."""
_OFF_MIDDLE: Final = 0.05
_IN_MIDDLE: Final = 0.01
"""Shares of the longer side: a principal point far from the middle, and one in it."""
_NAMED: Final = 3
SIDE_MAX_PX: Final = 1_000_000
F_IN_SIDES: Final = (0.01, 10_000.0)
"""Principal distances that a camera may have, in longer sides of its image."""
FAR_M: Final = 100_000.0
"""Distance from the middle of a block that is stated."""
_TERMS: Final = ("skew_px", "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "radial_r8")


def check_block(path: Path, block: Block) -> None:
    """Refuse a block whose numbers cannot be those of cameras, images and points.

    Args:
        path: of the files, for the message.
        block: as read.

    Raises:
        BlockError: the first finding, with the camera, image or point.
    """
    for camera in block.cameras:
        _check_camera(path, camera)
    _refuse_repeated(path, "camera", [camera.name for camera in block.cameras])
    for image in block.images:
        where = f"{path}: image {image.name}"
        if not image.name.strip():
            raise BlockError(f"{path}: an image has no name; give each image a name")
        if not np.isfinite(image.centre_m).all():
            raise BlockError(
                f"{where}: its position is not finite; remove the image, or orient it again"
            )
        if not is_rotation(image.rotation):
            raise BlockError(
                f"{where}: its matrix is no rotation (scaled, sheared or mirrored); export the "
                "orientations again"
            )
    _refuse_repeated(path, "image", [project_name(image.name) for image in block.images])
    finite = np.isfinite(block.points.xyz_m).all(axis=1)
    if not finite.all():
        number = int(np.flatnonzero(~finite)[0])
        raise BlockError(
            f"{path}: point {block.points.names[number]}: its coordinates are not finite; remove "
            "the point and its measurements"
        )
    measured = np.isfinite(block.points.px).all(axis=1)
    if not measured.all():
        number = int(np.flatnonzero(~measured)[0])
        image = block.images[int(block.points.image[number])]
        point = block.points.names[int(block.points.point[number])]
        raise BlockError(
            f"{path}: image {image.name}: its measurement of point {point} is not finite; remove it"
        )


def upward_notes(block: Block) -> tuple[str, ...]:
    """A sentence where most images of a block without measurements look upward.

    Without measurements nothing else shows rotations that were written in the other direction, or
    for axes x right, y down, z forward.
    """
    is_level = block.frame is not None or block.is_metric
    if len(block.points.image) or not is_level:
        return ()
    upward = sum(-float(image.rotation[2, 2]) > 0.0 for image in block.images)
    if 2 * upward <= len(block.images):
        return ()
    return (
        f"{upward} of {len(block.images)} images look upward: if they do not, the rotations are "
        "those of axes x right, y down, z forward, or the angles have another order or unit",
    )


def distance_notes(block: Block) -> tuple[str, ...]:
    """Images far from the middle of a block without measurements, which nothing else shows."""
    if len(block.points.image) or not (block.frame is not None or block.is_metric):
        return ()
    centres = np.array([image.centre_m for image in block.images])
    away_m = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
    far = np.flatnonzero(away_m > FAR_M)
    if not len(far):
        return ()
    named = ", ".join(
        f"{block.images[k].name} {away_m[k] / 1e3:.0f} km" for k in far[:_NAMED].tolist()
    )
    return (
        f"{len(far)} of {len(block.images)} images are more than {FAR_M / 1e3:.0f} km from the "
        f"middle of all: {named}",
    )


def project_name(name: str) -> str:
    """Name of an image in the project: its tables have no spaces in names."""
    return name.replace(" ", "_")


def is_rotation(matrix: np.ndarray, to: float = ORTHOGONAL_TO) -> bool:
    """Whether a matrix (3, 3) is orthogonal to `to` and not mirrored."""
    if not np.isfinite(matrix).all():
        return False
    off = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    return off <= to and float(np.linalg.det(matrix)) > 0.0


def _check_camera(path: Path, camera: BlockCamera) -> None:
    model, where = camera.model, f"{path}: camera {camera.name}"
    if min(camera.width_px, camera.height_px) <= 0:
        raise BlockError(
            f"{where}: its size is {camera.width_px} x {camera.height_px} px; state columns and "
            "rows of its images"
        )
    longer = max(camera.width_px, camera.height_px)
    if longer > SIDE_MAX_PX:
        raise BlockError(
            f"{where}: its size is {camera.width_px} x {camera.height_px} px; no image is larger "
            f"than {SIDE_MAX_PX} px: correct columns and rows"
        )
    low, high = F_IN_SIDES
    for value in (model.fx_px, model.fy_px):
        if math.isfinite(value) and value > 0.0 and not low < value / longer < high:
            raise BlockError(
                f"{where}: its principal distance is {value:g} px, {value / longer:.3g} of the "
                f"longer side of its image; {low:g} to {high:g} are possible: correct it, "
                "the pixel size or the size of the image"
            )
        if not (math.isfinite(value) and value > 0.0):
            raise BlockError(
                f"{where}: its principal distance is {value:g} px; it is finite and positive: "
                "correct it, or remove the camera and its images"
            )
    if not (math.isfinite(model.cx_px) and math.isfinite(model.cy_px)):
        raise BlockError(
            f"{where}: its principal point is {model.cx_px:g}, {model.cy_px:g} px; it is finite: "
            "correct it"
        )
    _refuse_exchanged_size(where, camera)
    wrong = [name for name in _TERMS if not math.isfinite(getattr(model, name))]
    if wrong:
        raise BlockError(f"{where}: its {', '.join(wrong)} are not finite; correct them")
    if camera.pitch_mm is not None and not (math.isfinite(camera.pitch_mm) and camera.pitch_mm > 0):
        raise BlockError(
            f"{where}: its pixel size is {camera.pitch_mm:g} mm; it is finite and positive: "
            "correct it"
        )


def _refuse_exchanged_size(where: str, camera: BlockCamera) -> None:
    """Refuse a principal point in the middle of an image whose columns and rows are exchanged."""
    size = np.array([camera.width_px, camera.height_px])
    centre = np.array([camera.model.cx_px, camera.model.cy_px])
    off = float(np.abs(centre - (size - 1) / 2.0).max())
    exchanged = float(np.abs(centre - (size[::-1] - 1) / 2.0).max())
    if off > _OFF_MIDDLE * size.max() and exchanged < _IN_MIDDLE * size.max():
        raise BlockError(
            f"{where}: its principal point {centre[0]:.1f}, {centre[1]:.1f} px is the middle of "
            f"{size[1]} x {size[0]} px, and its size is {size[0]} x {size[1]} px: columns and rows "
            "are exchanged in one of them; correct the camera"
        )


def _refuse_repeated(path: Path, what: str, names: Iterable[str]) -> None:
    seen: set[str] = set()
    repeated: list[str] = []
    for name in names:
        if name in seen and name not in repeated:
            repeated.append(name)
        seen.add(name)
    if repeated:
        listed = ", ".join(repeated[:_NAMED]) + (", ..." if len(repeated) > _NAMED else "")
        raise BlockError(
            f"{path}: {what} {listed} is there more than once (spaces count as underscores); give "
            "each its own name, or export it once"
        )
