"""A block of oriented images, independent of any program's files.

Positions are in a local Cartesian frame (`daemon.orientation.local_frame`) or in a frame that an
imported file does not state. Camera axes are ours: x right, y up (forward), z towards the back.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.orientation.exterior_orientation import ExteriorOrientation
from daemon.orientation.georeference import Georeference
from daemon.orientation.local_frame import LocalFrame
from processing.geometry.forward_distortion import Form, ForwardDistortion, fit_distortion
from processing.geometry.rotation import rotations_from_vectors, vectors_from_rotations

Array = NDArray[np.float64]

FIT_LIMIT_PX = 0.02
"""Largest residual with which a calibration is converted to another program's camera model."""
VISION_FROM_CAMERA = np.diag([1.0, -1.0, -1.0])
"""Axes of computer vision, x right, y down, z forward, from ours. Its own inverse."""


class BlockError(DaemonError):
    """A block that cannot be written or read; the message names what is wrong and the cure."""


@dataclass(frozen=True)
class BlockCamera:
    """One camera: size, nominal pixel pitch, and its model as pinhole or as pairs to be fitted.

    `model` maps rays to pixels, integer at the pixel centre. Where `rays` (n, 2) and `pixels`
    (n, 2) are given, it is the pinhole nearest to them, and `fitted` gives the distortion.
    """

    name: str
    width_px: int
    height_px: int
    model: ForwardDistortion
    pitch_mm: float | None = None
    bands: tuple[str, ...] = ()
    serial: str = ""
    f_number: float | None = None
    rays: Array | None = None
    pixels: Array | None = None
    drift_px: float = 0.0


@dataclass(frozen=True)
class BlockImage:
    """One image: `rotation` (3, 3) is frame_from_camera, `sigma_m` east, north, up or None.

    `frame` numbers the exposure; images of one exposure make one frame of the rig.
    """

    name: str
    camera: int
    frame: int
    centre_m: Array
    rotation: Array
    sigma_m: tuple[float, float, float] | None = None
    eo: ExteriorOrientation | None = None
    source: Path | None = None
    line: str = ""


@dataclass(frozen=True)
class BlockRig:
    """Effective places of cameras in the axes of the reference camera, common to all frames.

    `rotation` and `offset_m` by camera index: reference_from_camera (3, 3), centre (3,). The
    largest deviations of one frame from them are `change_px` in the image and `change_m`.
    """

    reference: int
    rotation: Mapping[int, Array]
    offset_m: Mapping[int, Array]
    change_px: float
    change_m: float


@dataclass(frozen=True)
class BlockPoints:
    """Object points (n, 3) with their image measurements; `image` and `point` are indices (m,)."""

    xyz_m: Array = field(default_factory=lambda: np.zeros((0, 3)))
    names: tuple[str, ...] = ()
    image: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    point: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    px: Array = field(default_factory=lambda: np.zeros((0, 2)))


@dataclass(frozen=True)
class Block:
    """Cameras, images and, where known, the frame, the coordinate system and the object points.

    `is_metric` is false where the file states that its coordinates have a scale of their own.
    """

    name: str
    cameras: tuple[BlockCamera, ...]
    images: tuple[BlockImage, ...]
    frame: LocalFrame | None = None
    georeference: Georeference | None = None
    points: BlockPoints = field(default_factory=BlockPoints)
    notes: tuple[str, ...] = ()
    is_metric: bool = True


def fitted(
    camera: BlockCamera, forms: Sequence[Form], *, limit_px: float = FIT_LIMIT_PX
) -> tuple[Form, ForwardDistortion, float]:
    """The first of several camera models that fits a calibration, and its largest residual, px.

    Raises:
        BlockError: none fits within `limit_px`.
    """
    if camera.rays is None or camera.pixels is None:
        if camera.model.is_pinhole:
            return "pinhole", camera.model, 0.0
        return forms[-1], camera.model, 0.0
    found = []
    for form in forms:
        model, worst_px = fit_distortion(form, camera.rays, camera.pixels, f_px=camera.model.fx_px)
        if worst_px <= limit_px:
            return form, model, worst_px
        found.append(f"{form} {worst_px:.3f} px")
    raise BlockError(
        f"camera {camera.name}: its calibration does not fit {', '.join(found)}; {limit_px:g} px "
        "is the limit. Export images in strict perspective (`export block --images perspective`), "
        "or measurements without distortion (`export project --to bingo`)"
    )


def rig_of(block: Block, reference: int) -> BlockRig:
    """The mean place of every camera against a reference camera, over all frames with both.

    Raises:
        BlockError: a camera shares no frame with the reference.
    """
    by_frame: dict[int, dict[int, BlockImage]] = {}
    for image in block.images:
        by_frame.setdefault(image.frame, {})[image.camera] = image
    rotation, offset = {reference: np.eye(3)}, {reference: np.zeros(3)}
    change_px = change_m = 0.0
    for camera in range(len(block.cameras)):
        if camera == reference:
            continue
        pairs = [
            (f[reference], f[camera]) for f in by_frame.values() if reference in f and camera in f
        ]
        if not pairs:
            raise BlockError(
                f"camera {block.cameras[camera].name} shares no exposure with "
                f"{block.cameras[reference].name}, so that no rig can be stated; use --rig no"
            )
        turns = np.array([a.rotation.T @ b.rotation for a, b in pairs])
        moves = np.array([a.rotation.T @ (b.centre_m - a.centre_m) for a, b in pairs])
        small = vectors_from_rotations(turns[0].T @ turns)
        mean = turns[0] @ rotations_from_vectors(small.mean(axis=0)[None])[0]
        rotation[camera], offset[camera] = mean, moves.mean(axis=0)
        rest_rad = np.linalg.norm(vectors_from_rotations(mean.T @ turns), axis=1).max()
        rest_m = np.linalg.norm(moves - offset[camera], axis=1).max()
        change_px = max(change_px, float(rest_rad) * block.cameras[camera].model.fx_px)
        change_m = max(change_m, float(rest_m))
    return BlockRig(reference, rotation, offset, change_px, change_m)


def with_rig(block: Block, rig: BlockRig) -> Block:
    """The block with every image where the rig has it, from the reference image of its frame.

    A frame without its reference image takes the rig's place from its first image.
    """
    placed: dict[int, tuple[Array, Array]] = {}
    for image in sorted(block.images, key=lambda image: image.camera != rig.reference):
        if image.frame not in placed:
            turn = image.rotation @ rig.rotation[image.camera].T
            placed[image.frame] = (image.centre_m - turn @ rig.offset_m[image.camera], turn)
    images = []
    for image in block.images:
        centre, turn = placed[image.frame]
        images.append(
            replace(
                image,
                centre_m=centre + turn @ rig.offset_m[image.camera],
                rotation=turn @ rig.rotation[image.camera],
            )
        )
    return replace(block, images=tuple(images))
