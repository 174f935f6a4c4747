"""Position, velocity and attitude at one instant, from the samples around it.

Position along a cubic through both positions and velocities, attitude by quaternion.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from daemon.exposure import NavigationRecord
from drivers.contract import NavSample

NANOSECONDS = 1e9
WGS84_A_M = 6_378_137.0
WGS84_E2 = 6.694379990141e-3
EXTRAPOLATION_LIMIT_NS = 2_000_000_000
MEMORY_NS = 120_000_000_000


class Track:
    """The samples of one receiver over the last two minutes."""

    def __init__(self) -> None:
        self._samples: deque[NavSample] = deque()

    @property
    def last(self) -> NavSample | None:
        """The newest sample, or None before the first."""
        return self._samples[-1] if self._samples else None

    def add(self, sample: NavSample) -> None:
        """Note a sample; one that is not newer than the last is dropped."""
        if self._samples and sample.gps_ns <= self._samples[-1].gps_ns:
            return
        self._samples.append(sample)
        while self._samples[-1].gps_ns - self._samples[0].gps_ns > MEMORY_NS:
            self._samples.popleft()

    def reaches(self, gps_ns: int) -> bool:
        """Whether a sample at or after that instant is there."""
        return bool(self._samples) and self._samples[-1].gps_ns >= gps_ns

    def at(self, gps_ns: int) -> NavigationRecord | None:
        """Navigation at an instant; None where no sample is within two seconds."""
        before = next((s for s in reversed(self._samples) if s.gps_ns <= gps_ns), None)
        after = next((s for s in self._samples if s.gps_ns > gps_ns), None)
        return between(before, after, gps_ns)


def between(
    before: NavSample | None, after: NavSample | None, gps_ns: int
) -> NavigationRecord | None:
    """Navigation at an instant from the samples around it; None if none is within two seconds."""
    if before is not None and after is not None:
        gap_ns = after.gps_ns - before.gps_ns
        if gap_ns <= EXTRAPOLATION_LIMIT_NS:
            return _interpolated(before, after, gps_ns)
    near = [sample for sample in (before, after) if sample is not None]
    nearest = min(near, key=lambda sample: abs(sample.gps_ns - gps_ns), default=None)
    if nearest is None or abs(nearest.gps_ns - gps_ns) > EXTRAPOLATION_LIMIT_NS:
        return None
    return _extrapolated(nearest, gps_ns)


def metres_per_degree(latitude_deg: float, height_m: float) -> tuple[float, float]:
    """Length of one degree of latitude and of longitude at a place, metres (WGS 84)."""
    sine = math.sin(math.radians(latitude_deg))
    w2 = 1.0 - WGS84_E2 * sine * sine
    meridian = WGS84_A_M * (1.0 - WGS84_E2) / w2**1.5 + height_m
    normal = WGS84_A_M / math.sqrt(w2) + height_m
    parallel = normal * math.cos(math.radians(latitude_deg))
    return math.radians(meridian), math.radians(parallel)


def _interpolated(a: NavSample, b: NavSample, gps_ns: int) -> NavigationRecord:
    span_s = (b.gps_ns - a.gps_ns) / NANOSECONDS
    u = (gps_ns - a.gps_ns) / (b.gps_ns - a.gps_ns)
    north_m, east_m = metres_per_degree(a.latitude_deg, a.height_m)
    start = np.zeros(3)
    end = np.array(
        [
            (b.latitude_deg - a.latitude_deg) * north_m,
            (b.longitude_deg - a.longitude_deg) * east_m,
            -(b.height_m - a.height_m),
        ]
    )
    va, vb = np.array(a.velocity_ned_mps), np.array(b.velocity_ned_mps)
    # Cubic Hermite: passes through both positions with both velocities.
    ned = (
        (2 * u**3 - 3 * u**2 + 1) * start
        + (u**3 - 2 * u**2 + u) * span_s * va
        + (-2 * u**3 + 3 * u**2) * end
        + (u**3 - u**2) * span_s * vb
    )
    velocity = va + u * (vb - va)
    attitude = _attitude_between(a, b, u)
    quality = a if u < 0.5 else b
    record = _record(quality, a, gps_ns, ned, velocity, attitude)
    return replace(record, method="interpolated", gap_ns=b.gps_ns - a.gps_ns)


def _extrapolated(sample: NavSample, gps_ns: int) -> NavigationRecord:
    away_s = (gps_ns - sample.gps_ns) / NANOSECONDS
    velocity = np.array(sample.velocity_ned_mps)
    attitude = (sample.roll_rad, sample.pitch_rad, sample.heading_rad)
    return _record(sample, sample, gps_ns, velocity * away_s, velocity, attitude)


def _record(
    quality: NavSample,
    origin: NavSample,
    gps_ns: int,
    ned_m: NDArray[np.float64],
    velocity: NDArray[np.float64],
    attitude: tuple[float | None, float | None, float | None],
) -> NavigationRecord:
    north_m, east_m = metres_per_degree(origin.latitude_deg, origin.height_m)
    return NavigationRecord(
        receiver=quality.receiver,
        gps_ns=gps_ns,
        method="extrapolated",
        gap_ns=abs(gps_ns - origin.gps_ns),
        fix=quality.fix,
        satellites=quality.satellites,
        latitude_deg=origin.latitude_deg + float(ned_m[0]) / north_m,
        longitude_deg=origin.longitude_deg + float(ned_m[1]) / east_m,
        height_m=origin.height_m - float(ned_m[2]),
        horizontal_sigma_m=quality.horizontal_sigma_m,
        vertical_sigma_m=quality.vertical_sigma_m,
        velocity_ned_mps=(float(velocity[0]), float(velocity[1]), float(velocity[2])),
        speed_sigma_mps=quality.speed_sigma_mps,
        roll_rad=attitude[0],
        pitch_rad=attitude[1],
        heading_rad=attitude[2],
        leap_seconds=quality.leap_seconds,
    )


def _attitude_between(
    a: NavSample, b: NavSample, u: float
) -> tuple[float | None, float | None, float | None]:
    qa, qb = _quaternion(a), _quaternion(b)
    if qa is None or qb is None:
        return (a.roll_rad, a.pitch_rad, a.heading_rad)
    dot = float(qa @ qb)
    qb = qb if dot >= 0 else -qb
    angle = math.acos(min(1.0, abs(dot)))
    if angle < 1e-9:
        q = qa
    else:
        q = (math.sin((1 - u) * angle) * qa + math.sin(u * angle) * qb) / math.sin(angle)
    w, x, y, z = (float(v) for v in q)
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    heading = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) % (2 * math.pi)
    return (roll, pitch, heading)


def _quaternion(sample: NavSample) -> NDArray[np.float64] | None:
    """Local level from body, from roll, pitch, heading (yaw-pitch-roll order)."""
    if sample.roll_rad is None or sample.pitch_rad is None or sample.heading_rad is None:
        return None
    cr, sr = math.cos(sample.roll_rad / 2), math.sin(sample.roll_rad / 2)
    cp, sp = math.cos(sample.pitch_rad / 2), math.sin(sample.pitch_rad / 2)
    ch, sh = math.cos(sample.heading_rad / 2), math.sin(sample.heading_rad / 2)
    return np.array(
        [
            cr * cp * ch + sr * sp * sh,
            sr * cp * ch - cr * sp * sh,
            cr * sp * ch + sr * cp * sh,
            cr * cp * sh - sr * sp * ch,
        ]
    )
