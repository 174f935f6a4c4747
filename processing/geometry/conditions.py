"""Conditions of an exposure apart from its pixels, and the figures computed from them.

Smear, parallax, ground sampling distance and dC are computed here; they become findings in
`processing.quality.report`.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from processing.geometry.drift import lagged_probe, lagged_sensors
from processing.geometry.rotation import rotation_matrix
from processing.quality.figures import FigureGroup
from processing.quality.figures.circumstances import (
    DcFigures,
    ExposureScaleFigures,
    GeometryFigures,
    SmearFigures,
    TimeFigures,
    UnknownExposureFigures,
    WorstHeadFigures,
)
from processing.quality.probe_health import bridge_by_others
from processing.quality.report import NO_FLAGS, Flag, Thresholds
from processing.rig import Cone, Rig

T = TypeVar("T")

EXPOSURE_TIME_TOLERANCE = 0.02
"""Exposure times of cones that differ by less are those of one setting."""
MAX_EXPOSURE_SCALE = 2.05


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
    """Sort the probes the rig asks for into usable, missing and out of range."""
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
    """Values of a cone's frames, by sensor name."""
    names = [sensor.name for sensor in cone.sensors]
    return {name: of_frames[name] for name in names if name in of_frames}


def for_sensors(rig: Rig, of_cones: Mapping[str, T]) -> dict[str, T]:
    """The same value for each sensor of a cone: by sensor name, from values by cone name."""
    return {
        sensor.name: of_cones[cone.name]
        for cone in rig.cones
        for sensor in cone.sensors
        if cone.name in of_cones
    }


def reference_exposure_times(rig: Rig, exposure_times: Mapping[str, float]) -> dict[str, float]:
    """Common exposure time to which the signal of each frame is scaled, by sensor name.

    The median of its cone where that is the median of all PAN cones, or of all colour cones, to
    within `ALIKE`; else the median of those. A cone exposed less than half as long keeps its own:
    its highlights would leave the range of words.

    Args:
        exposure_times: positive, by sensor name, in any unit; the result has the same.
    """
    references: dict[str, float] = {}
    for cones in (rig.pan_cones, rig.colour_cones):
        of_cones = {
            cone.name: statistics.median_low(known.values())
            for cone in cones
            if (known := by_sensor_name(cone, exposure_times))
        }
        if not of_cones:
            continue
        usual = statistics.median_low(of_cones.values())
        for cone in cones:
            own = of_cones.get(cone.name, usual)
            is_unscaled = (
                abs(own / usual - 1.0) <= EXPOSURE_TIME_TOLERANCE
                or own < usual / MAX_EXPOSURE_SCALE
            )
            for name in by_sensor_name(cone, exposure_times):
                references[name] = own if is_unscaled else usual
    return references


def exposure_scales(rig: Rig, exposure_time_s: Mapping[str, float]) -> dict[str, float]:
    """Factors on the signal of each frame that make all frames comparable.

    Exactly 1 where the frames of a cone have one exposure time, and that of the other cones. A frame
    whose exposure time is not known has none.

    Args:
        exposure_time_s: positive, by sensor name.
    """
    references = reference_exposure_times(rig, exposure_time_s)
    return {name: reference / exposure_time_s[name] for name, reference in references.items()}


def exposure_scale_figures(scales: Mapping[str, float]) -> ExposureScaleFigures:
    """The frame whose level was corrected most, and by what factor."""
    name = max(scales, key=lambda n: abs(math.log(scales[n])), default=None)
    if name is None:
        return ExposureScaleFigures()
    return ExposureScaleFigures(None if scales[name] == 1.0 else name, scales[name])


def unknown_exposure_figures(
    rig: Rig, present: Collection[str], exposure_time_s: Mapping[str, float]
) -> UnknownExposureFigures:
    """Colour frames whose exposure time is not known while that of other frames is.

    Overlaps show the level of a PAN head; nothing in one exposure shows that of a colour head.

    Args:
        present: names of the sensors that sent a frame.
        exposure_time_s: by sensor name, what the record states.
    """
    if not any(name in exposure_time_s for name in present):
        return UnknownExposureFigures()
    colour = [s.name for cone in rig.colour_cones for s in cone.sensors if s.name in present]
    return UnknownExposureFigures(tuple(n for n in colour if n not in exposure_time_s))


def condition_figures(
    rig: Rig, conditions: Conditions, temperatures: UsableTemperatures
) -> tuple[FigureGroup, ...]:
    """Figures that need no pixels."""
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
    """Ground covered by one pixel at the foot of the camera; without a virtual image by the master
    cone's."""
    image, height = rig.virtual_image, conditions.height_above_ground_m
    if height is None or height <= 0:
        return None
    if image is not None:
        return height * image.pitch_mm / image.f_mm
    cone = rig.cone(rig.master_cone or rig.reference_cone)
    return height * cone.sensors[0].pitch_mm / cone.lens.f_mm


def parallax_px(rig: Rig, conditions: Conditions, relief_fraction: float) -> float:
    """Parallax by relief between PAN and a colour master off the flight axis, PAN pixels.

    base * f * dh / h^2 for relief of `relief_fraction` of the height; zero where the height is not
    known. Along the flight axis syntopic exposure removes it; crab turns some of it back.
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
        ),
    )


def tdi_misfit_px(rig: Rig, conditions: Conditions, largest_px: float) -> dict[str, float]:
    """By PAN cone, what its TDI count leaves of the motion along track, where above `largest_px`.

    Empty where no head shifts its charges.
    """
    found: dict[str, float] = {}
    if rig.virtual_image is None or not any(conditions.tdi_shifts.values()):
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
    corners count and the middle. None where speed, height or exposure time are not known.
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
