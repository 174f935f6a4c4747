"""Position, velocity and attitude at one instant, from the samples around it.

Position along a cubic through both positions and velocities, attitude by quaternion.

Source: docs/explanation/mathematics/navigation.md#position-between-two-samples; Shoemake (1985).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from daemon.mission.exposure import NavigationRecord
from daemon.orientation.geodesy import metres_per_degree
from drivers.contract import NavSample, Velocity
from drivers.receivers.attitude import (
    Quaternion,
    angles_of,
    interpolated_quaternion,
    quaternion_of,
)

NANOSECONDS = 1e9
EXTRAPOLATION_LIMIT_NS = 2_000_000_000
HISTORY_NS = 120_000_000_000
SAMPLES_TO_STEP_BACK = 3
ARRIVAL_LATENCY_MAX_NS = 700_000_000
EARLY_TOLERANCE_NS = 100_000_000
"""How long a sample may have been on its way, and how well "about when" is meant."""
CONTRADICTION_M = 1.0
CONTRADICTION_MPS2 = 2.0
CONTRADICTION_SIGMAS = 5
"""Tolerance of two positions against the velocity between them, in addition to their sigmas."""
CLIMB_RATE_MAX_MPS = 60.0
"""Faster than any aircraft that takes images climbs or sinks."""
CLIMB_SIGMA_MPS = 3.0
"""Standard deviation of a climb that the receiver does not send."""
POSITION_FIXES_WORST_FIRST = ("2d", "dead-reckoning", "3d")

Attitude = tuple[float | None, float | None, float | None]
"""Roll, pitch, heading, rad."""


class Track:
    """The samples of one receiver over the last two minutes, those with a position.

    A sample that is not newer than the last is dropped: it came late, or twice. Where the next ones
    are no newer either, but follow each other, the receiver's time has stepped back; where the way
    from one to the next is not what their velocities say, it has stepped, too. What was before
    belongs to another time then.
    """

    def __init__(self) -> None:
        self._samples: deque[NavSample] = deque()
        self._before_step: deque[NavSample] = deque()
        self._out_of_order: list[NavSample] = []

    @property
    def last(self) -> NavSample | None:
        """The newest sample, or None before the first."""
        return self._samples[-1] if self._samples else None

    def add(self, sample: NavSample) -> None:
        """Note a sample; one without a position is ignored."""
        if sample.position is None:
            return
        if self._samples and sample.gps_ns <= self._samples[-1].gps_ns:
            out_of_order = self._out_of_order
            if out_of_order and sample.gps_ns <= out_of_order[-1].gps_ns:
                out_of_order.clear()
            out_of_order.append(sample)
            if len(out_of_order) >= SAMPLES_TO_STEP_BACK:
                self._before_step, self._samples = self._samples, deque(out_of_order)
                out_of_order.clear()
            return
        self._out_of_order.clear()
        if self._samples and _contradict(self._samples[-1], sample):
            before = self._before_step
            is_outlier = len(self._samples) == 1 and before and not _contradict(before[-1], sample)
            if is_outlier and sample.gps_ns > before[-1].gps_ns:
                self._samples, self._before_step = before, deque()
            else:
                self._before_step, self._samples = self._samples, deque()
        self._samples.append(sample)
        while self._samples[-1].gps_ns - self._samples[0].gps_ns > HISTORY_NS:
            self._samples.popleft()

    def covers(self, gps_ns: int) -> bool:
        """Whether a sample at or after that instant is there, and its time not in question.

        Where a height came just before, one that has a height is waited for, two seconds at most.
        """
        if not self._samples or self._out_of_order or self._samples[-1].gps_ns < gps_ns:
            return False
        if self._samples[-1].gps_ns - gps_ns >= EXTRAPOLATION_LIMIT_NS:
            return True
        for sample in reversed(self._samples):
            if sample.gps_ns < gps_ns - EXTRAPOLATION_LIMIT_NS:
                break
            if sample.height_m is not None:
                return sample.gps_ns >= gps_ns
        return True

    def at(self, gps_ns: int, mono_ns: int | None = None) -> NavigationRecord | None:
        """Navigation at an instant; None where no sample is within two seconds.

        `mono_ns` is about when that was on the host's clock: it distinguishes two times
        where the receiver's has stepped. Samples whose way here would have taken longer than any
        does, or less than nothing, are of another time. Close to a step they cannot be
        distinguished.
        """
        samples = self._samples
        if self._before_step and samples and mono_ns is not None:
            if mono_ns < self._before_step[-1].mono_ns - ARRIVAL_LATENCY_MAX_NS:
                samples = self._before_step
            elif mono_ns < samples[0].mono_ns:
                return None
        return navigation_at([s for s in samples if _matches_host_time(s, gps_ns, mono_ns)], gps_ns)


def navigation_at(samples: Iterable[NavSample], gps_ns: int) -> NavigationRecord | None:
    """Navigation at an instant from the best of the samples near it; None without any.

    Samples with a height are preferred to those without: two of them around the instant, then any
    two, then the nearest one. Samples further than two seconds apart, or away, are not used. A
    height that the chosen ones do not have is carried on from the nearest sample with one.

    Args:
        samples: in any order; those without a position are left out.
        gps_ns: the instant.
    """
    usable = [s for s in samples if s.position is not None]
    full = [s for s in usable if s.height_m is not None]
    nearest = _nearest(full, gps_ns)
    chosen = _bracketing(full, gps_ns) or _bracketing(usable, gps_ns)
    if chosen is None:
        single = nearest or _nearest(usable, gps_ns)
        return None if single is None else _extrapolated(single, gps_ns)
    record = _interpolated(*chosen, gps_ns)
    if record.height_m is not None or nearest is None:
        return record
    above = _extrapolated(nearest, gps_ns)
    return replace(
        record,
        height_m=above.height_m,
        vertical_sigma_m=above.vertical_sigma_m,
        gap_ns=max(record.gap_ns, above.gap_ns),
    )


def _bracketing(samples: Sequence[NavSample], gps_ns: int) -> tuple[NavSample, NavSample] | None:
    """The last one before and the first one after an instant, two seconds apart at most."""
    before = max((s for s in samples if s.gps_ns <= gps_ns), key=_instant, default=None)
    after = min((s for s in samples if s.gps_ns > gps_ns), key=_instant, default=None)
    if before is None or after is None or after.gps_ns - before.gps_ns > EXTRAPOLATION_LIMIT_NS:
        return None
    return before, after


def _nearest(samples: Sequence[NavSample], gps_ns: int) -> NavSample | None:
    """The nearest one to an instant, two seconds away at most."""
    found = min(samples, key=lambda sample: abs(sample.gps_ns - gps_ns), default=None)
    is_far = found is None or abs(found.gps_ns - gps_ns) > EXTRAPOLATION_LIMIT_NS
    return None if is_far else found


def _matches_host_time(sample: NavSample, gps_ns: int, mono_ns: int | None) -> bool:
    """Whether a sample and an instant are of one time, by when they were on the host's clock."""
    if abs(sample.gps_ns - gps_ns) > 2 * EXTRAPOLATION_LIMIT_NS:
        return False
    if mono_ns is None:
        return True
    latency_ns = (sample.mono_ns - mono_ns) - (sample.gps_ns - gps_ns)
    return -EARLY_TOLERANCE_NS <= latency_ns <= ARRIVAL_LATENCY_MAX_NS + EARLY_TOLERANCE_NS


