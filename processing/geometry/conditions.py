"""Conditions of an exposure apart from its pixels, and the figures computed from them.

Smear, parallax, ground sampling distance and dC are computed here; they become findings in
`processing.quality.report`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from processing.geometry.drift import lagged_probe, lagged_sensors
from processing.geometry.rotation import rotation_matrix
from processing.quality.figures import FigureGroup
from processing.quality.figures.circumstances import (
    DcFigures,
    GeometryFigures,
    SmearFigures,
    TimeFigures,
    WorstHeadFigures,
)
from processing.quality.probe_health import bridge_by_others
from processing.quality.report import NO_FLAGS, Flag, Thresholds
from processing.rig import Cone, Rig

T = TypeVar("T")


@dataclass(frozen=True)
class FrameSettings:
    """Values a head reports with its frame: gain, and the black level in words where known."""

    gain: float = 1.0
    black: float | None = None


@dataclass(frozen=True)
class Conditions:
    """The conditions of one exposure; None or an absent key is "not known".

    Temperatures are by probe; exposure times, TDI counts and settings are those of each frame, by
    sensor.
    Angles and rates are of the body (x forward, y right, z down); `crab_rad` is the angle from the
    track to the body's x axis. `time_budget_ns` are the parts of `time_sigma_ns`: receiver, clock,
    trigger, delay, head. Overlaps are with the image before it on the line and with the
    neighbouring line. `capture_flags` is what capture found.
    """

    temperatures_c: Mapping[str, float | None] = field(default_factory=dict)
    temperature_age_s: Mapping[str, float] = field(default_factory=dict)
    exposure_time_s: Mapping[str, float] = field(default_factory=dict)
    tdi_shifts: Mapping[str, int] = field(default_factory=dict)
    frame_settings: Mapping[str, FrameSettings] = field(default_factory=dict)
    ground_speed_mps: float | None = None
    height_above_ground_m: float | None = None
    roll_rad: float | None = None
    pitch_rad: float | None = None
    angular_rate_rad_per_s: tuple[float, float, float] | None = None
    crab_rad: float | None = None
    time_sigma_ns: float | None = None
    time_budget_ns: Mapping[str, float] = field(default_factory=dict)
    forward_overlap: float | None = None
    sidelap: float | None = None
    sun_elevation_rad: float | None = None
    capture_flags: Flag = NO_FLAGS
    simulated: bool = False

    @property
    def flags(self) -> Flag:
        """Capture's flags, with SIMULATED where the hardware is."""
        return self.capture_flags | (Flag.SIMULATED if self.simulated else NO_FLAGS)


@dataclass(frozen=True)
class UsableTemperatures:
    """Temperatures that can be used, and the probes that gave none or an impossible one.

    `usable_c` are as read, lagged ones of sensors among them; `bridged_c` stand in for probes
    without, taken from the others.
    """

    usable_c: Mapping[str, float]
    missing: tuple[str, ...]
    out_of_range: tuple[str, ...]
    bridged_c: Mapping[str, float] = field(default_factory=dict)

    @property
    def placement_temperatures_c(self) -> dict[str, float]:
        """What sensors are placed with: as read where it can be used, else bridged."""
        return {**self.bridged_c, **self.usable_c}


def usable_temperatures(
    rig: Rig, conditions: Conditions, thresholds: Thresholds
) -> UsableTemperatures:
    """Sort the probes the rig asks for into usable, missing and out of range.

    A probe without a usable value is bridged by the others where they allow it.

    Args:
        rig: the camera; its probes are sorted.
        conditions: temperatures by probe; None, NaN or an absent key counts as missing.
        thresholds: limits `temperature_low_c` and `temperature_high_c`, both still usable.

    Returns:
        Usable, missing and out-of-range probes, and the bridged temperatures, degC.
    """
    usable, missing, out_of_range = {}, [], []
    for probe in rig.probes:
        value = conditions.temperatures_c.get(probe)
        if value is None or not math.isfinite(value):
            missing.append(probe)
        elif thresholds.temperature_low_c <= value <= thresholds.temperature_high_c:
            usable[probe] = value
        else:
            out_of_range.append(probe)
    bridged = bridge_by_others(rig, usable)
    for sensor in lagged_sensors(rig):
        lagged = conditions.temperatures_c.get(lagged_probe(sensor))
        if sensor.probe in usable and lagged is not None and math.isfinite(lagged):
            usable[lagged_probe(sensor)] = lagged
    return UsableTemperatures(usable, tuple(missing), tuple(out_of_range), bridged)


