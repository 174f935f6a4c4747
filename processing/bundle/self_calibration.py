"""Sets of additional parameters for stitched images, composed from a rig's arrangement.

Four sets, each including the one before it. For nine CCDs in four cones they have 0, 2, 23 and 61
parameters, as the vendor's sets for these cameras. The vendor's last two sets are not published;
these are defined here:

- `none`;
- `radial`: K1 and K2 of Heier et al. (2002), eq. 5.1;
- `sensors`: with them P1 and P2 (lens elements off the axis), dx0, dy0 and df (interior
  orientation; only where GNSS positions and two flying heights separate it from the orientation of
  the images), and two shifts of every CCD: 7 + 2 (n - 1);
- `sensors-full`: with them rotation, scale, affinity and shear of every CCD and two perspective
  terms of every cone but the master: 7 + 6 (n - 1) + 2 (c - 1).

What all CCDs have in common cannot be separated from the orientation and the lens. Of each kind,
the sum over the CCDs of the master cone is zero, as in the datum of the mosaic. This removes one
parameter of each kind.

Two sets of polynomials belong to images of one frame camera: `ebner` (12) and `gruen` (44), on a
square grid of `base_mm` about the principal point.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final, Literal

from processing.bundle.network import CameraModel
from processing.bundle.polynomial_sets import EBNER, GRUEN
from processing.bundle.terms import Kind, Part, Term
from processing.geometry.placement import nominal_placements
from processing.geometry.topology import footprint
from processing.rig import Rig

SetName = Literal["none", "radial", "sensors", "sensors-full", "ebner", "gruen"]
SETS: Final[tuple[SetName, ...]] = ("none", "radial", "sensors", "sensors-full")

_RADIAL: Final = frozenset({"k1", "k2"})
_DECENTRING: Final = frozenset({"p1", "p2"})
INTERIOR_THREE: Final = frozenset({"dx0", "dy0", "df"})
_OF_SENSOR: Final[tuple[Kind, ...]] = ("shift-x", "shift-y")
_OF_SENSOR_FULL: Final[tuple[Kind, ...]] = (
    "shift-x",
    "shift-y",
    "rotation",
    "scale",
    "affinity",
    "shear",
)
_OF_CONE: Final[tuple[Kind, ...]] = ("perspective-x", "perspective-y")


def parts_of(rig: Rig) -> tuple[Part, ...]:
    """The part of the stitched image that each PAN CCD covers, from calibrated positions.

    Args:
        rig: the camera.

    Returns:
        One rectangle per PAN sensor, in file order, mm.

    Raises:
        ValueError: a rig without a stitched image.
    """
    if rig.virtual_image is None:
        raise ValueError(f"rig {rig.name} has no stitched image; calibrate its heads one by one")
    placements = nominal_placements(rig, {}, {})
    found = []
    for cone in rig.pan_cones:
        for sensor in cone.sensors:
            r = footprint(placements[sensor.name])
            found.append(
                Part(sensor.name, cone.name, r.x_min_mm, r.y_min_mm, r.x_max_mm, r.y_max_mm)
            )
    return tuple(found)


def with_self_calibration(
    camera: CameraModel,
    name: SetName,
    parts: tuple[Part, ...] = (),
    *,
    master_cone: str | None = "",
    interior: bool = False,
    base_mm: float | None = None,
) -> CameraModel:
    """The camera with a set of additional parameters to be estimated.

    Args:
        camera: whose interior orientation they improve.
        name: the set.
        parts: the CCDs of its image; needed for `sensors` and `sensors-full`.
        master_cone: whose CCDs carry the datum.
        interior: whether dx0, dy0 and df can be separated from the images' orientation.
        base_mm: half the side of the grid of `ebner` and `gruen`; usually the base of a stereo pair
            in the image.

    Returns:
        The camera with `free`, `terms` and `gauges` of the set; `none` leaves it as it is.

    Raises:
        ValueError: a set of CCDs for an image that is not made of several, or polynomials without
            a positive base.

    Source: docs/explanation/mathematics/bundle.md#additional-parameters.

    Example:
        Nine CCDs in four cones: 7 + 2 (9 - 1) and 7 + 6 (9 - 1) + 2 (4 - 1) parameters.

        >>> from processing.rig import find_rig
        >>> parts = parts_of(find_rig("ultracam-x"))
        >>> camera = CameraModel("image", f_mm=100.5)
        >>> [
        ...     parameter_count(
        ...         with_self_calibration(camera, name, parts, master_cone="0", interior=True)
        ...     )
        ...     for name in SETS
        ... ]
        [0, 2, 23, 61]
    """
    free = set(camera.free)
    if name == "none":
        return camera
    if name in ("ebner", "gruen"):
        if base_mm is None or base_mm <= 0.0:
            raise ValueError(
                f"set {name} needs base_mm above 0; camera {camera.name} has {base_mm}"
            )
        square = (Part("image", "", -base_mm, -base_mm, base_mm, base_mm),)
        kinds = EBNER if name == "ebner" else GRUEN
        terms_of = tuple(Term(kind, kind, ("image",), square) for kind in kinds)
        return replace(camera, terms=terms_of)
    free |= _RADIAL
    if name == "radial":
        return replace(camera, free=frozenset(free))
    masters = [p.sensor for p in parts if p.cone == master_cone]
    if not masters:
        raise ValueError(
            f"set {name} needs the CCDs of the image and its master cone; camera {camera.name} has "
            f"{len(parts)} CCDs, none in cone {master_cone!r}"
        )
    free |= _DECENTRING
    if interior:
        free |= INTERIOR_THREE
    terms: list[Term] = []
    gauges: list[tuple[str, ...]] = []
    for kind in _OF_SENSOR if name == "sensors" else _OF_SENSOR_FULL:
        terms += [
            Term(f"{kind} {part.sensor}", kind, (part.sensor,), parts)
            for part in parts
            if masters != [part.sensor]
        ]
        if len(masters) > 1:
            gauges.append(tuple(f"{kind} {sensor}" for sensor in masters))
    if name == "sensors-full":
        for cone in dict.fromkeys(p.cone for p in parts if p.cone != master_cone):
            sensors = tuple(p.sensor for p in parts if p.cone == cone)
            terms += [Term(f"{kind} cone {cone}", kind, sensors, parts) for kind in _OF_CONE]
    return replace(camera, free=frozenset(free), terms=tuple(terms), gauges=tuple(gauges))


def parameter_count(camera: CameraModel) -> int:
    """Independent parameters of a camera.

    Args:
        camera: `free`, `terms` and `gauges` are counted.

    Returns:
        What is estimated less its gauges.
    """
    return len(camera.free) + len(camera.terms) - len(camera.gauges)
