"""A flight over control that determines boresight, lever arm and time offset, with its truth.

Nothing is rendered: image coordinates are where the true camera sees ground points. The inertial
unit has a boresight angle, a lever arm and a time offset; poses and their
derivatives are the emulator's own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sim_hw.world.seeding import random_stream
from sim_hw.world.true_camera import BODY_FROM_CAMERA

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

F_MM = 70.0
PIXEL_MM = 7.2e-3
HALF_MM = (9735 * PIXEL_MM / 2.0, 6588 * PIXEL_MM / 2.0)
EAST_NORTH_UP_FROM_LEVEL = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
STEP_S = 1e-4


@dataclass(frozen=True)
class CalibrationLine:
    """One pass over the middle of the field."""

    heading_deg: float
    height_m: float
    speed_mps: float


@dataclass(frozen=True)
class MeasurementSigmas:
    """Standard deviations of what is measured, mm, m and rad about forward, right, down."""

    image_mm: float = 1.5e-3
    control_m: float = 0.02
    position_m: tuple[float, float, float] = (0.03, 0.03, 0.05)
    attitude_rad: tuple[float, float, float] = (5e-5, 5e-5, 1.2e-4)


FULL = (
    CalibrationLine(0.0, 700.0, 50.0),
    CalibrationLine(180.0, 700.0, 80.0),
    CalibrationLine(90.0, 700.0, 80.0),
    CalibrationLine(270.0, 700.0, 50.0),
    CalibrationLine(0.0, 1100.0, 80.0),
    CalibrationLine(90.0, 1100.0, 50.0),
)
"""Two heights, opposite and crossing lines, two speeds."""

ONE_WAY = (
    CalibrationLine(0.0, 700.0, 65.0),
    CalibrationLine(0.0, 700.0, 65.0),
    CalibrationLine(0.0, 700.0, 65.0),
)
"""The flight that parts least: one direction, one height, one speed."""


@dataclass(frozen=True)
class CalibrationFlight:
    """The measurements, and the truth for comparison.

    Image coordinates of image `image`; the first `control` points are known. Inertial values are at
    the instants the camera's marks name: position of the antenna and velocity in east, north, up;
    roll, pitch, heading; rates about the unit's axes.
    """

    line: Indices
    time_s: Array
    centre_m: Array
    rotation: Array
    points: Array
    surveyed_m: Array
    control: int
    image: Indices
    point: Indices
    xy_mm: Array
    position_m: Array
    velocity_mps: Array
    angles_rad: Array
    rate_rad_per_s: Array
    boresight_rad: Array
    antenna_m: Array
    time_offset_s: float
    shift_m: Array
    spread: MeasurementSigmas = field(default_factory=MeasurementSigmas)


def simulate_calibration_flight(
    seed: int,
    lines: tuple[CalibrationLine, ...] = FULL,
    *,
    frames: int = 5,
    swing_deg: tuple[float, float] = (0.4, 1.2),
    spread: MeasurementSigmas | None = None,
) -> CalibrationFlight:
    """Fly `lines` of `frames` exposures each over a field with 20 control points.

    Roll, pitch and heading swing by an angle within `swing_deg`.
    """
    spread = spread or MeasurementSigmas()
    random = random_stream(seed, "boresight")
    boresight = random.normal(0.0, math.radians(0.3), 3)
    unit_from_body = _level_from_body(boresight)
    antenna = np.array([0.35, -0.20, -1.25]) + random.normal(0.0, 0.05, 3)
    offset = float(random.normal(0.0, 4e-3))
    shift = random.normal(0.0, 0.1, 3)
    centre, rotation, position, velocity, angles, rate = [], [], [], [], [], []
    which, time = [], []
    for k, line in enumerate(lines):
        swing = np.radians(random.uniform(*swing_deg, 3))
        pace = random.uniform(0.25, 0.8, 3)
        phase = random.uniform(0.0, 2.0 * math.pi, 3)
        base = 0.35 * 2.0 * HALF_MM[1] / F_MM * line.height_m
        aside = float(random.normal(0.0, 0.03 * line.height_m))
        motion = (line, swing, pace, phase, aside)
        for j in range(frames):
            t = (j - (frames - 1) / 2.0) * base / line.speed_mps
            place, level_from_body, speed = _pose(motion, t)
            # The receiver's instants are those of the marks; the camera exposed `offset` later.
            here, body, _ = _pose(motion, t + offset)
            centre.append(here)
            rotation.append(EAST_NORTH_UP_FROM_LEVEL @ body @ BODY_FROM_CAMERA)
            unit = level_from_body @ unit_from_body.T
            rotation_noise = unit.T @ _pose(motion, t + STEP_S)[1] @ unit_from_body.T
            back = unit.T @ _pose(motion, t - STEP_S)[1] @ unit_from_body.T
            rate.append(_vector(rotation_noise - back) / (2.0 * STEP_S))
            arm = EAST_NORTH_UP_FROM_LEVEL @ level_from_body @ antenna
            ahead = _pose(motion, t + STEP_S)[1] - _pose(motion, t - STEP_S)[1]
            angular_rate = EAST_NORTH_UP_FROM_LEVEL @ ahead @ antenna / (2.0 * STEP_S)
            position.append(place + arm + shift + random.normal(0.0, spread.position_m))
            velocity.append(speed + angular_rate)
            disturbed_rotation = unit @ _level_from_body(random.normal(0.0, spread.attitude_rad))
            angles.append(_angles(disturbed_rotation))
            which.append(k)
            time.append(400.0 * k + t)
    centres, rotations = np.array(centre), np.array(rotation)
    control = 20
    places = np.concatenate(
        [_lattice(5, 4) * [900.0, 800.0], random.uniform(-1.0, 1.0, (260, 2)) * [1100.0, 1000.0]]
    )
    relief = 25.0 * np.sin(places[:, 0] / 210.0) * np.cos(places[:, 1] / 170.0)
    points = np.column_stack([places, relief])
    image, point, xy = [], [], []
    for i in range(len(centres)):
        seen = (points - centres[i]) @ rotations[i]
        with np.errstate(all="ignore"):
            where = -F_MM * seen[:, :2] / seen[:, 2:]
        inside = np.flatnonzero((seen[:, 2] < 0.0) & (np.abs(where) < HALF_MM).all(axis=1))
        image.append(np.full(len(inside), i))
        point.append(inside)
        xy.append(where[inside] + random.normal(0.0, spread.image_mm, (len(inside), 2)))
    surveyed = points[:control] + random.normal(0.0, spread.control_m, (control, 3))
    return CalibrationFlight(
        line=np.array(which),
        time_s=np.array(time),
        centre_m=centres,
        rotation=rotations,
        points=points,
        surveyed_m=surveyed,
        control=control,
        image=np.concatenate(image),
        point=np.concatenate(point),
        xy_mm=np.concatenate(xy),
        position_m=np.array(position),
        velocity_mps=np.array(velocity),
        angles_rad=np.array(angles),
        rate_rad_per_s=np.array(rate),
        boresight_rad=boresight,
        antenna_m=antenna,
        time_offset_s=offset,
        shift_m=shift,
        spread=spread,
    )


def _pose(
    motion: tuple[CalibrationLine, Array, Array, Array, float], t_s: float
) -> tuple[Array, Array, Array]:
    """Place (east, north, up), level from body, velocity, at an instant of a line."""
    line, swing, pace, phase, aside = motion
    heading = math.radians(line.heading_deg)
    ahead = np.array([math.sin(heading), math.cos(heading), 0.0])
    right = np.array([math.cos(heading), -math.sin(heading), 0.0])
    place = ahead * line.speed_mps * t_s + right * aside + [0.0, 0.0, line.height_m]
    roll, pitch, yaw = swing * np.sin(2.0 * math.pi * pace * t_s + phase)
    return place, _level_from_body((roll, pitch, heading + yaw)), ahead * line.speed_mps


def _level_from_body(angles: Array | tuple[float, float, float]) -> Array:
    """Heading about down, then pitch about right, then roll about forward."""
    return np.asarray(Rotation.from_euler("ZYX", angles[::-1]).as_matrix())


def _angles(unit_in_level: Array) -> Array:
    return np.asarray(Rotation.from_matrix(unit_in_level).as_euler("ZYX")[::-1])


def _vector(skew: Array) -> Array:
    return np.array([skew[2, 1] - skew[1, 2], skew[0, 2] - skew[2, 0], skew[1, 0] - skew[0, 1]]) / 2


def _lattice(columns: int, rows: int) -> Array:
    x, y = np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-1, 1, rows))
    return np.stack([x.ravel(), y.ravel()], axis=1) * 0.8