def by_sensor_name(cone: Cone, of_frames: Mapping[str, T]) -> dict[str, T]:
    """Values of a cone's frames, by sensor name.

    Args:
        cone: whose sensors are wanted.
        of_frames: values by sensor name, those of other cones among them.

    Returns:
        The values of the cone's sensors, in file order; a sensor without a value has no key.
    """
    names = [sensor.name for sensor in cone.sensors]
    return {name: of_frames[name] for name in names if name in of_frames}


def for_sensors(rig: Rig, of_cones: Mapping[str, T]) -> dict[str, T]:
    """The same value for each sensor of a cone.

    Args:
        rig: the camera.
        of_cones: values by cone name; a cone may have none.

    Returns:
        Values by sensor name, in file order; sensors of cones without a value have no key.
    """
    return {
        sensor.name: of_cones[cone.name]
        for cone in rig.cones
        for sensor in cone.sensors
        if cone.name in of_cones
    }


def condition_figures(
    rig: Rig, conditions: Conditions, temperatures: UsableTemperatures
) -> tuple[FigureGroup, ...]:
    """Figures that need no pixels: geometry, dC, time and smear.

    Args:
        rig: the camera.
        conditions: of the exposure.
        temperatures: from `usable_temperatures` of the same exposure.

    Returns:
        Groups of figures; a figure whose inputs are not known is None.
    """
    gsd_m = ground_sampling_distance_m(rig, conditions)
    ages = [conditions.temperature_age_s.get(probe) for probe in temperatures.usable_c]
    tilts = [abs(a) for a in (conditions.roll_rad, conditions.pitch_rad) if a is not None]
    crab, sun = conditions.crab_rad, conditions.sun_elevation_rad
    shifts = by_sensor_name(rig.cone(rig.reference_cone), conditions.tdi_shifts)
    geometry = GeometryFigures(
        gsd_m=gsd_m,
        tilt_deg=math.degrees(max(tilts)) if tilts else None,
        crab_deg=None if crab is None else abs(math.degrees(crab)),
        forward_overlap=conditions.forward_overlap,
        sidelap=conditions.sidelap,
        sun_deg=None if sun is None else math.degrees(sun),
        tdi_shifts=max(shifts.values(), default=None),
        temperature_age_s=max((age for age in ages if age is not None), default=None),
    )
    return geometry, _dc(rig, temperatures), _time(conditions, gsd_m), *_smears(rig, conditions)


def _time(conditions: Conditions, gsd_m: float | None) -> TimeFigures:
    sigma_ns, speed_mps = conditions.time_sigma_ns, conditions.ground_speed_mps
    error_px = None
    if sigma_ns is not None and speed_mps is not None and gsd_m is not None:
        error_px = speed_mps * sigma_ns * 1e-9 / gsd_m
    budget_ns = conditions.time_budget_ns
    return TimeFigures(
        time_sigma_ns=sigma_ns,
        time_error_px=error_px,
        time_sigma_receiver_ns=budget_ns.get("receiver"),
        time_sigma_clock_ns=budget_ns.get("clock"),
        time_sigma_trigger_ns=budget_ns.get("trigger"),
        time_sigma_delay_ns=budget_ns.get("delay"),
        time_sigma_head_ns=budget_ns.get("head"),
    )


