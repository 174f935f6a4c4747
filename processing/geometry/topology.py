"""Properties of a rig's arrangement: overlaps, multiple corners, parameter counts.

Everything is derived from nominal placements at calibration temperature; no image is
used. Rectangles are in the virtual image plane, mm, y up.

Source: docs/explanation/mathematics/mosaicking.md#parameters-and-degrees-of-freedom; Ladstädter et
al. (2010), tables 1 and 2, fig. 2.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import (
    SensorPlacement,
    nominal_placements,
    raw_from_vip_mm,
    vip_mm_from_raw,
)
from processing.rig import Cone, Rig

Array = NDArray[np.float64]

_RIGS: Final = 8
"""Values that depend on the rig alone are computed once, not for every exposure."""

# A strip runs along at least half of a sensor's side; what is shorter both ways is a corner.
_STRIP_FRACTION = 0.5
# A side may be askew by this share of the sensor's smaller side and still count as upright.
_UPRIGHT_FRACTION = 0.01


@dataclass(frozen=True)
class Rectangle:
    """An upright rectangle in the virtual image plane, mm."""

    x_min_mm: float
    y_min_mm: float
    x_max_mm: float
    y_max_mm: float

    @property
    def width_mm(self) -> float:
        """Extent in x; zero or less where it is empty."""
        return self.x_max_mm - self.x_min_mm

    @property
    def height_mm(self) -> float:
        """Extent in y; zero or less where it is empty."""
        return self.y_max_mm - self.y_min_mm

    @property
    def empty(self) -> bool:
        """Whether it has no area."""
        return self.width_mm <= 0.0 or self.height_mm <= 0.0

    def contains(self, xy_mm: Array) -> NDArray[np.bool_]:
        """Which of the points lie inside or on the border.

        Args:
            xy_mm: VIP points, shape (n, 2), mm.

        Returns:
            Shape (n,).

        Example:
            >>> Rectangle(0.0, 0.0, 2.0, 1.0).contains(np.array([[1.0, 1.0], [1.0, 1.1]]))
            array([ True, False])
        """
        x, y = xy_mm[:, 0], xy_mm[:, 1]
        return np.asarray(
            (x >= self.x_min_mm)
            & (x <= self.x_max_mm)
            & (y >= self.y_min_mm)
            & (y <= self.y_max_mm)
        )


@dataclass(frozen=True)
class Overlap:
    """A strip of the virtual image plane seen by two PAN sensors of different cones."""

    sensor_a: str
    sensor_b: str
    rectangle: Rectangle


@dataclass(frozen=True)
class Corner:
    """A small area where several strips meet and `sensors` (three or more) see the same ground."""

    sensors: tuple[str, ...]
    rectangle: Rectangle


@dataclass(frozen=True)
class ConeCount:
    """Unknowns of one cone in the free mosaic (tables 1 and 2)."""

    cone: str
    sensors: int
    parameters: int
    constraints: int

    @property
    def degrees_of_freedom(self) -> int:
        """Independent unknowns of the cone."""
        return self.parameters - self.constraints


@dataclass(frozen=True)
class ParameterCounts:
    """Unknowns of the free mosaic of a rig, cone by cone."""

    cones: tuple[ConeCount, ...]
    common_constraints: int = 0
    """Of all converging heads together: their mean turn is zero."""

    @property
    def parameters(self) -> int:
        """Sum over the cones."""
        return sum(cone.parameters for cone in self.cones)

    @property
    def constraints(self) -> int:
        """Sum over the cones and of those common to all converging heads."""
        return sum(cone.constraints for cone in self.cones) + self.common_constraints

    @property
    def unknowns(self) -> int:
        """Independent unknowns: the rank of the normal matrix without constraints."""
        return self.parameters - self.constraints


def mosaic_cones(rig: Rig) -> tuple[Cone, ...]:
    """The cones a free mosaic adjusts: all PAN cones, then the colour master where there is one.

    Args:
        rig: the camera.

    Returns:
        Cones, PAN in file order.
    """
    cones = list(rig.pan_cones)
    if rig.colour_master_cone is not None:
        colour_master = rig.cone(rig.colour_master_cone)
        if colour_master not in cones:
            cones.append(colour_master)
    return tuple(cones)


def free_cones(rig: Rig) -> tuple[list[str], list[str]]:
    """Cones whose layer is a free projective transformation, and those whose mounting is free.

    Layers are carried into the master's; where there is no master, PAN heads are turned.

    Args:
        rig: the camera.

    Returns:
        Names of the cones with a free layer, and names of those with a free mounting.
    """
    cones = mosaic_cones(rig)
    mountings = [c.name for c in cones if rig.master_cone is None and c.role == "pan"]
    return [c.name for c in cones if c.name not in (rig.master_cone, *mountings)], mountings


def counts(rig: Rig) -> ParameterCounts:
    """Parameters and constraints per cone, by the rules of tables 1 and 2.

    A cone of two or more sensors has a similarity (4) for each, a cone other than the master a
    projective layer transformation (8), a converging head a rotation (3)
    instead; four constraints fix the datum (eq. 6) or separate sensor
    from layer transformations (eq. 6a, 7a, 7b).

    Args:
        rig: the camera.

    Returns:
        Counts of the cones of `mosaic_cones`, and of the common constraints.

    Source: docs/explanation/mathematics/mosaicking.md#parameters-and-degrees-of-freedom;
    Ladstädter et al. (2010), tables 1 and 2.

    Example:
        PAN cones of 4, 2, 2 and 1 sensors and a colour master: 8 similarities and 4 layers are
        8 * 4 + 4 * 8 parameters, the three cones of several sensors have 3 * 4 constraints.

        >>> from processing.rig import find_rig
        >>> found = counts(find_rig("ultracam-x"))
        >>> found.parameters, found.constraints, found.unknowns
        (64, 12, 52)
    """
    result = []
    layers, mountings = free_cones(rig)
    for cone in mosaic_cones(rig):
        several = len(cone.sensors) >= 2
        layer = 8 if cone.name in layers else 3 if cone.name in mountings else 0
        result.append(
            ConeCount(
                cone=cone.name,
                sensors=len(cone.sensors),
                parameters=(4 * len(cone.sensors) if several else 0) + layer,
                constraints=4 if several else 0,
            )
        )
    return ParameterCounts(tuple(result), 3 if mountings else 0)


def footprint(placement: SensorPlacement) -> Rectangle:
    """The upright rectangle inscribed in a sensor's image in the VIP, through its side midpoints.

    Exact to the few pixels by which a sensor's sides are askew.

    Args:
        placement: start or adjusted.

    Returns:
        The rectangle, mm in the VIP.
    """
    w, h = placement.sensor.width_px, placement.sensor.height_px
    middle_col, middle_row = (w - 1) / 2.0, (h - 1) / 2.0
    sides = np.array(
        [[-0.5, middle_row], [w - 0.5, middle_row], [middle_col, -0.5], [middle_col, h - 0.5]]
    )
    xy = vip_mm_from_raw(placement, sides)
    return Rectangle(
        x_min_mm=float(xy[0, 0]),
        x_max_mm=float(xy[1, 0]),
        y_max_mm=float(xy[2, 1]),
        y_min_mm=float(xy[3, 1]),
    )


def intersection(a: Rectangle, b: Rectangle) -> Rectangle:
    """What two rectangles have in common.

    Args:
        a: one rectangle, mm.
        b: the other, in the same plane.

    Returns:
        The common rectangle; `empty` where they do not meet.

    Example:
        >>> common = intersection(Rectangle(0.0, 0.0, 2.0, 2.0), Rectangle(1.0, -1.0, 3.0, 1.0))
        >>> common
        Rectangle(x_min_mm=1.0, y_min_mm=0.0, x_max_mm=2.0, y_max_mm=1.0)
        >>> intersection(common, Rectangle(5.0, 0.0, 6.0, 1.0)).empty
        True
    """
    return Rectangle(
        max(a.x_min_mm, b.x_min_mm),
        max(a.y_min_mm, b.y_min_mm),
        min(a.x_max_mm, b.x_max_mm),
        min(a.y_max_mm, b.y_max_mm),
    )


def common_view(a: SensorPlacement, b: SensorPlacement) -> Rectangle:
    """What two sensors both see.

    A sensor that is tilted against the virtual image sees no upright rectangle of it: then the box
    around what both see, corners of which one may miss.

    Args:
        a: placement of one sensor.
        b: placement of the other, in the same virtual image.

    Returns:
        The rectangle, mm in the VIP; may be `empty`.
    """
    if _is_upright(a) and _is_upright(b):
        return intersection(footprint(a), footprint(b))
    _, common = cv2.intersectConvexConvex(np.float32(outline(a)), np.float32(outline(b)))
    if common is None or len(common) < 3:
        return Rectangle(0.0, 0.0, 0.0, 0.0)
    low, high = common.reshape(-1, 2).min(axis=0), common.reshape(-1, 2).max(axis=0)
    return Rectangle(float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def outline(placement: SensorPlacement) -> Array:
    """The corners of a sensor in the VIP, around it from the upper left one.

    Args:
        placement: start or adjusted.

    Returns:
        Outer corners of the corner pixels, shape (4, 2), mm.
    """
    right, low = placement.sensor.width_px - 0.5, placement.sensor.height_px - 0.5
    corners = np.array([[-0.5, -0.5], [right, -0.5], [right, low], [-0.5, low]])
    return vip_mm_from_raw(placement, corners)


def _is_upright(placement: SensorPlacement) -> bool:
    corners = outline(placement)
    # Of opposite corners along a side, the coordinate across it.
    askew = max(
        abs(float(corners[i, k] - corners[j, k]))
        for i, j, k in ((0, 1, 1), (3, 2, 1), (0, 3, 0), (1, 2, 0))
    )
    return askew < _UPRIGHT_FRACTION * float(np.ptp(corners, axis=0).min())


def _contains_point(placement: SensorPlacement, xy_mm: Array) -> bool:
    """Whether a point (1, 2) of the VIP falls on a sensor."""
    sensor, (column, row) = placement.sensor, raw_from_vip_mm(placement, xy_mm)[0]
    return bool(0 <= column <= sensor.width_px - 1 and 0 <= row <= sensor.height_px - 1)


@lru_cache(maxsize=_RIGS)
def overlaps(rig: Rig) -> tuple[Overlap, ...]:
    """The overlap strips of PAN sensors of different cones (twelve for a 3x3 grid).

    Where sensors meet only at a corner there is no strip: see `corners`.

    Args:
        rig: the camera; it has a virtual image.

    Returns:
        Strips at calibration temperature, in the order of the sensors.

    Example:
        >>> from processing.rig import find_rig
        >>> len(overlaps(find_rig("ultracam-x-mini")))
        12
    """
    placements, places = nominal_placements(rig, {}, {}), _pan_footprints(rig)
    result = []
    for a, b in itertools.combinations(places, 2):
        if rig.cone_of(a).name == rig.cone_of(b).name:
            continue
        common = common_view(placements[a], placements[b])
        if not common.empty and _is_strip(common, places[a], places[b]):
            result.append(Overlap(a, b, common))
    return tuple(result)


@lru_cache(maxsize=_RIGS)
def corners(rig: Rig) -> tuple[Corner, ...]:
    """Areas where strips cross, with every PAN sensor that sees them (four for a 3x3 grid).

    Args:
        rig: the camera; it has a virtual image.

    Returns:
        Areas seen by three or more sensors.

    Example:
        >>> from processing.rig import find_rig
        >>> [len(corner.sensors) for corner in corners(find_rig("ultracam-x-mini"))]
        [4, 4, 4, 4]
    """
    places = _pan_footprints(rig)
    placements = nominal_placements(rig, {}, {})
    found: dict[tuple[str, ...], Rectangle] = {}
    for a, b in itertools.combinations(overlaps(rig), 2):
        common = intersection(a.rectangle, b.rectangle)
        if common.empty:
            continue
        centre = np.array(
            [
                [
                    (common.x_min_mm + common.x_max_mm) / 2.0,
                    (common.y_min_mm + common.y_max_mm) / 2.0,
                ]
            ]
        )
        sensors = tuple(name for name in places if _contains_point(placements[name], centre))
        if len(sensors) >= 3 and sensors not in found:
            for name in sensors:
                common = intersection(common, places[name])
            found[sensors] = common
    return tuple(Corner(sensors, rectangle) for sensors, rectangle in found.items())


@lru_cache(maxsize=_RIGS)
def colour_coverage(rig: Rig) -> Mapping[str, Rectangle]:
    """What of each PAN sensor the colour master sees.

    Args:
        rig: the camera; of a colour master with several sensors the first is meant.

    Returns:
        Common rectangles by PAN sensor name, without those that are empty; no keys where the rig
        has no colour master.
    """
    if rig.colour_master_cone is None:
        return {}
    colour_cone = rig.cone(rig.colour_master_cone)
    if colour_cone.role != "colour":
        return {}
    placements = nominal_placements(rig, {}, {})
    colour = placements[colour_cone.sensors[0].name]
    result = {}
    for name in _pan_footprints(rig):
        common = common_view(placements[name], colour)
        if not common.empty:
            result[name] = common
    return result


def colour_ratio(rig: Rig) -> int | None:
    """PAN pixels per colour-master pixel where that is a whole number, to one percent.

    Args:
        rig: the camera.

    Returns:
        The ratio. None where there is no colour master and where the ratio is not whole (DMC, 4.8):
        the frames cannot be compared by box means of raw pixels.

    Example:
        >>> from processing.rig import find_rig
        >>> colour_ratio(find_rig("ultracam-x")), colour_ratio(find_rig("dmc"))
        (3, None)
    """
    exact = exact_colour_ratio(rig)
    rounded = round(exact or 0.0)
    return rounded if exact and rounded >= 1 and abs(exact / rounded - 1.0) < 0.01 else None


def exact_colour_ratio(rig: Rig) -> float | None:
    """PAN pixels per colour-master pixel, from principal distances and pitches.

    Args:
        rig: the camera.

    Returns:
        The ratio; None without a colour master or PAN cones.
    """
    if rig.colour_master_cone is None or not rig.pan_cones:
        return None
    pan, colour = rig.pan_cones[0], rig.cone(rig.colour_master_cone)
    return (pan.lens.f_mm / pan.sensors[0].pitch_um) / (
        colour.lens.f_mm / colour.sensors[0].pitch_um
    )


def _pan_footprints(rig: Rig) -> dict[str, Rectangle]:
    placements = nominal_placements(rig, {}, {})
    return {
        sensor.name: footprint(placements[sensor.name])
        for cone in rig.pan_cones
        for sensor in cone.sensors
    }


def _is_strip(common: Rectangle, a: Rectangle, b: Rectangle) -> bool:
    return common.width_mm > _STRIP_FRACTION * min(
        a.width_mm, b.width_mm
    ) or common.height_mm > _STRIP_FRACTION * min(a.height_mm, b.height_mm)