def _contradict(a: NavSample, b: NavSample) -> bool:
    """Whether the way from one sample to the other is not what their velocities say.

    False after a longer gap, and where velocities did not come: that cannot be known. Without a
    velocity down, only a height that changes faster than aircraft do contradicts.
    """
    if b.gps_ns - a.gps_ns > EXTRAPOLATION_LIMIT_NS:
        return False
    return _contradict_in_position(a, b) or _contradict_in_height(a, b)


def _contradict_in_height(a: NavSample, b: NavSample) -> bool:
    if a.height_m is None or b.height_m is None:
        return False
    span_s = (b.gps_ns - a.gps_ns) / NANOSECONDS
    sigma_m = math.hypot(a.vertical_sigma_m or 0.0, b.vertical_sigma_m or 0.0)
    down_a, down_b = _down_mps(a), _down_mps(b)
    climbed_m, fastest_mps = 0.0, CLIMB_RATE_MAX_MPS
    if down_a is not None and down_b is not None:
        climbed_m, fastest_mps = -(down_a + down_b) / 2 * span_s, 0.0
        speeds = (a.speed_sigma_mps or 0.0, b.speed_sigma_mps or 0.0)
        sigma_m = math.hypot(sigma_m, *(speed * span_s for speed in speeds))
    allowed_m = CONTRADICTION_M + CONTRADICTION_MPS2 * span_s**2 + fastest_mps * span_s
    return abs(b.height_m - a.height_m - climbed_m) > allowed_m + CONTRADICTION_SIGMAS * sigma_m


