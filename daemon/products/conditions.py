"""From the record of an exposure to what the pipeline wants to know about it."""

from __future__ import annotations

import datetime
import math

from daemon.configuration import PlanSection
from daemon.exposure import Exposure
from daemon.orientation.ground import Ground
from daemon.plan.overlaps import Surroundings
from drivers.leap_seconds import leap_seconds_at
from processing.geometry.sun import sun_elevation_rad
from processing.pipeline import Conditions
from processing.quality.report import Flag
from processing.rig import Rig

GPS_EPOCH_UNIX_S = 315_964_800
GPS_EPOCH = datetime.datetime(1980, 1, 6, tzinfo=datetime.UTC)


def conditions_of(
    exposure: Exposure,
    rig: Rig,
    plan: PlanSection,
    flags: Flag,
    surroundings: Surroundings | None = None,
    *,
    ground: Ground | None = None,
) -> Conditions:
    """The conditions of an exposure; what the record does not know comes from the plan.

    `flags` are added to those the record holds; `surroundings` are its overlaps, where known, and
    `ground` is the height model under it.
    """
    navigation = exposure.navigation
    speed_mps = plan.ground_speed_mps
    height_m = plan.height_above_ground_m
    crab_rad = None
    if navigation is not None:
        if navigation.height_m is not None:
            height_m = navigation.height_m - plan.ground_height_m
        if ground is not None and (above_m := ground.height_above_m(navigation)) is not None:
            height_m = above_m
    if navigation is not None and navigation.velocity_ned_mps is not None:
        north, east, _ = navigation.velocity_ned_mps
        speed_mps = math.hypot(north, east)
        if navigation.heading_rad is not None and speed_mps > 1.0:
            crab = navigation.heading_rad - math.atan2(east, north)
            crab_rad = math.remainder(crab, 2 * math.pi)
    exposure_time_s = {}
    tdi_shifts = {}
    for frame in exposure.frames:
        cone = rig.cone_of(frame.sensor).name
        if frame.exposure_time_us is not None:
            exposure_time_s[cone] = frame.exposure_time_us * 1e-6
        tdi_shifts[cone] = int(frame.settings.get("TdiShifts", 0))
    sigmas_ns = [f.time_sigma_ns for f in exposure.frames if f.time_sigma_ns is not None]
    return Conditions(
        temperatures_c={t.probe: t.value_c for t in exposure.temperatures},
        temperature_age_s={t.probe: t.age_ns * 1e-9 for t in exposure.temperatures},
        exposure_time_s=exposure_time_s,
        tdi_shifts=tdi_shifts,
        ground_speed_mps=speed_mps,
        height_above_ground_m=height_m,
        roll_rad=navigation.roll_rad if navigation else None,
        pitch_rad=navigation.pitch_rad if navigation else None,
        angular_rate_rad_per_s=None,
        crab_rad=crab_rad,
        time_sigma_ns=max(sigmas_ns, default=exposure.mark_sigma_ns),
        time_budget_ns=exposure.time_budget_ns,
        forward_overlap=surroundings.forward_overlap if surroundings else None,
        sidelap=surroundings.sidelap if surroundings else None,
        sun_elevation_rad=_sun_elevation_rad(exposure),
        capture_flags=Flag(exposure.flags) | flags | _calibration_flag(exposure, rig),
        simulated=exposure.simulated,
    )


def _calibration_flag(exposure: Exposure, rig: Rig) -> Flag:
    """Whether the calibration was too old; one without a known time is not judged."""
    if exposure.mark_gps_ns is None:
        return Flag(0)
    flown = GPS_EPOCH + datetime.timedelta(seconds=exposure.mark_gps_ns // 1_000_000_000)
    made = datetime.date.fromisoformat(rig.calibration_date)
    is_expired = (flown.date() - made).days > rig.calibration_valid_days
    return Flag.CALIBRATION_EXPIRED if is_expired else Flag(0)


def _sun_elevation_rad(exposure: Exposure) -> float | None:
    gps_ns, place = exposure.mark_gps_ns, exposure.navigation
    if gps_ns is None or place is None:
        return None
    unix_s = gps_ns * 1e-9 - leap_seconds_at(gps_ns) + GPS_EPOCH_UNIX_S
    return sun_elevation_rad(
        unix_s, math.radians(place.latitude_deg), math.radians(place.longitude_deg)
    )
