"""Exterior orientation of every cone of every exposure, each at its own mid-exposure.

Navigation at that instant, lever arm, boresight and the platform calibration of the rig; no image
is looked at. Angles are the business of `processing.geometry.orientation`, places of
`daemon.orientation.georeference`.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from daemon.configuration.model import ConfigurationError, MountSection, PlanSection
from daemon.mission.exposure import Exposure, NavigationRecord
from daemon.mission.exposure_batch import BatchResult, for_each_exposure
from daemon.mission.foreign_files import read_regular_file
from daemon.mission.layout import Mission
from daemon.mission.store.level0_folder import read_sealed
from daemon.orientation.geodesy import metres_per_degree
from daemon.orientation.georeference import ProjectedPoint
from processing.geometry.orientation import BODY_FROM_CAMERA, grid_from_camera, grid_from_enu
from processing.geometry.rotation import level_from_body, omega_phi_kappa, rotation_matrix
from processing.rig import Cone, Rig
from processing.rig.toml_text import parse_toml

Array = NDArray[np.float64]
MOUNT_FILE_MAX_BYTES = 1_000_000


@dataclass(frozen=True)
class ExteriorOrientation:
    """Position and attitude of one cone at one instant.

    Grid coordinates in metres; `rotation` (3, 3) is grid_from_camera; latitude, longitude and
    `height_m` (above the ellipsoid) are of the projection centre. `is_virtual` marks the cone whose
    orientation is that of the stitched image.
    """

    exposure: int
    cone: str
    is_virtual: bool
    gps_ns: int
    line_id: str
    strip_id: str
    latitude_deg: float
    longitude_deg: float
    height_m: float
    centre_m: Array
    rotation: Array
    azimuth_of_north_rad: float
    scale: float
    method: str
    horizontal_sigma_m: float | None
    vertical_sigma_m: float | None

    @property
    def name(self) -> str:
        """The image's name: that of the exposure's folder; with the cone, if it is a head's own."""
        return f"{self.exposure:06d}" if self.is_virtual else f"{self.exposure:06d}_{self.cone}"

    @property
    def enu_from_camera(self) -> Array:
        """Rotation from the camera to local east, north, up, (3, 3)."""
        return np.asarray(grid_from_enu(self.azimuth_of_north_rad).T @ self.rotation)

    @property
    def omega_phi_kappa_deg(self) -> tuple[float, float, float]:
        omega, phi, kappa = omega_phi_kappa(self.rotation)
        return math.degrees(omega), math.degrees(phi), math.degrees(kappa)


@dataclass(frozen=True)
class MissingOrientation:
    """An exposure, or a cone of it, without an orientation, and why."""

    exposure: int
    cone: str
    reason: Literal["no instant", "no navigation", "no height", "no attitude"]


class NavigationSource(Protocol):
    """Source of navigation at an instant: a trajectory, or one record's."""

    def at(self, gps_ns: int) -> NavigationRecord | None:
        """None where nothing is known about that instant."""


class PositionTransform(Protocol):
    """Transform of a place to the requested coordinate system."""

    def place(self, latitude_deg: float, longitude_deg: float, height_m: float) -> ProjectedPoint:
        """See `daemon.orientation.georeference.Georeference.place`."""


def mount_of(mission: Mission) -> tuple[MountSection, PlanSection]:
    """Mount and plan of the configuration that was flown; defaults where there is none.

    A height model is looked for only where a mission may name one (`Mission.file_named`).

    Raises:
        ConfigurationError: the configuration cannot be used.
    """
    flown = mission.flown_configuration()
    try:
        mount = MountSection.model_validate(flown.get("mount", {}))
        plan = PlanSection.model_validate(flown.get("plan", {}))
    except ValueError as error:
        raise ConfigurationError([f"{mission.service_path}: {error}"]) from error
    if plan.elevation is not None:
        plan = plan.model_copy(update={"elevation": mission.file_named(plan.elevation)})
    return mount, plan


def read_mount(path: Path) -> MountSection:
    """The `[mount]` of a TOML file, such as `syntopic calibrate boresight` writes.

    Raises:
        ConfigurationError: no such file, or no such section in it.
    """
    try:
        content = parse_toml(read_regular_file(path, MOUNT_FILE_MAX_BYTES))
        return MountSection.model_validate(content["mount"])
    except KeyError as error:
        raise ConfigurationError([f"{path}: no [mount] in it"]) from error
    except (OSError, ValueError) as error:
        raise ConfigurationError([f"{path}: {error}"]) from error