def _contradict_in_position(a: NavSample, b: NavSample) -> bool:
    place_a, place_b = a.position, b.position
    va, vb = a.velocity_ned_mps, b.velocity_ned_mps
    if place_a is None or place_b is None or va is None or vb is None:
        return False
    span_s = (b.gps_ns - a.gps_ns) / NANOSECONDS
    displacement = _displacement_m(place_a, place_b, a.height_m)
    flown = [(one + other) / 2 * span_s for one, other in zip(va[:2], vb[:2], strict=True)]
    sigma_m = math.hypot(
        a.horizontal_sigma_m or 0.0,
        b.horizontal_sigma_m or 0.0,
        (a.speed_sigma_mps or 0.0) * span_s,
        (b.speed_sigma_mps or 0.0) * span_s,
    )
    allowed_m = CONTRADICTION_M + CONTRADICTION_MPS2 * span_s**2 + CONTRADICTION_SIGMAS * sigma_m
    return math.dist(displacement, flown) > allowed_m


def _interpolated(a: NavSample, b: NavSample, gps_ns: int) -> NavigationRecord:
    assert a.position is not None and b.position is not None
    leg = _Segment((b.gps_ns - a.gps_ns) / NANOSECONDS, (gps_ns - a.gps_ns) / (b.gps_ns - a.gps_ns))
    speeds = (a.speed_sigma_mps, b.speed_sigma_mps)
    va, vb = a.velocity_ned_mps, b.velocity_ned_mps
    offset_m, sigmas_m = [], []
    for axis, displacement_m in enumerate(_displacement_m(a.position, b.position, a.height_m)):
        ends = None if va is None or vb is None else (va[:2][axis], vb[:2][axis])
        sigmas = (a.horizontal_sigma_m, b.horizontal_sigma_m)
        axis_m, sigma_m = leg.carry(displacement_m, ends, sigmas, speeds)
        offset_m.append(axis_m)
        sigmas_m.append(sigma_m)
    height_m = vertical_sigma_m = None
    if a.height_m is not None and b.height_m is not None:
        down_a, down_b = _down_mps(a), _down_mps(b)
        climbs = None if down_a is None or down_b is None else (-down_a, -down_b)
        sigmas = (a.vertical_sigma_m, b.vertical_sigma_m)
        climbed_m, vertical_sigma_m = leg.carry(b.height_m - a.height_m, climbs, sigmas, speeds)
        height_m = a.height_m + climbed_m
    record = _record(
        (a, b) if leg.share < 0.5 else (b, a),
        gps_ns,
        _offset_position(a, (offset_m[0], offset_m[1])),
        (height_m, vertical_sigma_m),
        _largest_sigma(sigmas_m),
        _attitude_between(a, b, leg.share),
    )
    return replace(
        record,
        method="interpolated",
        gap_ns=b.gps_ns - a.gps_ns,
        velocity_ned_mps=_velocity_between(va, vb, leg.share),
        speed_sigma_mps=_largest_sigma(speeds),
    )


