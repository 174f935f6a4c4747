"""A virtual image for heads that overlap and have none: its camera, its size, what it covers.

The virtual camera looks along the mean of the heads' axes. Its image is the largest rectangle about
that axis that the heads cover together.

Source: docs/explanation/mathematics/virtual-camera.md#proposed-image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from processing import ProcessingError
from processing.geometry.lens import ideal_from_measured
from processing.geometry.rotation import (
    level_from_body,
    omega_phi_kappa,
    roll_pitch_heading,
    rotation_matrix,
    vectors_from_rotations,
)
from processing.rig import Cone, Rig, VirtualImage

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_OVERLAP_PX: Final = 48.0
"""Narrower strips hold no tie points."""
GOOD_OVERLAP_PX: Final = 128.0
OBLIQUE_RAD: Final = math.radians(35.0)
SAME_FIELD: Final = 0.9
_CELLS: Final = 1400
_MULTIPLE_PX: Final = 4
_BORDER_POINTS: Final = 60
BODY_FROM_CAMERA: Final = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


class ProposalError(ProcessingError, ValueError):
    """Heads that make no common image; the message states why and what would be right."""


@dataclass(frozen=True)
class HeadOverlap:
    """What two heads see together, in pixels of the image; `share` is of the smaller field."""

    heads: tuple[str, str]
    width_px: float
    length_px: float
    share: float


@dataclass(frozen=True)
class ImageProposal:
    """A rig with a virtual image, and how it was found.

    `rig` has no master cone; its rotations and places refer to the virtual camera. `turned` is
    former master from virtual camera, (3, 3). `covered` is the share of what the heads see that the
    image holds. `masks` are the fields of the heads on a grid of `cell_px`, its middle the axis.
    """

    rig: Rig
    image: VirtualImage
    overlaps: tuple[HeadOverlap, ...]
    turned: Array
    covered: float
    masks: dict[str, Mask]
    cell_px: float

    @property
    def warnings(self) -> tuple[str, ...]:
        """Overlaps that are narrow."""
        return tuple(
            f"{' and '.join(o.heads)} overlap by {o.width_px:.0f} px; {GOOD_OVERLAP_PX:.0f} px and "
            "more give tie points over any ground"
            for o in self.overlaps
            if MIN_OVERLAP_PX <= o.width_px < GOOD_OVERLAP_PX
        )


def propose_image(rig: Rig) -> ImageProposal:
    """Propose a virtual image from the geometry of a rig.

    Args:
        rig: PAN heads of one sensor each, synchronous, without a virtual image.

    Returns:
        The rig with it.

    Raises:
        ProposalError: heads that do not overlap, oblique heads, or a rig that is not stitched.

    Source: docs/explanation/mathematics/virtual-camera.md#proposed-image.
    """
    _refuse(rig)
    axes = {cone.name: rotation_matrix(*cone.rotation_rad) for cone in rig.cones}
    first = rig.master_cone or rig.cones[0].name
    turned = _virtual_axes(list(axes.values()), axes[first])
    for name, rotation in axes.items():
        angle = math.acos(min(1.0, float(rotation[:, 2] @ turned[:, 2])))
        if angle > OBLIQUE_RAD:
            raise ProposalError(
                f"{name} looks {math.degrees(angle):.0f} degrees away from the middle of all "
                "heads: "
                f"oblique heads ({math.degrees(OBLIQUE_RAD):.0f} degrees and more) are images of "
                "their own and make no common one"
            )
    f_mm = float(np.mean([cone.lens.f_mm for cone in rig.cones]))
    pitch_um = max(cone.sensors[0].pitch_um for cone in rig.cones)
    places = {
        cone.name: border_mm(cone, turned.T @ axes[cone.name], f_mm) / (pitch_um * 1e-3)
        for cone in rig.cones
    }
    masks, cell_px = _masks(places)
    overlaps = tuple(_overlap(masks, cell_px, pair) for pair in combinations(masks, 2))
    _refuse_apart(rig, overlaps)
    width, height, covered = _largest_rectangle(masks, cell_px)
    if min(width, height) < 2 * GOOD_OVERLAP_PX:
        raise ProposalError(
            f"the heads cover no rectangle about their common axis (the largest has {width} x "
            f"{height} px); turn them so that their images are side by side"
        )
    image = VirtualImage(width, height, pitch_um, round(f_mm, 6))
    body = BODY_FROM_CAMERA @ turned @ BODY_FROM_CAMERA.T
    cones = []
    for cone in rig.cones:
        omega, phi, kappa = (float(v) for v in omega_phi_kappa(turned.T @ axes[cone.name]))
        x, y, z = (float(v) for v in body.T @ np.array(cone.position_mm))
        cones.append(replace(cone, rotation_rad=(omega, phi, kappa), position_mm=(x, y, z)))
    new = replace(rig, virtual_image=image, master_cone=None, cones=tuple(cones))
    kept = tuple(o for o in overlaps if o.width_px >= MIN_OVERLAP_PX)
    return ImageProposal(new, image, kept, turned, covered, masks, cell_px)


def boresight_deg(former_deg: tuple[float, float, float], turned: Array) -> Array:
    """Roll, pitch and heading of the boresight that keep the heads where they are.

    Args:
        former_deg: of the former master's body axes against the inertial unit.
        turned: former master from virtual camera, shape (3, 3).

    Returns:
        Of the virtual camera's body axes, shape (3,), degrees.
    """
    roll, pitch, heading = np.radians(former_deg)
    former = level_from_body(float(roll), float(pitch), float(heading))
    body = BODY_FROM_CAMERA @ turned @ BODY_FROM_CAMERA.T
    return np.asarray(np.degrees(roll_pitch_heading(former @ body)))


def border_mm(cone: Cone, rotation: Array, f_mm: float) -> Array:
    """The border of a head's image in the image plane of the virtual camera.

    Args:
        cone: with one sensor.
        rotation: virtual camera from head, shape (3, 3).
        f_mm: principal distance of the virtual camera.

    Returns:
        Points around the image, shape (n, 2), mm.
    """
    sensor = cone.sensors[0]
    w, h = float(sensor.width_px - 1), float(sensor.height_px - 1)
    t = np.linspace(0.0, 1.0, _BORDER_POINTS, endpoint=False)
    o = np.zeros_like(t)
    around = np.concatenate(
        [
            np.stack([t * w, o], axis=1),
            np.stack([o + w, t * h], axis=1),
            np.stack([w - t * w, o + h], axis=1),
            np.stack([o, h - t * h], axis=1),
        ]
    )
    u = (around[:, 0] - w / 2.0) * sensor.pitch_mm
    v = (h / 2.0 - around[:, 1]) * sensor.pitch_mm
    c, s = math.cos(sensor.rotation_rad), math.sin(sensor.rotation_rad)
    layer = sensor.scale * np.stack([c * u - s * v, s * u + c * v], axis=1)
    ideal = ideal_from_measured(cone.lens, layer + np.array([sensor.x_mm, sensor.y_mm]))
    ray = np.column_stack([ideal, np.full(len(ideal), -cone.lens.f_mm)]) @ rotation.T
    return np.asarray(-f_mm * ray[:, :2] / ray[:, 2:])


def _refuse(rig: Rig) -> None:
    if rig.virtual_image is not None:
        raise ProposalError(f"{rig.name} has a [virtual_image]; remove it to have another proposed")
    colour = [cone.name for cone in rig.cones if cone.role != "pan"]
    if colour:
        raise ProposalError(
            f"{', '.join(colour)} of {rig.name} are colour heads; an image is proposed for PAN "
            "heads "
            "only. Heads of colour are images of their own"
        )
    if len(rig.cones) < 2:
        raise ProposalError(f"{rig.name} has one head; its image is that of the head")
    if any(len(cone.sensors) > 1 for cone in rig.cones):
        raise ProposalError(
            f"{rig.name} has cones of several sensors; write [virtual_image] by hand"
        )
    if rig.timing != "synchronous":
        raise ProposalError(
            f"{rig.name} is {rig.timing}; heads make a common image with a virtual camera where "
            "they are synchronous"
        )
    left = [s.name for s in rig.sensors if s.justified == "left"]
    if left:
        raise ProposalError(
            f"{', '.join(left)} have left-justified words; stitching takes right-justified ones: "
            "change the pixel format"
        )


def _virtual_axes(rotations: list[Array], first: Array) -> Array:
    """Axes of the virtual camera, (3, 3): along the mean axis, upright as the first head."""
    z = np.mean([rotation[:, 2] for rotation in rotations], axis=0)
    z /= np.linalg.norm(z)
    y = first[:, 1] - z * float(z @ first[:, 1])
    y /= np.linalg.norm(y)
    found = np.stack([np.cross(y, z), y, z], axis=1)
    small = float(np.linalg.norm(vectors_from_rotations(found)))
    return np.eye(3) if small < 1e-9 else found


def _masks(places: dict[str, Array]) -> tuple[dict[str, Mask], float]:
    """Fields on a grid whose middle is the axis, and the size of its cells in pixels."""
    reach = max(float(np.abs(p).max()) for p in places.values()) * 1.02
    cell = max(1.0, 2.0 * reach / _CELLS)
    side = 2 * math.ceil(reach / cell) + 1
    masks = {}
    for name, place in places.items():
        drawn = np.zeros((side, side), np.uint8)
        corners = np.stack([place[:, 0], -place[:, 1]], axis=1) / cell + (side - 1) / 2
        cv2.fillPoly(drawn, [np.round(corners * 16).astype(np.int32)], 1, shift=4)
        masks[name] = drawn > 0
    return masks, cell


def _overlap(masks: dict[str, Mask], cell_px: float, pair: tuple[str, str]) -> HeadOverlap:
    a, b = (masks[name] for name in pair)
    both = a & b
    cells = int(both.sum())
    if not cells:
        return HeadOverlap(pair, 0.0, 0.0, 0.0)
    row, column = np.nonzero(both)
    length = max(int(np.ptp(row)), int(np.ptp(column))) + 1
    share = cells / min(int(a.sum()), int(b.sum()))
    return HeadOverlap(pair, cells / length * cell_px, length * cell_px, share)


def _refuse_apart(rig: Rig, overlaps: tuple[HeadOverlap, ...]) -> None:
    same = [o for o in overlaps if o.share > SAME_FIELD]
    if same:
        raise ProposalError(
            f"{' and '.join(same[0].heads)} see the same field ({same[0].share:.0%}): a common "
            "image "
            "would be no larger. They are images of their own, or bands to be registered"
        )
    reached = {rig.cones[0].name}
    for _ in rig.cones:
        for o in overlaps:
            if o.width_px >= MIN_OVERLAP_PX and reached & set(o.heads):
                reached |= set(o.heads)
    apart = [cone.name for cone in rig.cones if cone.name not in reached]
    if apart:
        widest = max((o for o in overlaps if set(o.heads) & set(apart)), key=lambda o: o.width_px)
        raise ProposalError(
            f"{', '.join(apart)} and {', '.join(sorted(reached))} overlap by "
            f"{widest.width_px:.0f} px "
            f"at most; {MIN_OVERLAP_PX:.0f} px at least are needed, {GOOD_OVERLAP_PX:.0f} px are "
            "good. "
            "They are images of their own: turn the heads towards each other for a common one"
        )


def _largest_rectangle(masks: dict[str, Mask], cell_px: float) -> tuple[int, int, float]:
    """Width and height, px, of the largest covered rectangle about the middle; its share."""
    union = np.any(list(masks.values()), axis=0)
    middle = union.shape[0] // 2
    up = np.cumprod(union[middle::-1], axis=0).sum(axis=0)
    down = np.cumprod(union[middle:], axis=0).sum(axis=0)
    reach = np.minimum(up, down)
    sides = np.minimum(reach[middle:], reach[middle::-1])
    height = np.minimum.accumulate(sides)
    # One cell from the border on every side: borders are rounded.
    half_width, half_height = np.arange(len(height)) - 1.0, height - 2.0
    area = np.where((half_width > 0) & (half_height > 0), half_width * half_height, 0.0)
    best = int(np.argmax(area))
    size = [
        int(2.0 * float(half) * cell_px) // _MULTIPLE_PX * _MULTIPLE_PX
        for half in (half_width[best], half_height[best])
    ]
    share = size[0] * size[1] / (float(union.sum()) * cell_px**2)
    return max(size[0], 0), max(size[1], 0), share
