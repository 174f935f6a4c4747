"""Position and attitude of every head, from the exposure's own record: known in flight.

In local east, north, up of each projection centre, so that no coordinate system is needed; with a
whole trajectory and in a customer's system it is the work of
`daemon.orientation.orientation_inputs`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from daemon.configuration.model import MountSection
from daemon.mission.exposure import Exposure, NavigationRecord
from daemon.orientation.exterior_orientation import (
    ExteriorOrientation,
    MissingOrientation,
    NavigationSource,
    orient,
)
from daemon.orientation.footprints import footprint
from daemon.orientation.geodesy import metres_per_degree
from daemon.orientation.georeference import ProjectedPoint
from processing.rig import Rig

FORMAT: Final = 1
MAX_EXTRAPOLATION_NS: Final = 100_000_000
"""From the mark to a head's own instant a position is carried on by velocity no farther."""

ANGLES: Final = (
    "R = Rx(omega) Ry(phi) Rz(kappa), from the camera (x right, y forward, z up) to local east, "
    "north, up; kappa counts from true north"
)
PLACES: Final = "WGS 84, height above the ellipsoid (EPSG:4979)"


def orientation_json(
    exposure: Exposure, rig: Rig, mount: MountSection, ground_m: float
) -> Mapping[str, Any]:
    """Content of `orientation.json`: every cone at its own mid-exposure, its footprint on a plane.

    Args:
        ground_m: height of level ground above the ellipsoid.
    """
    heads, unoriented = [], []
    for one in recorded_orientations(exposure, rig, mount):
        if isinstance(one, MissingOrientation):
            unoriented.append({"cone": one.cone, "why": one.reason})
        else:
            heads.append(_head(one, rig, ground_m))
    return {
        "format": FORMAT,
        "exposure": exposure.number,
        "simulated": exposure.simulated,
        **({} if rig.is_calibrated else {"uncalibrated": True}),
        "places": PLACES,
        "angles": ANGLES,
        "antenna_m": list(mount.antenna_m),
        "boresight_deg": list(mount.boresight_deg),
        "ground_height_m": ground_m,
        "heads": heads,
        "unoriented": unoriented,
    }


def recorded_orientations(
    exposure: Exposure, rig: Rig, mount: MountSection, trajectory: NavigationSource | None = None
) -> Iterator[ExteriorOrientation | MissingOrientation]:
    """Orientation of every cone by the exposure's own record, in local east, north, up; by a
    trajectory in its place, if one is given."""
    source = _Recorded(exposure.navigation) if trajectory is None else trajectory
    return orient(exposure, rig, mount, source, _Local())


def _head(one: ExteriorOrientation, rig: Rig, ground_m: float) -> dict[str, Any]:
    ring = footprint(one, rig, ground_m)
    return {
        "image": one.name,
        "cone": one.cone,
        "gps_ns": str(one.gps_ns),
        "latitude_deg": round(one.latitude_deg, 10),
        "longitude_deg": round(one.longitude_deg, 10),
        "height_m": round(one.height_m, 4),
        "omega_phi_kappa_deg": [round(angle, 7) for angle in one.omega_phi_kappa_deg],
        "horizontal_sigma_m": one.horizontal_sigma_m,
        "vertical_sigma_m": one.vertical_sigma_m,
        "method": one.method,
        "footprint": None if ring is None else [[round(c, 8) for c in corner] for corner in ring],
    }


@dataclass(frozen=True)
class _Recorded:
    """The navigation of one record, carried on by its velocity; the attitude stays."""

    record: NavigationRecord | None

    def at(self, gps_ns: int) -> NavigationRecord | None:
        there = self.record
        if there is None or abs(gps_ns - there.gps_ns) > MAX_EXTRAPOLATION_NS:
            return None
        seconds = (gps_ns - there.gps_ns) * 1e-9
        if there.velocity_ned_mps is None:
            # Without a velocity it holds at its own instant only.
            return there if gps_ns == there.gps_ns else None
        north, east, down = there.velocity_ned_mps
        height_m = there.height_m
        per_latitude, per_longitude = metres_per_degree(there.latitude_deg, height_m or 0.0)
        return replace(
            there,
            gps_ns=gps_ns,
            latitude_deg=there.latitude_deg + north * seconds / per_latitude,
            longitude_deg=there.longitude_deg + east * seconds / per_longitude,
            height_m=None if height_m is None else height_m - (down or 0.0) * seconds,
        )


class _Local:
    """Local axes at the place itself."""

    def place(self, latitude_deg: float, longitude_deg: float, height_m: float) -> ProjectedPoint:
        return ProjectedPoint(0.0, 0.0, height_m, azimuth_of_north_rad=0.0, scale=1.0)
