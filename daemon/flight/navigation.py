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
SAMPLES_TO_STEP_BACK = 3
LATEST_ARRIVAL_NS = 700_000_000
BEFORE_NS = 100_000_000
"""How long a sample may have been on its way, and how well "about when" is meant."""
CONTRADICTION_M = 1.0
CONTRADICTION_MPS2 = 2.0
CONTRADICTION_SIGMAS = 5
"""How far two positions may disagree with the way between them, beside their sigmas."""


class Track:
    """The samples of one receiver over the last two minutes.

    A sample that is not newer than the last is dropped: it came late, or twice. Where the next ones
    are no newer either, but follow each other, the receiver's time has stepped back; where the way
    from one to the next is not what their velocities say, it has stepped, too. What was before
    belongs to another time then.
    """

    def __init__(self) -> None:
        self._samples: deque[NavSample] = deque()
        self._before_step: deque[NavSample] = deque()
        self._from_the_past: list[NavSample] = []

    @property
    def last(self) -> NavSample | None:
        """The newest sample, or None before the first."""
        return self._samples[-1] if self._samples else None

    def add(self, sample: NavSample) -> None:
        """Note a sample."""
        if self._samples and sample.gps_ns <= self._samples[-1].gps_ns:
            past = self._from_the_past
            if past and sample.gps_ns <= past[-1].gps_ns:
                past.clear()
            past.append(sample)
            if len(past) >= SAMPLES_TO_STEP_BACK:
                self._before_step, self._samples = self._samples, deque(past)
                past.clear()
            return
        self._from_the_past.clear()
        if self._samples and _contradict(self._samples[-1], sample):
            before = self._before_step
            is_outlier = len(self._samples) == 1 and before and not _contradict(before[-1], sample)
            if is_outlier and sample.gps_ns > before[-1].gps_ns:
                self._samples, self._before_step = before, deque()
            else:
                self._before_step, self._samples = self._samples, deque()
        self._samples.append(sample)
        while self._samples[-1].gps_ns - self._samples[0].gps_ns > MEMORY_NS:
            self._samples.popleft()

    def reaches(self, gps_ns: int) -> bool:
        """Whether a sample at or after that instant is there, and its time not in question."""
        known = bool(self._samples) and not self._from_the_past
        return known and self._samples[-1].gps_ns >= gps_ns

    def at(self, gps_ns: int, mono_ns: int | None = None) -> NavigationRecord | None:
        """Navigation at an instant; None where no sample is within two seconds.

        `mono_ns` is about when that was on the host's clock: it tells which of two times is meant
        where the receiver's has stepped. Samples whose way here would have taken longer than any
        does, or less than nothing, are of another time. Close to a step there is no telling.
        """
        samples = self._samples
        if self._before_step and samples and mono_ns is not None:
            if mono_ns < self._before_step[-1].mono_ns - LATEST_ARRIVAL_NS:
                samples = self._before_step
            elif mono_ns < samples[0].mono_ns:
                return None
        timely = [s for s in samples if _is_timely(s, gps_ns, mono_ns)]
        before = next((s for s in reversed(timely) if s.gps_ns <= gps_ns), None)
        after = next((s for s in timely if s.gps_ns > gps_ns), None)
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


def _is_timely(sample: NavSample, gps_ns: int, mono_ns: int | None) -> bool:
    """Whether a sample and an instant are of one time, by when they were on the host's clock."""
    if abs(sample.gps_ns - gps_ns) > 2 * EXTRAPOLATION_LIMIT_NS:
        return False
    if mono_ns is None:
        return True
    way_ns = (sample.mono_ns - mono_ns) - (sample.gps_ns - gps_ns)
    return -BEFORE_NS <= way_ns <= LATEST_ARRIVAL_NS + BEFORE_NS


def _contradict(a: NavSample, b: NavSample) -> bool:
    """Whether the way over ground from one sample to the other is not what their velocities say.

    After a longer gap there is no telling: that is False.
    """
    if b.gps_ns - a.gps_ns > EXTRAPOLATION_LIMIT_NS:
        return False
    span_s = (b.gps_ns - a.gps_ns) / NANOSECONDS
    north_m, east_m = metres_per_degree(a.latitude_deg, a.height_m)
    way = (
        (b.latitude_deg - a.latitude_deg) * north_m,
        (b.longitude_deg - a.longitude_deg) * east_m,
    )
    velocities = zip(a.velocity_ned_mps[:2], b.velocity_ned_mps[:2], strict=True)
    flown = [(va + vb) / 2 * span_s for va, vb in velocities]
    sigma_m = math.hypot(
        a.horizontal_sigma_m,
        b.horizontal_sigma_m,
        a.speed_sigma_mps * span_s,
        b.speed_sigma_mps * span_s,
    )
    allowed_m = CONTRADICTION_M + CONTRADICTION_MPS2 * span_s**2 + CONTRADICTION_SIGMAS * sigma_m
    return math.dist(way, flown) > allowed_m


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
