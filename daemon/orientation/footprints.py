"""Ground footprints of images, as GeoJSON.

Rays are followed to level ground in the local east, north, up of the projection centre; relief and
the curvature of the earth (8 cm at 1 km) are left out. `rings_on_terrain` follows them to the
ground of a height model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from daemon.configuration.model import MountSection
from daemon.mission.exposure import NavigationRecord
from daemon.orientation.antimeridian import Ring, polygon
from daemon.orientation.exterior_orientation import ExteriorOrientation
from daemon.orientation.georeference import Georeference
from daemon.orientation.local_frame import LocalFrame
from daemon.orientation.orientation_files import image_extent_mm
from drivers.timescales.leap_seconds import leap_seconds_at
from processing.geometry.orientation import BODY_FROM_CAMERA, grid_from_camera, on_level_ground
from processing.geometry.rotation import level_from_body
from processing.geometry.terrain_rays import HeightModel, on_terrain
from processing.rig import Rig

ALONG_EDGE = 8
"""Points on each side of the image."""

GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)


def footprint(
    eo: ExteriorOrientation, rig: Rig, ground_m: float
) -> list[tuple[float, float]] | None:
    """The four corners (longitude, latitude), counter-clockwise; None where the horizon is seen.

    Args:
        ground_m: height of the ground above the ellipsoid.
    """
    cone = rig.cone(rig.reference_cone if eo.is_virtual else eo.cone)
    left, bottom, right, top = image_extent_mm(rig, cone, is_virtual=eo.is_virtual)
    f_mm = rig.virtual_image.f_mm if eo.is_virtual and rig.virtual_image else cone.lens.f_mm
    image_mm = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    centre = np.array([0.0, 0.0, eo.height_m])
    ground = on_level_ground(centre, eo.enu_from_camera, image_mm, f_mm, ground_m)
    if not np.isfinite(ground).all():
        return None
    corners = LocalFrame(eo.latitude_deg, eo.longitude_deg).to_geodetic(ground)
    return [(float(longitude), float(latitude)) for latitude, longitude, _ in corners]


def footprint_corners(
    rig: Rig, mount: MountSection, navigation: NavigationRecord, ground_m: float
) -> list[tuple[float, float]] | None:
    """The corners (longitude, latitude) of the image taken there, before any georeferencing.

    None without a height or an attitude, and where the horizon is seen. The camera's own place on
    the aircraft is left out: centimetres.
    """
    n = navigation
    if n.height_m is None or n.roll_rad is None or n.pitch_rad is None or n.heading_rad is None:
        return None
    boresight = level_from_body(*(math.radians(angle) for angle in mount.boresight_deg))
    eo = ExteriorOrientation(
        exposure=0,
        cone=rig.image_cone_name,
        is_virtual=rig.virtual_image is not None,
        gps_ns=n.gps_ns,
        line_id="",
        strip_id="",
        latitude_deg=n.latitude_deg,
        longitude_deg=n.longitude_deg,
        height_m=n.height_m,
        centre_m=np.array([0.0, 0.0, n.height_m]),
        rotation=grid_from_camera(
            level_from_imu=level_from_body(n.roll_rad, n.pitch_rad, n.heading_rad),
            imu_from_body=boresight,
            body_from_camera=BODY_FROM_CAMERA,
            azimuth_of_north_rad=0.0,
        ),
        azimuth_of_north_rad=0.0,
        scale=1.0,
        method=n.method,
        horizontal_sigma_m=n.horizontal_sigma_m,
        vertical_sigma_m=n.vertical_sigma_m,
    )
    return footprint(eo, rig, ground_m)


def ground_sample_m(eo: ExteriorOrientation, rig: Rig, ground_m: float) -> float:
    """Size of a pixel on level ground straight below, m."""
    virtual = rig.virtual_image
    if eo.is_virtual and virtual is not None:
        return (eo.height_m - ground_m) * virtual.pitch_mm / virtual.f_mm
    cone = rig.cone(eo.cone)
    return (eo.height_m - ground_m) * cone.sensors[0].pitch_mm / cone.lens.f_mm


def utc_text(gps_ns: int) -> str:
    """A GPS instant as UTC, RFC 3339 with microseconds."""
    leap_s = leap_seconds_at(gps_ns)
    leap_s = leap_seconds_at(gps_ns - leap_s * 1_000_000_000)
    utc = GPS_EPOCH + timedelta(microseconds=gps_ns // 1000) - timedelta(seconds=leap_s)
    return utc.strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def geojson(
    oriented: Sequence[ExteriorOrientation],
    rig: Rig,
    ground_m: float,
    *,
    simulated: bool,
    verdicts: Mapping[int, str],
    rings: Mapping[str, Sequence[tuple[float, float]] | None] | None = None,
) -> dict[str, Any]:
    """A FeatureCollection of footprints (RFC 7946); `rings` by image in place of level ground."""
    features = []
    for eo in oriented:
        properties = {
            "image": eo.name,
            "exposure": eo.exposure,
            "cone": eo.cone,
            "line": eo.line_id,
            "strip": eo.strip_id,
            "utc": utc_text(eo.gps_ns),
            "gsd_m": round(ground_sample_m(eo, rig, ground_m), 4),
            "verdict": verdicts.get(eo.exposure),
            "simulated": simulated,
        }
        ring = footprint(eo, rig, ground_m) if rings is None else rings.get(eo.name)
        geometry = polygon(ring)
        features.append({"type": "Feature", "geometry": geometry, "properties": properties})
    return {"type": "FeatureCollection", "features": features}


def rings_on_terrain(
    oriented: Sequence[ExteriorOrientation],
    rig: Rig,
    model: HeightModel,
    georeference: Georeference,
) -> Mapping[str, Ring | None]:
    """Image edges followed to the ground of a height model.

    Returns:
        Rings (longitude, latitude), counter-clockwise, by image; None where an edge misses the
        model or the horizon is seen.
    """
    found: dict[str, Ring | None] = {}
    for eo in oriented:
        cone = rig.cone(eo.cone)
        left, bottom, right, top = image_extent_mm(rig, cone, is_virtual=eo.is_virtual)
        f_mm = rig.virtual_image.f_mm if eo.is_virtual and rig.virtual_image else cone.lens.f_mm
        corners = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
        share = np.arange(ALONG_EDGE)[:, None] / ALONG_EDGE
        edge = np.concatenate(
            [a + (b - a) * share for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)]
        )
        rays = np.column_stack([edge, np.full(len(edge), -f_mm)]) @ eo.rotation.T
        ground = on_terrain(eo.centre_m, rays, model)
        found[eo.name] = (
            [georeference.position(*(float(v) for v in p)) for p in ground]
            if np.isfinite(ground).all()
            else None
        )
    return found