def sealed_exposures(mission: Mission) -> BatchResult[Exposure]:
    """The sealed records of a mission by number, and those that cannot be read."""
    read = for_each_exposure(mission.numbers(), lambda number: sealed_exposure(mission, number))
    sealed = {number: record for number, record in read.results.items() if record is not None}
    return BatchResult(sealed, read.failures)


def sealed_exposure(mission: Mission, number: int) -> Exposure | None:
    """The sealed record of one exposure; None where it has none.

    Raises:
        RecordError: it has one that cannot be read.
    """
    sealed = read_sealed(mission.level0(number))
    return None if sealed is None else sealed.exposure


def orient(
    exposure: Exposure,
    rig: Rig,
    mount: MountSection,
    trajectory: NavigationSource,
    georeference: PositionTransform,
) -> Iterator[ExteriorOrientation | MissingOrientation]:
    """Orient every cone of an exposure, the one the image belongs to first.

    Raises:
        GeoreferenceError: outside the area of the coordinate system.
    """
    for cone in [_image_cone(rig), *(c for c in rig.cones if c.name != rig.master_cone)]:
        gps_ns = _mid_exposure(exposure, cone)
        if gps_ns is None:
            yield MissingOrientation(exposure.number, cone.name, "no instant")
            continue
        there = trajectory.at(gps_ns + round(mount.time_offset_ms * 1e6))
        if there is None:
            yield MissingOrientation(exposure.number, cone.name, "no navigation")
            continue
        if there.height_m is None:
            yield MissingOrientation(exposure.number, cone.name, "no height")
            continue
        if there.roll_rad is None or there.pitch_rad is None or there.heading_rad is None:
            yield MissingOrientation(exposure.number, cone.name, "no attitude")
            continue
        level_from_imu = level_from_body(there.roll_rad, there.pitch_rad, there.heading_rad)
        antenna = (there, there.height_m)
        yield _oriented(exposure, cone, rig, mount, antenna, level_from_imu, georeference)


def _oriented(
    exposure: Exposure,
    cone: Cone,
    rig: Rig,
    mount: MountSection,
    antenna: tuple[NavigationRecord, float],
    level_from_imu: Array,
    georeference: PositionTransform,
) -> ExteriorOrientation:
    there, antenna_height_m = antenna
    roll, pitch, heading = (math.radians(angle) for angle in mount.boresight_deg)
    imu_from_body = level_from_body(roll, pitch, heading)
    # From the point the receiver speaks of to the projection centre, first in the body.
    lever_m = np.array(cone.position_mm) * 1e-3 - np.array(mount.antenna_m)
    north_m, east_m, down_m = level_from_imu @ imu_from_body @ lever_m
    per_latitude, per_longitude = metres_per_degree(there.latitude_deg, antenna_height_m)
    latitude = there.latitude_deg + float(north_m) / per_latitude
    longitude = there.longitude_deg + float(east_m) / per_longitude
    height = antenna_height_m - float(down_m)
    place = georeference.place(latitude, longitude, height)
    is_master = cone.name == rig.image_cone_name
    return ExteriorOrientation(
        exposure=exposure.number,
        cone=cone.name,
        is_virtual=is_master and rig.virtual_image is not None,
        gps_ns=there.gps_ns,
        line_id=exposure.line_id,
        strip_id=exposure.strip_id,
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=height,
        centre_m=np.array([place.east_m, place.north_m, place.height_m]),
        rotation=grid_from_camera(
            level_from_imu=level_from_imu,
            imu_from_body=imu_from_body,
            body_from_camera=BODY_FROM_CAMERA @ rotation_matrix(*cone.rotation_rad),
            azimuth_of_north_rad=place.azimuth_of_north_rad,
        ),
        azimuth_of_north_rad=place.azimuth_of_north_rad,
        scale=place.scale,
        method=there.method,
        horizontal_sigma_m=there.horizontal_sigma_m,
        vertical_sigma_m=there.vertical_sigma_m,
    )


def _image_cone(rig: Rig) -> Cone:
    """The master cone; of converging heads one with the pose of the virtual camera."""
    if rig.master_cone is not None:
        return rig.cone(rig.master_cone)
    return dataclasses.replace(
        rig.cone(rig.reference_cone),
        name=rig.image_cone_name,
        position_mm=rig.image_position_mm,
        rotation_rad=(0.0, 0.0, 0.0),
    )


def _mid_exposure(exposure: Exposure, cone: Cone) -> int | None:
    """The middle of its sensors' mid-exposures, or the mark's where no frame of the cone came."""
    names = {sensor.name for sensor in cone.sensors}
    known = [
        frame.mid_exposure_gps_ns
        for frame in exposure.frames
        if frame.sensor in names and frame.mid_exposure_gps_ns is not None
    ]
    return statistics.median_low(known) if known else exposure.mark_gps_ns
