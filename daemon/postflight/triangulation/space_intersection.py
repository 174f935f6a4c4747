"""Combined intersection: ground points from measured places in directly oriented images.

All heads of an exposure share its position and attitude, all exposures the boresight, all images of
a head its mounting: what these are uncertain by is carried into the points with its correlations.
The mathematics is in `processing.bundle.point_intersection`.

Source: Jacobsen (2008) ("object coordinates ... by combined intersection").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.exposure_batch import ExposureFailure
from daemon.mission.layout import Mission
from daemon.orientation.antimeridian import mean_longitude
from daemon.orientation.exterior_orientation import ExteriorOrientation, sealed_exposures
from daemon.orientation.local_frame import LocalFrame
from daemon.orientation.orientation_inputs import read_orientation_inputs
from daemon.postflight.adjustment.csv_tables import read_table
from processing.bundle.initial_values import completed
from processing.bundle.network import (
    Attitudes,
    CameraModel,
    HeadMounting,
    ImagePoints,
    Images,
    Network,
    NetworkError,
    Points,
    Stations,
)
from processing.bundle.point_intersection import intersect_points, orientation_layout
from processing.bundle.unknowns import ParameterLayout
from processing.geometry.orientation import BODY_FROM_CAMERA
from processing.geometry.rotation import rotation_matrix
from processing.matching.block_matching import image_mm
from processing.pipelines.perspective import perspective_of
from processing.rig import Cone, Rig, VirtualImage

Array = NDArray[np.float64]


class IntersectionError(DaemonError, ValueError):
    """Nothing can be intersected; the message states what is missing."""


@dataclass(frozen=True)
class IntersectionSigmas:
    """Standard deviations: of places in the images (px), positions (3,) m east, north, up,
    attitudes and boresight (3,) rad about the rig's camera axes. Mounting angles are uncertain by
    `rotation_sigma_urad` of the rig file."""

    image_px: float = 0.5
    position_m: tuple[float, float, float] = (0.05, 0.05, 0.08)
    attitude_rad: tuple[float, float, float] = (1e-4, 1e-4, 1.5e-4)
    boresight_rad: tuple[float, float, float] = (3e-5, 3e-5, 5e-5)


@dataclass(frozen=True)
class GroundPoint:
    """One point: place in the coordinate system, (3,) m, and on the ellipsoid; sigma (3,) m east,
    north, up, and the part of it that the places in the images account for; rays that made it."""

    name: str
    place_m: tuple[float, float, float]
    latitude_deg: float
    longitude_deg: float
    height_m: float
    sigma_m: tuple[float, float, float]
    of_image_m: tuple[float, float, float]
    rays: int


@dataclass(frozen=True)
class IntersectionResult:
    """Points found, names of those whose rays do not fix them, and the coordinate system.

    `failures` are exposures whose record cannot be read.
    """

    points: tuple[GroundPoint, ...]
    left_out: tuple[str, ...]
    crs: str
    height_system: str
    failures: tuple[ExposureFailure, ...] = ()


def intersect(
    mission: Mission,
    measured_file: Path,
    sigmas: IntersectionSigmas,
    *,
    crs: str | None = None,
    trajectory_file: Path | None = None,
    mount_file: Path | None = None,
) -> IntersectionResult:
    """Intersect what a table of measured places names.

    Args:
        measured_file: columns `image` (as `syntopic orient` names it), `point`, `column_px`,
            `row_px` of the Level-2 image; `sigma_px`.

    Raises:
        IntersectionError: no oriented image, or images that are not there.
        daemon.postflight.adjustment.csv_tables.ProjectError: the table is not as it should be.
    """
    read = sealed_exposures(mission)
    exposures = [e for e in read.results.values() if e.mark_gps_ns is not None]
    inputs = read_orientation_inputs(
        mission, exposures, crs=crs, trajectory_file=trajectory_file, mount_file=mount_file
    )
    rig, crs, georeference = inputs.rig, inputs.crs, inputs.georeference
    oriented = inputs.oriented(exposures)
    table = read_table(measured_file, ("image", "point", "column_px", "row_px"), ("sigma_px",))
    px = np.array([table.numbers("column_px"), table.numbers("row_px")]).T.reshape(-1, 2)
    spread = np.array(table.numbers("sigma_px", sigmas.image_px))
    images, points = table.text("image"), table.text("point")
    known = {eo.name for eo in oriented}
    for name, line in zip(images, table.lines, strict=True):
        if name not in known:
            table.add_problem(
                line, f"image {name!r} has no orientation (names as in orientation.csv)"
            )
    if table.problems or not len(px) or not np.isfinite(px).all():
        raise IntersectionError(
            "; ".join(table.problems) or f"{measured_file}: a place takes column_px and row_px"
        )
    used = [eo for eo in oriented if eo.name in set(images)]
    frame = LocalFrame(
        float(np.mean([eo.latitude_deg for eo in used])),
        mean_longitude([eo.longitude_deg for eo in used]),
    )
    names = tuple(dict.fromkeys(points))
    network = _network(rig, used, frame, names, images, points, px, spread)
    try:
        network = completed(network)
        layout = orientation_layout(network)
        found = intersect_points(network, layout, _covariance(layout, rig, network, sigmas))
    except NetworkError as error:
        raise IntersectionError(f"{measured_file}: {error}") from error
    rays = np.bincount(network.image_points.point, minlength=len(names))
    ground_points, lost = [], []
    for k, name in enumerate(names):
        if not np.isfinite(found.covariance_m2[k]).all():
            lost.append(name)
            continue
        latitude, longitude, height = (
            float(v) for v in frame.to_geodetic(found.xyz_m[k : k + 1])[0]
        )
        at = georeference.place(latitude, longitude, height)
        own, image = (np.sqrt(np.diag(c[k])) for c in (found.covariance_m2, found.of_image_m2))
        ground_points.append(
            GroundPoint(
                name, (at.east_m, at.north_m, at.height_m), latitude, longitude, height,
                _triple(own), _triple(image), int(rays[k]),
            )
        )  # fmt: skip
    return IntersectionResult(
        tuple(ground_points), tuple(lost), crs, georeference.height_system, read.failures
    )


def _network(
    rig: Rig,
    used: Sequence[ExteriorOrientation],
    frame: LocalFrame,
    names: tuple[str, ...],
    images: Sequence[str],
    points: Sequence[str],
    px: Array,
    spread: Array,
) -> Network:
    """Exposures with one position and attitude where the rig is synchronous, heads in it."""
    shared = rig.virtual_image is None and rig.timing == "synchronous"
    cones = list(dict.fromkeys(eo.cone for eo in used))
    groups = [str(eo.exposure) if shared else eo.name for eo in used]
    stations = list(dict.fromkeys(groups))
    centre, attitude = np.zeros((len(stations), 3)), np.zeros((len(stations), 3, 3))
    for eo, group in zip(used, groups, strict=True):
        own = frame.local_from_enu(eo.latitude_deg, eo.longitude_deg) @ eo.enu_from_camera
        place = frame.from_geodetic(
            np.array(eo.latitude_deg), np.array(eo.longitude_deg), np.array(eo.height_m)
        )
        if shared:
            rotation, offset = _mounted(rig, rig.cone(eo.cone))
            own = own @ rotation.T
            place = place - own @ offset
        attitude[stations.index(group)] = own
        centre[stations.index(group)] = place
    heads = tuple(
        HeadMounting(name, *_mounted(rig, rig.cone(name)), rotation_free=name != rig.master_cone)
        for name in cones
    )
    at = {eo.name: k for k, eo in enumerate(used)}
    image = np.array([at[name] for name in images], dtype=np.int64)
    geometry = [_geometry(rig, rig.cone(eo.cone)) for eo in used]
    xy = np.array([image_mm(geometry[i], p[None])[0] for i, p in zip(image, px, strict=True)])
    sigma = spread * np.array([geometry[i].pitch_mm for i in image])
    order = {name: k for k, name in enumerate(names)}
    which = np.array([stations.index(g) for g in groups], dtype=np.int64)
    return Network(
        cameras=tuple(
            CameraModel(name, _geometry(rig, rig.cone(name)).f_mm, pixel_mm=None) for name in cones
        ),
        stations=Stations(tuple(stations), centre, np.zeros(len(stations), bool)),
        attitudes=Attitudes(tuple(stations), attitude, np.zeros(len(stations), bool)),
        images=Images(
            tuple(eo.name for eo in used),
            which,
            which,
            np.array([cones.index(eo.cone) for eo in used], dtype=np.int64),
            np.array([cones.index(eo.cone) if shared else -1 for eo in used], dtype=np.int64),
        ),
        points=Points(
            names,
            np.full((len(names), 3), np.nan),
            np.full((len(names), 3), np.nan),
            np.zeros(len(names), bool),
        ),
        image_points=ImagePoints(
            image,
            np.array([order[p] for p in points], dtype=np.int64),
            xy,
            np.stack([sigma, sigma], axis=1),
        ),
        heads=heads if shared else (),
    )


def _geometry(rig: Rig, cone: Cone) -> VirtualImage:
    if rig.virtual_image is not None and cone.name == rig.master_cone:
        return rig.virtual_image
    return perspective_of(cone)


def _mounted(rig: Rig, cone: Cone) -> tuple[Array, Array]:
    """Rotation rig from head, and the head's projection centre in the rig's camera axes, m."""
    offset_mm = np.array(cone.position_mm) - np.array(rig.cone(rig.master_cone).position_mm)
    return rotation_matrix(*cone.rotation_rad), BODY_FROM_CAMERA.T @ offset_mm * 1e-3


def _covariance(
    layout: ParameterLayout, rig: Rig, network: Network, sigmas: IntersectionSigmas
) -> Array:
    """(c, c) of the columns: independent positions and attitudes, one boresight, one mounting."""
    covariance = np.zeros((layout.columns, layout.columns))
    for axis in range(3):
        station, attitude = layout.station[:, axis], layout.attitude[:, axis]
        station, attitude = station[station >= 0], attitude[attitude >= 0]
        covariance[station, station] += sigmas.position_m[axis] ** 2
        covariance[attitude, attitude] += sigmas.attitude_rad[axis] ** 2
        covariance[np.ix_(attitude, attitude)] += sigmas.boresight_rad[axis] ** 2
        for k, head in enumerate(network.heads):
            column = layout.head_rotation[k, axis]
            if column >= 0:
                sigma = rig.cone(head.name).rotation_sigma_urad * 1e-6
                covariance[column, column] += sigma**2
    return covariance


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z