@dataclass(frozen=True)
class _Segment:
    """The way from one sample to the next: how long it takes, and which share has passed."""

    span_s: float
    share: float

    def carry(
        self,
        displacement_m: float,
        speeds_mps: tuple[float, float] | None,
        sigmas_m: tuple[float | None, float | None],
        speed_sigmas_mps: tuple[float | None, float | None],
    ) -> tuple[float, float | None]:
        """How far along one axis the share is, and its sigma: at least the larger of both ends.

        Ends that contradict the way between them by the speeds are adjusted by least squares: the
        one with the smaller sigma moves less. Without speeds the way is straight.

        Args:
            displacement_m: from the first position to the second.
            speeds_mps: at both ends; None where one is not known.
            sigmas_m: of both positions; where one is None the result has none.
            speed_sigmas_mps: of both speeds.
        """
        u, span_s = self.share, self.span_s
        sigma_m, speed_sigma = _largest_sigma(sigmas_m), _largest_sigma(speed_sigmas_mps)
        manoeuvre_m = CONTRADICTION_MPS2 * span_s**2 * u * (1 - u) / 2
        if speeds_mps is None:
            return u * displacement_m, None if sigma_m is None else math.hypot(sigma_m, manoeuvre_m)
        start_m, end_m = 0.0, displacement_m
        if sigma_m is not None and speed_sigma is not None:
            first, last = (sigma or 0.0 for sigma in sigmas_m)
            flown = (speed_sigma * span_s) ** 2 / 2 + (CONTRADICTION_MPS2 * span_s**2 / 8) ** 2
            misfit_m = displacement_m - sum(speeds_mps) / 2 * span_s
            gain = misfit_m / (first**2 + last**2 + flown) if flown else 0.0
            start_m, end_m = gain * first**2, displacement_m - gain * last**2
        # Cubic Hermite: passes through both positions with both velocities.
        weights = (u**3 - 2 * u**2 + u, u**3 - u**2)
        offset_m = (
            (2 * u**3 - 3 * u**2 + 1) * start_m
            + weights[0] * span_s * speeds_mps[0]
            + (-2 * u**3 + 3 * u**2) * end_m
            + weights[1] * span_s * speeds_mps[1]
        )
        if sigma_m is None or speed_sigma is None:
            return offset_m, None if sigma_m is None else math.hypot(sigma_m, manoeuvre_m)
        by_speeds_m = speed_sigma * span_s * math.hypot(*weights)
        return offset_m, math.hypot(sigma_m, by_speeds_m, manoeuvre_m * u * (1 - u))


def _extrapolated(sample: NavSample, gps_ns: int) -> NavigationRecord:
    """Carried on by the sample's velocity; the sigmas grow with the way."""
    elapsed_s = (gps_ns - sample.gps_ns) / NANOSECONDS
    velocity, speed_sigma = sample.velocity_ned_mps, sample.speed_sigma_mps
    manoeuvre_m = CONTRADICTION_MPS2 * elapsed_s**2 / 2
    horizontal_m, vertical_m = sample.horizontal_sigma_m, sample.vertical_sigma_m
    offset_m, height_m = (0.0, 0.0), sample.height_m
    if velocity is not None:
        offset_m = (velocity[0] * elapsed_s, velocity[1] * elapsed_s)
    if elapsed_s:
        if velocity is None or speed_sigma is None or horizontal_m is None:
            horizontal_m = None
        else:
            horizontal_m = math.hypot(horizontal_m, speed_sigma * elapsed_s, manoeuvre_m)
        down = _down_mps(sample)
        climb_sigma = CLIMB_SIGMA_MPS if down is None or speed_sigma is None else speed_sigma
        if height_m is not None:
            height_m -= (down or 0.0) * elapsed_s
        if vertical_m is not None:
            vertical_m = math.hypot(vertical_m, climb_sigma * elapsed_s, manoeuvre_m)
    record = _record(
        (sample, sample),
        gps_ns,
        _offset_position(sample, offset_m),
        (height_m, vertical_m),
        horizontal_m,
        (sample.roll_rad, sample.pitch_rad, sample.heading_rad),
    )
    return record if velocity is not None else replace(record, method="nearest")


