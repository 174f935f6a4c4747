"""The virtual camera between converging heads: its position, and the projection of heads into it.

A head's image is carried onto a horizontal plane of the ground and from there into the virtual
image; that is a projective transformation of its layer. Which heads are turned how is adjusted in
`processing.mosaic.free_mosaic`.

Source: docs/explanation/mathematics/virtual-camera.md#ground-plane; Heier et al. (2002), 6.1 and
fig. 8.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.geometry.conditions import Conditions
from processing.geometry.orientation import BODY_FROM_CAMERA
from processing.geometry.projective import rotation_homography
from processing.geometry.rotation import level_from_body, rotation_matrix
from processing.quality.figures.circumstances import ProjectionFigures
from processing.rig import Cone, Rig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GroundPlane:
    """The horizontal plane at the mean height of the terrain, as the virtual camera sees it.

    `height_m` is that of the projection centre above it, `up` (3,) the unit vector to the zenith
    in camera axes (x right, y forward, z up).
    """

    height_m: float
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)


def ground_plane(rig: Rig, conditions: Conditions) -> GroundPlane | None:
    """The plane an exposure is projected onto.

    Roll and pitch tilt the plane; unknown ones do not.

    Args:
        rig: the camera.
        conditions: `height_above_ground_m`, `roll_rad` and `pitch_rad` are used.

    Returns:
        The plane; None with a master cone (all cones see from one place) and where the height is
        not known (the projection centres then count as one).

    Source: docs/explanation/mathematics/virtual-camera.md#ground-plane.

    Example:
        Right wing down by 0.1 rad: the zenith leans to the left of the camera.

        >>> from processing.rig import find_rig
        >>> conditions = Conditions(height_above_ground_m=1000.0, roll_rad=0.1)
        >>> plane = ground_plane(find_rig("dmc"), conditions)
        >>> plane.height_m, [round(component, 4) + 0.0 for component in plane.up]
        (1000.0, [-0.0998, 0.0, 0.995])
    """
    height_m = conditions.height_above_ground_m
    if not rig.has_virtual_camera or height_m is None or height_m <= 0:
        return None
    roll, pitch = conditions.roll_rad or 0.0, conditions.pitch_rad or 0.0
    x, y, z = -BODY_FROM_CAMERA.T @ level_from_body(roll, pitch, 0.0)[2]
    return GroundPlane(height_m, (float(x), float(y), float(z)))


def offset_mm(rig: Rig, cone: Cone) -> Array:
    """From the virtual projection centre to a cone's, from construction.

    Heights are neglected: what a millimetre of them moves is far below what can be measured.

    Args:
        rig: the camera.
        cone: one of its cones.

    Returns:
        Shape (3,), mm, camera axes (x right, y forward, z up); z is zero.
    """
    x, y, _ = np.subtract(cone.position_mm, rig.image_position_mm)
    return np.array([y, x, 0.0])


def vip_from_layer(rig: Rig, cone: Cone, ground: GroundPlane | None) -> Array:
    """P: a cone's layer to the virtual image, by its mounting and the ground plane.

    A ray d from the offset c meets the plane u.x = -h where x ~ (I - c u' / (h + u.c)) d as the
    virtual camera sees it. Without a plane the rotation alone remains.

    Args:
        rig: the camera.
        cone: one of its cones.
        ground: the plane; None for the rotation alone.

    Returns:
        Homography, shape (3, 3), mm.

    Raises:
        ValueError: the rig has no virtual image.

    Source: docs/explanation/mathematics/virtual-camera.md#ground-plane.

    Example:
        The master cone is the virtual image.

        >>> from processing.rig import find_rig
        >>> rig = find_rig("ultracam-x")
        >>> np.allclose(vip_from_layer(rig, rig.cone(rig.master_cone), None), np.eye(3))
        True
    """
    if rig.virtual_image is None:
        raise ValueError(f"rig {rig.name} has no [virtual_image]; nothing can be placed in it")
    rotation = rotation_matrix(*cone.rotation_rad)
    if ground is not None:
        c, up = offset_mm(rig, cone) * 1e-3, np.array(ground.up)
        rotation = (np.eye(3) - np.outer(c, up) / (ground.height_m + float(up @ c))) @ rotation
    return rotation_homography(rotation, cone.lens.f_mm, rig.virtual_image.f_mm)


def projection_figures(
    rig: Rig, conditions: Conditions, relief_fraction: float
) -> ProjectionFigures | None:
    """The height a virtual camera projected onto, and what relief leaves, in figures.

    Args:
        rig: the camera.
        conditions: of the exposure.
        relief_fraction: height of the relief over the height above ground.

    Returns:
        Figures; None where no plane is used.
    """
    plane = ground_plane(rig, conditions)
    if plane is None:
        return None
    return ProjectionFigures(plane.height_m, head_parallax_px(rig, conditions, relief_fraction))


def head_parallax_px(rig: Rig, conditions: Conditions, relief_fraction: float) -> float | None:
    """What relief leaves between two PAN heads after projection onto the mean plane.

    Args:
        rig: the camera.
        conditions: of the exposure.
        relief_fraction: height of the relief over the height above ground, dh / h.

    Returns:
        base * f * dh / h^2 of the two heads that are farthest apart, PAN pixels; None where no
        plane is used.

    Source: docs/explanation/mathematics/virtual-camera.md#ground-plane.
    """
    image, plane = rig.virtual_image, ground_plane(rig, conditions)
    if image is None or plane is None:
        return None
    places = np.array([offset_mm(rig, cone) for cone in rig.pan_cones])
    base_mm = float(np.linalg.norm(places[:, None] - places[None], axis=2).max())
    return base_mm * image.f_mm * relief_fraction / (plane.height_m * 1e3) / image.pitch_mm
