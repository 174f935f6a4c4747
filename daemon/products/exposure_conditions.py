"""From the record of an exposure to what the pipeline wants to know about it."""

from __future__ import annotations

import datetime
import math
import statistics
from collections.abc import Mapping

from daemon.configuration.model import PlanSection
from daemon.mission.exposure import Exposure
from daemon.mission.store.frame_checks import tdi_shifts
from daemon.orientation.ground_model import GroundModel
from daemon.planning.overlaps import OverlapShares
from drivers.timescales.leap_seconds import leap_seconds_at
from processing.geometry.conditions import Conditions, FrameSettings, by_sensor_name
from processing.geometry.sun import sun_elevation_rad
from processing.quality.report import Flag
from processing.rig import Rig

GPS_EPOCH_UNIX_S = 315_964_800
GPS_EPOCH = datetime.datetime(1980, 1, 6, tzinfo=datetime.UTC)


def conditions_of(
    exposure: Exposure,
    rig: Rig,
    plan: PlanSection,
    flags: Flag,
    overlap_shares: OverlapShares | None = None,
    *,
    ground: GroundModel | None = None,
) -> Conditions:
    """The conditions of an exposure; what the record does not know comes from the plan.

    `flags` are added to those the record holds; `overlap_shares` are its overlaps, where known, and
    `ground` is the height model under it.

    Raises:
        RecordError: an exposure time or a TDI count that cannot be.
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
    sigmas_ns = [f.time_sigma_ns for f in exposure.frames if f.time_sigma_ns is not None]
    return Conditions(
        temperatures_c={t.probe: t.value_c for t in exposure.temperatures},
        temperature_age_s={t.probe: t.age_ns * 1e-9 for t in exposure.temperatures},
        exposure_time_s={
            frame.sensor: frame.exposure_time_us * 1e-6
            for frame in exposure.frames
            if frame.exposure_time_us is not None
        },
        tdi_shifts=_tdi_shifts(exposure, rig),
        frame_settings={f.sensor: _frame_settings(f.settings) for f in exposure.frames},
        ground_speed_mps=speed_mps,
        height_above_ground_m=height_m,
        roll_rad=navigation.roll_rad if navigation else None,
        pitch_rad=navigation.pitch_rad if navigation else None,
        angular_rate_rad_per_s=None,
        crab_rad=crab_rad,
        time_sigma_ns=max(sigmas_ns, default=exposure.mark_sigma_ns),
        time_budget_ns=exposure.time_budget_ns,
        forward_overlap=overlap_shares.forward_overlap if overlap_shares else None,
        sidelap=overlap_shares.sidelap if overlap_shares else None,
        sun_elevation_rad=_sun_elevation_rad(exposure),
        capture_flags=capture_flags(exposure, rig) | flags,
        simulated=exposure.simulated,
    )


def _tdi_shifts(exposure: Exposure, rig: Rig) -> dict[str, int]:
    """By sensor; one without a frame is placed as the others of its cone."""
    found = {f.sensor: tdi_shifts(f, rig.sensor(f.sensor)) for f in exposure.frames}
    for cone in rig.cones:
        if of_cone := by_sensor_name(cone, found):
            usual = statistics.median_low(of_cone.values())
            found |= {sensor.name: usual for sensor in cone.sensors if sensor.name not in of_cone}
    return found


def _frame_settings(settings: Mapping[str, float | int | str]) -> FrameSettings:
    black = settings.get("BlackLevel")
    return FrameSettings(
        gain=gain_factor(settings),
        black=float(black) if isinstance(black, float | int) else None,
    )


def gain_factor(settings: Mapping[str, float | int | str]) -> float:
    """The gain of a frame as a factor.

    Args:
        settings: of the frame; `GainUnit` states the unit of `Gain`, a factor without it.

    Returns:
        The factor; 1 if the gain or its unit is not known.

    Example:
        >>> gain_factor({"Gain": 20.0, "GainUnit": "dB"}), gain_factor({"Gain": 4.0})
        (10.0, 4.0)
    """
    gain, unit = settings.get("Gain"), settings.get("GainUnit", "factor")
    if not isinstance(gain, float | int) or unit not in ("dB", "factor"):
        return 1.0
    return float(10.0 ** (gain / 20.0)) if unit == "dB" else float(gain)


def capture_flags(exposure: Exposure, rig: Rig) -> Flag:
    """Flags of an exposure from capture, and whether its calibration is missing or too old."""
    return Flag(exposure.flags) | _calibration_flag(exposure, rig)


def _calibration_flag(exposure: Exposure, rig: Rig) -> Flag:
    """Missing or too old; the age at an exposure without a known time is not evaluated."""
    if not rig.is_calibrated:
        return Flag.UNCALIBRATED
    if exposure.mark_gps_ns is None:
        return Flag(0)
    flown = GPS_EPOCH + datetime.timedelta(seconds=exposure.mark_gps_ns // 1_000_000_000)
    calibrated_on = datetime.date.fromisoformat(rig.calibration_date)
    is_expired = (flown.date() - calibrated_on).days > rig.calibration_valid_days
    return Flag.CALIBRATION_EXPIRED if is_expired else Flag(0)


def _sun_elevation_rad(exposure: Exposure) -> float | None:
    gps_ns, place = exposure.mark_gps_ns, exposure.navigation
    if gps_ns is None or place is None:
        return None
    unix_s = gps_ns * 1e-9 - leap_seconds_at(gps_ns) + GPS_EPOCH_UNIX_S
    return sun_elevation_rad(
        unix_s, math.radians(place.latitude_deg), math.radians(place.longitude_deg)
    )