def _record(
    supports: tuple[NavSample, NavSample],
    gps_ns: int,
    place_deg: tuple[float, float],
    height: tuple[float | None, float | None],
    horizontal_sigma_m: float | None,
    attitude: Attitude,
) -> NavigationRecord:
    """A record that is as good as the worse of its supports, the nearer of which comes first."""
    nearest, _ = supports
    satellites = [s.satellites for s in supports if s.satellites is not None]
    sources = {s.sigma_source for s in supports}
    source = next((name for name in ("none", "dop") if name in sources), nearest.sigma_source)
    return NavigationRecord(
        receiver=nearest.receiver,
        gps_ns=gps_ns,
        method="extrapolated",
        gap_ns=abs(gps_ns - nearest.gps_ns),
        fix=min((s.fix for s in supports), key=POSITION_FIXES_WORST_FIRST.index),
        satellites=min(satellites, default=None),
        latitude_deg=place_deg[0],
        longitude_deg=place_deg[1],
        height_m=height[0],
        horizontal_sigma_m=horizontal_sigma_m,
        vertical_sigma_m=height[1],
        velocity_ned_mps=nearest.velocity_ned_mps,
        speed_sigma_mps=nearest.speed_sigma_mps,
        roll_rad=attitude[0],
        pitch_rad=attitude[1],
        heading_rad=attitude[2],
        leap_seconds=nearest.leap_seconds,
        sigma_source="none" if horizontal_sigma_m is None else source,
        leap_source="table" if "table" in {s.leap_source for s in supports} else "receiver",
    )


def _displacement_m(
    a: tuple[float, float], b: tuple[float, float], height_m: float | None
) -> tuple[float, float]:
    """North and east from one place to another; a height that is not known shifts it by 1e-3."""
    north_m, east_m = metres_per_degree(a[0], height_m or 0.0)
    return (b[0] - a[0]) * north_m, math.remainder(b[1] - a[1], 360.0) * east_m


def _offset_position(sample: NavSample, displacement_m: tuple[float, float]) -> tuple[float, float]:
    """Latitude and longitude so far north and east of a sample."""
    assert sample.position is not None
    north_m, east_m = metres_per_degree(sample.position[0], sample.height_m or 0.0)
    return sample.position[0] + displacement_m[0] / north_m, sample.position[1] + displacement_m[
        1
    ] / east_m


def _largest_sigma(sigmas: Sequence[float | None]) -> float | None:
    """The largest; None where one is not known."""
    known = [sigma for sigma in sigmas if sigma is not None]
    return max(known) if len(known) == len(sigmas) else None


def _down_mps(sample: NavSample) -> float | None:
    return None if sample.velocity_ned_mps is None else sample.velocity_ned_mps[2]


def _instant(sample: NavSample) -> int:
    return sample.gps_ns


def _velocity_between(a: Velocity | None, b: Velocity | None, u: float) -> Velocity | None:
    if a is None or b is None:
        return None
    down = None if a[2] is None or b[2] is None else a[2] + u * (b[2] - a[2])
    return a[0] + u * (b[0] - a[0]), a[1] + u * (b[1] - a[1]), down


def _attitude_between(a: NavSample, b: NavSample, u: float) -> Attitude:
    qa, qb = _quaternion(a), _quaternion(b)
    if qa is None or qb is None:
        return (
            _angle_between(a.roll_rad, b.roll_rad, u),
            _angle_between(a.pitch_rad, b.pitch_rad, u),
            _angle_between(a.heading_rad, b.heading_rad, u),
        )
    return angles_of(interpolated_quaternion(qa, qb, u))


def _angle_between(a: float | None, b: float | None, u: float) -> float | None:
    """A single angle, where not all three are known at both ends; None where it is not."""
    if a is None or b is None:
        return None
    return (a + u * math.remainder(b - a, math.tau)) % math.tau


def _quaternion(sample: NavSample) -> Quaternion | None:
    if sample.roll_rad is None or sample.pitch_rad is None or sample.heading_rad is None:
        return None
    return quaternion_of(sample.roll_rad, sample.pitch_rad, sample.heading_rad)
