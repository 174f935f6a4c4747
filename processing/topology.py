"""What follows from a rig's arrangement alone: overlaps, multiple corners, parameter counts.

Everything is derived from nominal placements at calibration temperature; nothing here looks at an
image. Rectangles are in the virtual image plane, mm, y up.

Source: seeds/ultracam-calibration.txt, tables 1 and 2, fig. 2.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.placement import SensorPlacement, nominal_placements, vip_mm_from_raw
from processing.rig import Cone, Rig

Array = NDArray[np.float64]

# A strip runs along at least half of a sensor's side; what is shorter both ways is a corner.
_STRIP_FRACTION = 0.5


@dataclass(frozen=True)
class Rectangle:
    """An upright rectangle in the virtual image plane, mm."""

    x_min_mm: float
    y_min_mm: float
    x_max_mm: float
    y_max_mm: float

    @property
    def width_mm(self) -> float:
        return self.x_max_mm - self.x_min_mm

    @property
    def height_mm(self) -> float:
        return self.y_max_mm - self.y_min_mm

    @property
    def empty(self) -> bool:
        return self.width_mm <= 0.0 or self.height_mm <= 0.0

    def contains(self, xy_mm: Array) -> NDArray[np.bool_]:
        """Which of the points (n, 2) lie inside."""
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
        return self.parameters - self.constraints


@dataclass(frozen=True)
class ParameterCounts:
    """Unknowns of the free mosaic of a rig, cone by cone."""

    cones: tuple[ConeCount, ...]

    @property
    def parameters(self) -> int:
        return sum(cone.parameters for cone in self.cones)

    @property
    def constraints(self) -> int:
        return sum(cone.constraints for cone in self.cones)

    @property
    def unknowns(self) -> int:
        """Independent unknowns: the rank of the normal matrix without constraints."""
        return self.parameters - self.constraints


def mosaic_cones(rig: Rig) -> tuple[Cone, ...]:
    """The cones a free mosaic adjusts: all PAN cones, then the colour master where there is one."""
    cones = list(rig.pan_cones)
    if rig.colour_master_cone is not None:
        colour_master = rig.cone(rig.colour_master_cone)
        if colour_master not in cones:
            cones.append(colour_master)
    return tuple(cones)


def counts(rig: Rig) -> ParameterCounts:
    """Parameters and constraints per cone, by the rules of tables 1 and 2.

    A cone of two or more sensors has a similarity (4) for each, a cone other than the master a
    projective layer transformation (8); four constraints fix the datum (eq. 6) or separate sensor
    from layer transformations (eq. 6a, 7a, 7b).
    """
    result = []
    for cone in mosaic_cones(rig):
        several = len(cone.sensors) >= 2
        layer = 0 if cone.name == rig.master_cone else 8
        result.append(
            ConeCount(
                cone=cone.name,
                sensors=len(cone.sensors),
                parameters=(4 * len(cone.sensors) if several else 0) + layer,
                constraints=4 if several else 0,
            )
        )
    return ParameterCounts(tuple(result))


def footprint(placement: SensorPlacement) -> Rectangle:
    """The upright rectangle inscribed in a sensor's image in the VIP, through its side midpoints.

    Exact to the few pixels by which a sensor's sides are askew.
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
    """What two rectangles have in common; may be `empty`."""
    return Rectangle(
        max(a.x_min_mm, b.x_min_mm),
        max(a.y_min_mm, b.y_min_mm),
        min(a.x_max_mm, b.x_max_mm),
        min(a.y_max_mm, b.y_max_mm),
    )


def overlaps(rig: Rig) -> tuple[Overlap, ...]:
    """The overlap strips of PAN sensors of different cones (twelve for a 3x3 grid).

    Where sensors meet only at a corner there is no strip: see `corners`.
    """
    places = _pan_footprints(rig)
    result = []
    for a, b in itertools.combinations(places, 2):
        if rig.cone_of(a).name == rig.cone_of(b).name:
            continue
        common = intersection(places[a], places[b])
        if not common.empty and _is_strip(common, places[a], places[b]):
            result.append(Overlap(a, b, common))
    return tuple(result)


def corners(rig: Rig) -> tuple[Corner, ...]:
    """Areas where strips cross, with every PAN sensor that sees them (four for a 3x3 grid)."""
    places = _pan_footprints(rig)
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
        sensors = tuple(name for name, place in places.items() if place.contains(centre)[0])
        if len(sensors) >= 3 and sensors not in found:
            for name in sensors:
                common = intersection(common, places[name])
            found[sensors] = common
    return tuple(Corner(sensors, rectangle) for sensors, rectangle in found.items())


def colour_coverage(rig: Rig) -> Mapping[str, Rectangle]:
    """What of each PAN sensor the colour master sees, by PAN sensor name.

    Empty where the rig has no colour master; of a colour master with several sensors the first
    is meant.
    """
    if rig.colour_master_cone is None:
        return {}
    colour_cone = rig.cone(rig.colour_master_cone)
    if colour_cone.role != "colour":
        return {}
    placements = nominal_placements(rig, {}, {})
    colour = footprint(placements[colour_cone.sensors[0].name])
    result = {}
    for name, place in _pan_footprints(rig).items():
        common = intersection(place, colour)
        if not common.empty:
            result[name] = common
    return result


def colour_ratio(rig: Rig) -> int | None:
    """PAN pixels per colour-master pixel, from principal distances and pitches.

    None where there is no colour master or where the ratio is not whole to one percent: such a rig
    (DMC, 4.8) cannot be matched by box means.
    """
    if rig.colour_master_cone is None or not rig.pan_cones:
        return None
    pan, colour = rig.pan_cones[0], rig.cone(rig.colour_master_cone)
    exact = (pan.lens.f_mm / pan.sensors[0].pitch_um) / (
        colour.lens.f_mm / colour.sensors[0].pitch_um
    )
    whole = round(exact)
    return whole if whole >= 1 and abs(exact / whole - 1.0) < 0.01 else None


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
