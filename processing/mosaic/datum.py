"""What fixes the datum of a mosaic: inner constraints between its unknowns.

The adjustment they go into is in `processing.mosaic.free_mosaic`.

Source: docs/explanation/mathematics/mosaicking.md#datum-by-inner-constraints; Ladstädter et al.
(2010), eq. 6 and 7; Heier et al. (2002), 6.1.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from processing.geometry.placement import SensorPlacement
from processing.mosaic.model import ROTATION_NAMES
from processing.rig import Rig, Sensor

_SIMILARITY = ("x", "y", "rotation", "scale")


@dataclass(frozen=True)
class DatumConstraint:
    """sum(coefficient * unknown) = 0 over named unknowns."""

    coefficients: Mapping[str, float]


def datum_candidates(rig: Rig) -> tuple[Sensor, ...]:
    """The sensors a datum may rest on.

    Args:
        rig: the camera.

    Returns:
        The master's sensors, or those of all PAN heads where there is no master.
    """
    if rig.master_cone is not None:
        return rig.master_sensors
    return tuple(sensor for cone in rig.pan_cones for sensor in cone.sensors)


def mounting_constraints(cones: Collection[str]) -> list[DatumConstraint]:
    """The mean turn of the heads against their construction is zero, about each axis.

    Args:
        cones: heads with free mountings.

    Returns:
        Three constraints; none without heads.
    """
    if not cones:
        return []
    return [DatumConstraint({f"{cone}.{axis}": 1.0 for cone in cones}) for axis in ROTATION_NAMES]


def datum_constraints(
    start: Mapping[str, SensorPlacement], sensors: Sequence[str]
) -> list[DatumConstraint]:
    """Eq. 6a, 6b, 6c over the given sensors of the master cone.

    One sensor alone gives neither scale nor rotation by its place: its own are held instead. The
    lever arms count from the sensors' mean, which with eq. 6a comes to the same.

    Args:
        start: placements by calibration + TDM, by sensor name.
        sensors: the sensors the datum rests on.

    Returns:
        Four constraints; none without sensors.
    """
    if not sensors:
        return []
    if len(sensors) == 1:
        return [DatumConstraint({f"{sensors[0]}.{what}": 1.0}) for what in _SIMILARITY]
    x = np.array([start[name].similarity.x_mm for name in sensors])
    y = np.array([start[name].similarity.y_mm for name in sensors])
    x, y = x - x.mean(), y - y.mean()
    shift_x = {f"{name}.x": 1.0 for name in sensors}
    shift_y = {f"{name}.y": 1.0 for name in sensors}
    scale: dict[str, float] = {}
    rotation: dict[str, float] = {}
    for name, xc, yc in zip(sensors, x, y, strict=True):
        scale |= {f"{name}.x": float(xc), f"{name}.y": float(yc)}
        rotation |= {f"{name}.x": float(-yc), f"{name}.y": float(xc)}
    return [DatumConstraint(c) for c in (shift_x, shift_y, scale, rotation)]


def layer_constraints(sensors: Sequence[str]) -> list[DatumConstraint]:
    """Eq. 6a, 7a, 7b over the sensors of one other cone: they separate S from P.

    Args:
        sensors: all of the cone that are adjusted.

    Returns:
        Four constraints.
    """
    return [DatumConstraint({f"{name}.{what}": 1.0 for name in sensors}) for what in _SIMILARITY]
