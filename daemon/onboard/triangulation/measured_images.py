"""Measured orientations of exposures, from their own records, for the live triangulation."""

from __future__ import annotations

import math

import numpy as np

from daemon.configuration.model import MountSection
from daemon.mission.exposure import Exposure
from daemon.orientation.exterior_orientation import ExteriorOrientation, NavigationSource
from daemon.orientation.in_flight_orientation import recorded_orientations
from daemon.orientation.local_frame import LocalFrame
from daemon.orientation.navigation_sigmas import NavigationSigmas
from processing.bundle.frame_patterns import FramePatterns
from processing.pipelines.live_triangulation import MeasuredImage
from processing.rig import Rig


def oriented(
    exposure: Exposure, rig: Rig, mount: MountSection, trajectory: NavigationSource | None = None
) -> ExteriorOrientation | str:
    """Measured orientation of the stitched image; the reason where there is none."""
    first = next(recorded_orientations(exposure, rig, mount, trajectory))
    return first if isinstance(first, ExteriorOrientation) else first.reason


def measured_image(
    exposure: Exposure,
    eo: ExteriorOrientation,
    frame: LocalFrame,
    sigmas: NavigationSigmas,
    patterns: FramePatterns | None = None,
) -> MeasuredImage:
    """The measured orientation in a local frame; sigmas of the receiver where it states them."""
    here = (np.array(eo.latitude_deg), np.array(eo.longitude_deg), np.array(eo.height_m))
    local_from_enu = frame.local_from_enu(eo.latitude_deg, eo.longitude_deg)
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
        sigmas.of_position(eo),
        sigmas.about_camera_rad,
        velocity,
        camera_temperature_c(exposure),
        patterns,
    )


def camera_temperature_c(exposure: Exposure) -> float:
    """Mean of the probes of an exposure; NaN without any."""
    read = [one.value_c for one in exposure.temperatures if one.value_c is not None]
    return sum(read) / len(read) if read else math.nan