def ground_sampling_distance_m(rig: Rig, conditions: Conditions) -> float | None:
    """Ground covered by one pixel at the foot of the camera.

    Args:
        rig: the camera; without a virtual image the master cone's first sensor counts.
        conditions: `height_above_ground_m` is used.

    Returns:
        GSD = h p / f, m; None where the height is not known or not positive.

    Source: docs/explanation/mathematics/quality.md#ground-sampling-distance.

    Example:
        7.2 um pixels behind 100.5 mm: 7.2 cm from 1005 m.

        >>> from processing.rig import find_rig
        >>> conditions = Conditions(height_above_ground_m=1005.0)
        >>> gsd_m = ground_sampling_distance_m(find_rig("ultracam-x"), conditions)
        >>> round(gsd_m, 6)
        0.072
    """
    image, height = rig.virtual_image, conditions.height_above_ground_m
    if height is None or height <= 0:
        return None
    if image is not None:
        return height * image.pitch_mm / image.f_mm
    cone = rig.cone(rig.master_cone or rig.reference_cone)
    return height * cone.sensors[0].pitch_mm / cone.lens.f_mm


def parallax_px(rig: Rig, conditions: Conditions, relief_fraction: float) -> float:
    """Parallax by relief between PAN and a colour master off the flight axis.

    Along the flight axis syntopic exposure removes it; crab turns some of it back.

    Args:
        rig: the camera.
        conditions: `height_above_ground_m` and `crab_rad` are used.
        relief_fraction: height of the relief over the height above ground, dh / h.

    Returns:
        base * f * dh / h^2 in PAN pixels; zero where the height is not known, or without a
        virtual image or colour master.

    Source: docs/explanation/mathematics/quality.md#parallax.
    """
    image, height = rig.virtual_image, conditions.height_above_ground_m
    if image is None or height is None or height <= 0 or rig.colour_master_cone is None:
        return 0.0
    seen_from, colour = rig.image_position_mm, rig.cone(rig.colour_master_cone)
    along = colour.position_mm[0] - seen_from[0]
    across = colour.position_mm[1] - seen_from[1]
    if rig.timing == "syntopic":
        along *= math.sin(conditions.crab_rad or 0.0)
    base_mm = math.hypot(along, across)
    return base_mm * image.f_mm * relief_fraction / (height * 1e3) / image.pitch_mm


def _dc(rig: Rig, temperatures: UsableTemperatures) -> DcFigures:
    by_cone: dict[str, float | None] = {}
    pan = []
    for cone in rig.cones:
        known = temperatures.usable_c.get(cone.probe)
        dc = None if known is None else known - cone.calibration_c
        by_cone[cone.name] = dc
        if dc is not None and cone.role == "pan":
            pan.append(dc)
    return DcFigures(sum(pan) / len(pan) if pan else None, by_cone)


def _smears(rig: Rig, conditions: Conditions) -> tuple[FigureGroup, ...]:
    if rig.virtual_image is None:
        heads = {cone.name: head_smear_px(cone, conditions) for cone in rig.cones}
        known = {name: px for name, px in heads.items() if px is not None}
        worst = max(known, key=lambda name: known[name], default=None)
        along_px = None if worst is None else known[worst]
        return SmearFigures(along_px), WorstHeadFigures(worst)
    sensors = [sensor.name for cone in rig.pan_cones for sensor in cone.sensors]
    smears = [smear for name in sensors if (smear := _smear(rig, name, conditions)) is not None]
    return (
        SmearFigures(
            smear_along_px=max((along for along, _ in smears), default=None),
            smear_across_px=max((across for _, across in smears), default=None),
            tdi_shifts_max=max((conditions.tdi_shifts.get(name, 0) for name in sensors), default=0),
        ),
    )


