"""Position and attitude of the emulated aircraft: lines, turns, wind, mount vibration.

A pure function of time, from a plan and a seed. The images are computed in
`rendering`; the trigger times are in `simulator`.

Local system: east, north, up in metres, tangent to the ellipsoid at the plan's origin, up = 0 at
the mean height of the terrain. Body axes x forward, y right, z down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sim_hw.world.ellipsoid import ecef_from_enu_rotation, geodetic_from_enu
from sim_hw.world.seeding import random_stream

Matrix = NDArray[np.float64]

ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])

GRAVITY_MPS2 = 9.80665
TURN_BANK_DEG = 20.0
BANK_RAMP_S = 6.0


@dataclass(frozen=True)
class FlightPlan:
    """What is to be flown. Angles in degrees, as a crew would write them.

    `heading_deg` is the track over ground of the first line. The wind blows across the line from
    the left; the mount turns the camera back by `drift_correction` of the crab (1: all of it).
    `attitude_rms_deg` and `rate_rms_dps` hold per axis, after stabilisation.
    """

    height_m: float
    ground_speed_mps: float
    line_length_m: float
    line_spacing_m: float
    heading_deg: float = 0.0
    latitude_deg: float = 47.07
    longitude_deg: float = 15.43
    ground_height_m: float = 395.0
    wind_across_mps: float = 4.0
    drift_correction: float = 0.8
    attitude_rms_deg: float = 0.2
    rate_rms_dps: float = 0.3
    track_deviation_rms_m: float = 1.2


@dataclass(frozen=True)
class Pose:
    """Position and attitude of the body at one instant.

    `enu_from_body` is the rotation (3, 3); roll, pitch, heading are its angles against the tangent
    plane at the origin, heading from north, clockwise. `Flight.attitude_rad` is against the level
    at the aircraft.
    """

    position_enu_m: Matrix
    velocity_enu_mps: Matrix
    roll_rad: float
    pitch_rad: float
    heading_rad: float
    enu_from_body: Matrix


@dataclass(frozen=True)
class RandomMotion:
    """A smooth random motion as a sum of sinusoids; its rates are known exactly."""

    amplitude: Matrix
    omega: Matrix
    phase: Matrix

    def value(self, t_s: float) -> float:
        return float(np.sum(self.amplitude * np.sin(self.omega * t_s + self.phase)))

    def rate(self, t_s: float) -> float:
        return float(np.sum(self.amplitude * self.omega * np.cos(self.omega * t_s + self.phase)))

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.sum(self.amplitude**2) / 2))

    @property
    def rate_rms(self) -> float:
        return float(np.sqrt(np.sum((self.amplitude * self.omega) ** 2) / 2))


@dataclass(frozen=True)
class SimulatedFlight:
    """A plan flown in one certain way.

    `epoch_gps_ns` is when the aircraft passes the origin. The first line begins
    `first_line_at_m` metres behind it and the straight before is as long as one likes: the
    simulator lets the line begin at the first exposure, whenever that comes.
    """

    plan: FlightPlan
    seed: int
    epoch_gps_ns: int
    first_line_at_m: float = 0.0
    _motion: dict[str, RandomMotion] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        plan = self.plan
        motion = {
            name: random_attitude_motion(
                random_stream(self.seed, "attitude", name),
                rms=math.radians(plan.attitude_rms_deg),
                rate_rms=math.radians(plan.rate_rms_dps),
            )
            for name in ("roll", "pitch", "heading")
        }
        for name in ("east", "north", "up"):
            motion[name] = random_track_deviation(
                random_stream(self.seed, "wander", name), rms=plan.track_deviation_rms_m
            )
        object.__setattr__(self, "_motion", motion)

    def beginning_first_line_at(self, distance_m: float) -> SimulatedFlight:
        """The same flight, its first line begun at that distance flown."""
        return replace(self, first_line_at_m=distance_m)

    def distance_flown_m(self, gps_ns: int) -> float:
        """Way along the planned path since the epoch."""
        return self.plan.ground_speed_mps * (gps_ns - self.epoch_gps_ns) * 1e-9

    def pose(self, gps_ns: int) -> Pose:
        """Position, velocity and attitude at an instant."""
        plan = self.plan
        t_s = (gps_ns - self.epoch_gps_ns) * 1e-9
        right, along, course, bank = path_point(
            plan, self.distance_flown_m(gps_ns) - self.first_line_at_m
        )
        along += self.first_line_at_m
        line = math.radians(plan.heading_deg)
        track = line + course
        motion = self._motion
        position = np.array(
            [
                right * math.cos(line) + along * math.sin(line) + motion["east"].value(t_s),
                -right * math.sin(line) + along * math.cos(line) + motion["north"].value(t_s),
                plan.height_m + motion["up"].value(t_s),
            ]
        )
        velocity = np.array(
            [
                plan.ground_speed_mps * math.sin(track) + motion["east"].rate(t_s),
                plan.ground_speed_mps * math.cos(track) + motion["north"].rate(t_s),
                motion["up"].rate(t_s),
            ]
        )
        # The wind comes from the left of the first line, so from the right on the way back.
        across = plan.wind_across_mps * math.cos(course)
        crab = -math.atan2(across, plan.ground_speed_mps) * (1.0 - plan.drift_correction)
        roll = bank + motion["roll"].value(t_s)
        pitch = motion["pitch"].value(t_s)
        heading = track + crab + motion["heading"].value(t_s)
        return Pose(
            position_enu_m=position,
            velocity_enu_mps=velocity,
            roll_rad=roll,
            pitch_rad=pitch,
            heading_rad=heading % (2 * math.pi),
            enu_from_body=enu_from_body(roll, pitch, heading),
        )

    def geodetic(self, position_enu_m: Matrix) -> tuple[float, float, float]:
        """Latitude and longitude in degrees, ellipsoidal height in m, of a local position."""
        plan = self.plan
        return geodetic_from_enu(
            position_enu_m, plan.latitude_deg, plan.longitude_deg, plan.ground_height_m
        )

    def velocity_ned_mps(self, pose: Pose) -> tuple[float, float, float]:
        """Velocity north, east, down at the aircraft."""
        east, north, up = self._local_from_enu(pose) @ pose.velocity_enu_mps
        return float(north), float(east), float(-up)

    def attitude_rad(self, pose: Pose) -> tuple[float, float, float]:
        """Roll, pitch and heading against the local level at the aircraft, as an IMU has them."""
        ned_from_body = ENU_FROM_NED.T @ self._local_from_enu(pose) @ pose.enu_from_body
        heading, pitch, roll = Rotation.from_matrix(ned_from_body).as_euler("ZYX")
        return float(roll), float(pitch), float(heading % math.tau)

    def _local_from_enu(self, pose: Pose) -> Matrix:
        """East, north, up at the aircraft from those at the origin.

        The two verticals differ by 9 arc seconds per 280 m.
        """
        latitude, longitude, _ = self.geodetic(pose.position_enu_m)
        ecef = ecef_from_enu_rotation(self.plan.latitude_deg, self.plan.longitude_deg)
        return np.asarray(ecef_from_enu_rotation(latitude, longitude).T @ ecef)


def random_attitude_motion(
    random: np.random.Generator, *, rms: float, rate_rms: float
) -> RandomMotion:
    """Residual motion of a stabilised mount with the given rms of angle and of angular rate.

    Slow terms (0.02 to 0.1 Hz) carry the angle, fast ones (0.3 to 1.5 Hz) the rate.
    """
    slow = 2 * math.pi * np.geomspace(0.02, 0.1, 5) * random.uniform(0.9, 1.1, 5)
    fast = 2 * math.pi * np.geomspace(0.3, 1.5, 8) * random.uniform(0.95, 1.05, 8)
    slow_amplitude = rms * math.sqrt(2 / 5) * np.ones(5)
    slow_rate_variance = float(np.sum((slow_amplitude * slow) ** 2) / 2)
    fast_rate = math.sqrt(max(rate_rms**2 - slow_rate_variance, 0.0))
    fast_amplitude = fast_rate * math.sqrt(2 / 8) / fast
    left_for_slow = max(rms**2 - float(np.sum(fast_amplitude**2) / 2), 0.0)
    slow_amplitude *= math.sqrt(left_for_slow) / rms if rms > 0 else 0.0
    omega = np.concatenate([slow, fast])
    return RandomMotion(
        amplitude=np.concatenate([slow_amplitude, fast_amplitude]),
        omega=omega,
        phase=random.uniform(0, 2 * math.pi, omega.size),
    )


def random_track_deviation(random: np.random.Generator, *, rms: float) -> RandomMotion:
    """Slow deviation from the planned path, periods of 20 to 90 s."""
    omega = 2 * math.pi / np.geomspace(20.0, 90.0, 5) * random.uniform(0.9, 1.1, 5)
    return RandomMotion(
        amplitude=rms * math.sqrt(2 / 5) * np.ones(5),
        omega=omega,
        phase=random.uniform(0, 2 * math.pi, 5),
    )


def path_point(plan: FlightPlan, distance_m: float) -> tuple[float, float, float, float]:
    """The planned path: lines joined by turns.

    Returns:
        (right, along, course, bank): metres from the beginning of the first line, course in
        radians against it, clockwise, and bank in radians.
    """
    length = plan.line_length_m
    if distance_m < length:
        return 0.0, distance_m, 0.0, 0.0
    radius = plan.ground_speed_mps**2 / (GRAVITY_MPS2 * math.tan(math.radians(TURN_BANK_DEG)))
    spacing = plan.line_spacing_m
    # Turn away first and back further, so that a narrow spacing needs no steep bank: 2 r cos = d.
    away = math.acos(spacing / (2 * radius)) if spacing < 2 * radius else 0.0
    radius = max(radius, spacing / 2)
    overshoot = 2 * radius * math.sin(away)
    turn_length_m = radius * (math.pi + 2 * away)
    period = turn_length_m + length + overshoot
    turn_index = int((distance_m - length) // period)
    rest = (distance_m - length) - turn_index * period
    if rest < turn_length_m:
        right, along, course, bank = _turn_point(plan, radius, away, rest)
    else:
        right, along, course, bank = (
            spacing,
            overshoot - (rest - turn_length_m),
            math.pi,
            0.0,
        )
    right += turn_index * spacing
    if turn_index % 2 == 0:
        return right, length + along, course, bank
    return right, -along, math.pi - course, -bank


def _turn_point(
    plan: FlightPlan, radius: float, away: float, s: float
) -> tuple[float, float, float, float]:
    """Left by `away`, then right by 180 deg and `away`; from the end of a line, to the right."""
    steep = math.atan(plan.ground_speed_mps**2 / (GRAVITY_MPS2 * radius))
    ramp = plan.ground_speed_mps * BANK_RAMP_S
    first = radius * away
    if s < first:
        angle = s / radius
        bank = -steep * _ramp(s, first, ramp)
        return radius * (math.cos(angle) - 1), radius * math.sin(angle), -angle, bank
    centre_right = radius * (2 * math.cos(away) - 1)
    centre_along = 2 * radius * math.sin(away)
    course = (s - first) / radius - away
    bank = steep * _ramp(s - first, radius * (math.pi + away), ramp)
    return (
        centre_right - radius * math.cos(course),
        centre_along + radius * math.sin(course),
        course,
        bank,
    )


def _ramp(s: float, length: float, ramp: float) -> float:
    """Smooth from zero to one and back over an arc."""
    ramp = min(ramp, length / 2)
    if ramp <= 0:
        return 0.0
    x = min(1.0, s / ramp, (length - s) / ramp)
    return x * x * (3 - 2 * x)


def enu_from_body(roll_rad: float, pitch_rad: float, heading_rad: float) -> Matrix:
    """Rotation from body (forward, right, down) to east, north, up."""
    ned_from_body = Rotation.from_euler("ZYX", [heading_rad, pitch_rad, roll_rad]).as_matrix()
    return np.asarray(ENU_FROM_NED @ ned_from_body)
