"""Measured orientations of exposures, from their own records, for the live triangulation."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daemon.configuration.model import MountSection
from daemon.mission.exposure import Exposure
from daemon.orientation.exterior_orientation import ExteriorOrientation, NavigationSource
from daemon.orientation.in_flight_orientation import recorded_orientations
from daemon.orientation.local_frame import LocalFrame
from processing.pipelines.live_triangulation import MeasuredImage
from processing.rig import Rig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SensorSigmas:
    """Standard deviations where the receiver states none: plan and height in m, and of roll, pitch
    and heading in mdeg."""

    plan_m: float = 0.05
    height_m: float = 0.08
    attitude_mdeg: tuple[float, float, float] = (5.0, 5.0, 8.0)

    @property
    def about_camera_rad(self) -> Array:
        """About the camera's x (pitch), y (roll) and z (heading), (3,)."""
        roll, pitch, heading = (math.radians(v * 1e-3) for v in self.attitude_mdeg)
        return np.array([pitch, roll, heading])


def oriented(
    exposure: Exposure, rig: Rig, mount: MountSection, trajectory: NavigationSource | None = None
) -> ExteriorOrientation | str:
    """Measured orientation of the stitched image; the reason where there is none."""
    first = next(recorded_orientations(exposure, rig, mount, trajectory))
    return first if isinstance(first, ExteriorOrientation) else first.reason


def measured_image(
    exposure: Exposure, eo: ExteriorOrientation, frame: LocalFrame, sigmas: SensorSigmas
) -> MeasuredImage:
    """The measured orientation in a local frame; sigmas of the receiver where it states them."""
    here = (np.array(eo.latitude_deg), np.array(eo.longitude_deg), np.array(eo.height_m))
    local_from_enu = frame.local_from_enu(eo.latitude_deg, eo.longitude_deg)
    plan_m = _positive(eo.horizontal_sigma_m, sigmas.plan_m)
    height_m = _positive(eo.vertical_sigma_m, sigmas.height_m)
    velocity = np.full(3, np.nan)
    navigation = exposure.navigation
    if navigation is not None and navigation.velocity_ned_mps is not None:
        north, east, down = navigation.velocity_ned_mps
        if down is not None:
            velocity = local_from_enu @ np.array([east, north, -down])
    return MeasuredImage(
        exposure.number,
        exposure.line_id,
        eo.gps_ns * 1e-9,
        frame.from_geodetic(*here),
        local_from_enu @ eo.enu_from_camera,
        np.array([plan_m, plan_m, height_m]),
        sigmas.about_camera_rad,
        velocity,
    )


def _positive(stated: float | None, otherwise: float) -> float:
    return stated if stated is not None and stated > 0.0 else otherwise