def tdi_misfit_px(rig: Rig, conditions: Conditions, largest_px: float) -> dict[str, float]:
    """By PAN cone, what its TDI count leaves of the motion along track.

    A count of zero counts as any other: a record without counts may be of heads that shift.

    Args:
        rig: the camera.
        conditions: speed, height, crab, rates, exposure times and TDI counts are used.
        largest_px: motion up to this is not reported, px.

    Returns:
        Motion of the worst sensor in px by cone name, only above `largest_px`.

    Source: docs/explanation/mathematics/quality.md#smear.
    """
    found: dict[str, float] = {}
    if rig.virtual_image is None:
        return found
    for cone in rig.pan_cones:
        smears = [_smear(rig, sensor.name, conditions) for sensor in cone.sensors]
        worst = max((smear[0] for smear in smears if smear is not None), default=0.0)
        if worst > largest_px:
            found[cone.name] = worst
    return found


def head_smear_px(cone: Cone, conditions: Conditions) -> float | None:
    """How far flat ground moves during the exposure where it moves farthest in a head's image.

    A head that looks aslant has the ground nearest, and so the longest way, at one edge: all
    corners count and the middle.

    Args:
        cone: the head; its first sensor counts.
        conditions: speed, height, crab and the sensor's exposure time are used.

    Returns:
        Motion in px; None where speed, height or exposure time are not known.

    Source: docs/explanation/mathematics/quality.md#smear.

    Example:
        A pixel is 7.5 cm from 110 m, and so is the way in 10 ms at 7.5 m/s.

        >>> from processing.rig import find_rig
        >>> conditions = Conditions(
        ...     exposure_time_s={"G": 0.01}, ground_speed_mps=7.5, height_above_ground_m=110.0
        ... )
        >>> smear_px = head_smear_px(find_rig("rededge").cone("G"), conditions)
        >>> round(smear_px, 6)
        1.0
    """
    time_s = conditions.exposure_time_s.get(cone.sensors[0].name)
    speed_mps, height_m = conditions.ground_speed_mps, conditions.height_above_ground_m
    if time_s is None or speed_mps is None or height_m is None or height_m <= 0:
        return None
    sensor, f_mm = cone.sensors[0], cone.lens.f_mm
    half = np.array([sensor.width_px, sensor.height_px]) * sensor.pitch_mm / 2.0
    xy = np.array([[0, 0], [-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    rig_from_head = rotation_matrix(*cone.rotation_rad)
    rays = np.column_stack([xy, np.full(len(xy), -f_mm)]) @ rig_from_head.T
    rays = rays[rays[:, 2] < 0.0]
    crab = conditions.crab_rad or 0.0
    moved_m = speed_mps * time_s * np.array([-math.sin(crab), math.cos(crab), 0.0])
    before = rays * (-height_m / rays[:, 2:]) @ rig_from_head
    after = before - moved_m @ rig_from_head
    away = -f_mm * (after[:, :2] / after[:, 2:] - before[:, :2] / before[:, 2:])
    return float(np.hypot(away[:, 0], away[:, 1]).max(initial=0.0)) / sensor.pitch_mm


def _smear(rig: Rig, sensor: str, conditions: Conditions) -> tuple[float, float] | None:
    """Motion in pixels along and across track that the sensor's TDI leaves.

    Rotation adds to translation by absolute value: the worst place of the image counts.

    Source: docs/explanation/mathematics/quality.md#smear.
    """
    time_s = conditions.exposure_time_s.get(sensor)
    gsd_m = ground_sampling_distance_m(rig, conditions)
    image = rig.virtual_image
    if time_s is None or image is None:
        return None
    along = across = 0.0
    known = False
    if gsd_m is not None and conditions.ground_speed_mps is not None:
        known = True
        moved_px = conditions.ground_speed_mps * time_s / gsd_m
        crab = conditions.crab_rad or 0.0
        along = abs(moved_px * math.cos(crab) - conditions.tdi_shifts.get(sensor, 0))
        across = abs(moved_px * math.sin(crab))
    if conditions.angular_rate_rad_per_s is not None:
        known = True
        roll, pitch, yaw = (abs(rate) * time_s for rate in conditions.angular_rate_rad_per_s)
        f_px = image.f_mm / image.pitch_mm
        along += pitch * f_px + yaw * image.width_px / 2.0
        across += roll * f_px + yaw * image.height_px / 2.0
    return (along, across) if known else None
