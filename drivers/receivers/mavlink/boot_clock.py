"""GPS time of an autopilot's own clock, which counts from its start.

SYSTEM_TIME gives UTC and the time since start, cut to the millisecond. What the difference of both
is known to is derived from how the messages scatter.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from drivers.timescales.gps_time import GPS_EPOCH_DAY, SECOND_NS
from drivers.timescales.leap_seconds import leap_seconds_at

UNIX_EPOCH_DAY: Final = 719_163
"""1970-01-01 as `datetime.date.toordinal` counts."""
GPS_EPOCH_UNIX_NS: Final = (GPS_EPOCH_DAY - UNIX_EPOCH_DAY) * 86_400 * SECOND_NS
UNIX_FROM_US: Final = 1_000_000_000_000_000
"""A later microsecond is of UTC (September 2001), an earlier one counts from the start."""
MS_NS: Final = 1_000_000
TRUNCATION_SIGMA_NS: Final = MS_NS / math.sqrt(12)
"""The time since start is cut to milliseconds, maybe at the same place every time."""
HISTORY_LENGTH: Final = 40
HISTORY_NS: Final = 120 * SECOND_NS
RATE_SIGMA: Final = 30e-6
"""By which the autopilot's clock runs off UTC."""
PRIOR_SIGMA_NS: Final = 6 * MS_NS
PRIOR_WEIGHT: Final = 3
"""How many messages the prior standard deviation of one message weighs."""
PRIOR_WEIGHT_AFTER_STEP: Final = 32
"""Likewise of what the messages before a step showed."""
STEP_FROM: Final = 16
"""So many messages say how far one of them may be off."""
CORRELATION_MAX: Final = 0.9
ROUNDS: Final = 6
RESTART_BACK_NS: Final = 1_000 * MS_NS
"""By so much less than before the time since start is that of another start; less is a message
that was overtaken."""
CERTAIN_STEP_NS: Final = SECOND_NS // 2
"""Two messages in succession that are further off have another UTC."""
# Quirk: UTC of real autopilots jitters against their own clock by milliseconds, now and then by
# tens of them, and it steps. Upstream: PX4/PX4-Autopilot#16653, PX4/PX4-Autopilot#22440.
STEPS: Final = ((3, 3, 0.95, 1.5), (8, 7, 0.75, 1.0), (12, 11, 0.6, 1.0))
"""UTC has stepped where of so many newest messages so many err to the same side by more than that
quantile of all before, times a factor: by chance that happens once in days."""

Reading = tuple[int, int]
"""Time since start, and UTC less that, ns."""


class BootClock:
    """The difference between UTC and the time since start: a robust line through what came.

    Each message errs by the jitter of the autopilot's UTC; the scatter around the line gives the
    standard deviation of one message (`utc_sigma_ns`) and of the line (`sigma_ns`). What all
    messages err by alike cannot be seen and is in neither.
    """

    def __init__(self) -> None:
        self.steps = 0
        """How often UTC stepped against the autopilot's clock, or the autopilot restarted."""
        self.last_step_ns: int | None = None
        """By how much UTC stepped the last time; None for a restart."""
        self.leap_seconds: int | None = None
        self._readings: deque[Reading] = deque(maxlen=HISTORY_LENGTH)
        self._prior = _Scatter(PRIOR_SIGMA_NS**2, PRIOR_SIGMA_NS, 1.0, PRIOR_WEIGHT)
        self._line = _Line([(0, 0)], self._prior)
        self._doubt_ns = 0.0

    def add_system_time(self, unix_us: int, boot_ms: int) -> None:
        """Add a SYSTEM_TIME; without UTC (before the first fix) it is ignored.

        Args:
            unix_us: `time_unix_usec`, UTC since 1970, us.
            boot_ms: `time_boot_ms`, time since the autopilot's start, ms.
        """
        if unix_us < UNIX_FROM_US:
            return
        # Time since start is cut to milliseconds: half of one is added on the average.
        boot_ns, unix_ns = boot_ms * MS_NS + MS_NS // 2, unix_us * 1000
        reading = boot_ns, unix_ns - boot_ns
        readings = self._readings
        if readings and boot_ns < readings[-1][0] - RESTART_BACK_NS:
            self._step([reading], None)
        else:
            readings.append(reading)
            while boot_ns - readings[0][0] > HISTORY_NS:
                readings.popleft()
            self._detect_step()
        self._line = _Line(list(readings), self._prior)
        self.leap_seconds = leap_seconds_at(unix_ns - GPS_EPOCH_UNIX_NS)

    def gps_ns(self, boot_ns: int) -> int | None:
        """GPS time of an instant of the autopilot's clock.

        Args:
            boot_ns: time since the autopilot's start, ns.

        Returns:
            Nanoseconds since the GPS epoch; None before UTC is known.
        """
        if not self._readings:
            return None
        return self.gps_of_unix_ns(boot_ns + round(self._line.at(boot_ns)))

    def gps_of_unix_ns(self, unix_ns: int) -> int:
        """GPS time of a UTC instant, with the built-in table of leap seconds.

        Args:
            unix_ns: UTC since 1970 without leap seconds, ns.

        Returns:
            Nanoseconds since the GPS epoch.
        """
        utc_ns = unix_ns - GPS_EPOCH_UNIX_NS
        return utc_ns + leap_seconds_at(utc_ns) * SECOND_NS

    def gps_of_us(self, microseconds: int) -> tuple[int, int] | None:
        """GPS time of a stamp that is either UTC or counts from the start.

        Args:
            microseconds: UTC since 1970 from UNIX_FROM_US on, else time since the start, us.

        Returns:
            Nanoseconds since the GPS epoch and their standard deviation, ns; None for a time since
            the start before UTC is known.
        """
        if microseconds >= UNIX_FROM_US:
            return self.gps_of_unix_ns(microseconds * 1000), self.utc_sigma_ns
        gps_ns = self.gps_ns(microseconds * 1000)
        return None if gps_ns is None else (gps_ns, self.sigma_ns(microseconds * 1000))

    def sigma_ns(self, boot_ns: int) -> int:
        """Standard deviation of `gps_ns` against the mean of the autopilot's UTC.

        Args:
            boot_ns: time since the autopilot's start, ns.

        Returns:
            Standard deviation, ns.
        """
        return round(math.hypot(self._line.sigma_ns(boot_ns), TRUNCATION_SIGMA_NS, self._doubt_ns))

    @property
    def last_boot_ns(self) -> int:
        """Time since start of the last message; 0 before the first."""
        return self._readings[-1][0] if self._readings else 0

    @property
    def utc_sigma_ns(self) -> int:
        """Standard deviation of a single stamp of the autopilot's UTC."""
        return round(math.hypot(self._line.one_sigma_ns, TRUNCATION_SIGMA_NS))

    def _detect_step(self) -> None:
        readings = list(self._readings)
        self._doubt_ns = 0.0
        off = [offset_ns - self._line.at(boot_ns) for boot_ns, offset_ns in readings[-2:]]
        if len(off) == 2 and (min(off) > CERTAIN_STEP_NS or max(off) < -CERTAIN_STEP_NS):
            self._step(readings[-2:], round(off[-1]))
            return
        for count, needed, quantile, factor in STEPS:
            before, newest = readings[:-count], readings[-count:]
            if len(before) < STEP_FROM:
                return
            off = [offset_ns - self._line.at(boot_ns) for boot_ns, offset_ns in newest]
            if abs(sum(math.copysign(1.0, each) for each in off)) < 2 * needed - count:
                continue
            line = _Line(before, self._prior)
            limit_ns = line.limit_ns(quantile, factor)
            off = [offset_ns - line.at(boot_ns) for boot_ns, offset_ns in newest]
            above = sum(each > limit_ns for each in off)
            below = sum(each < -limit_ns for each in off)
            if max(above, below) >= needed:
                self._prior = line.scatter(PRIOR_WEIGHT_AFTER_STEP)
                self._step(newest, round(statistics.median(off)))
                return
        limit_ns = self._line.limit_ns(*STEPS[0][2:])
        boot_ns, offset_ns = readings[-1]
        off_ns = abs(offset_ns - self._line.at(boot_ns))
        # Either an outlier or the first message after a step.
        self._doubt_ns = off_ns if off_ns > limit_ns else 0.0

    def _step(self, newest: list[Reading], by_ns: int | None) -> None:
        self.steps += 1
        self.last_step_ns = by_ns
        self._doubt_ns = 0.0
        self._readings.clear()
        self._readings.extend(newest)


@dataclass(frozen=True)
class _Scatter:
    """How messages scatter: variance as it enters the line, standard deviation of one, and factor
    by which neighbours err alike; believed as if so many messages had shown it."""

    variance: float
    one_sigma_ns: float
    autocorrelation_factor: float
    prior_weight: int


class _Line:
    """A line through readings, weighted so that those far off it hardly count (Student's t, 2
    degrees of freedom), with a prior for its slope."""

    def __init__(self, readings: list[Reading], prior: _Scatter) -> None:
        n = len(readings)
        self._prior = prior
        self._boot_ns, self._offset_ns = readings[-1]
        times = [(boot_ns - self._boot_ns) * 1e-9 for boot_ns, _ in readings]
        values = [float(offset_ns - self._offset_ns) for _, offset_ns in readings]
        self._level, self._slope = statistics.median(values), 0.0
        slope_sigma = RATE_SIGMA * 1e9
        for _ in range(ROUNDS if n > 1 else 0):
            off = self._residuals(times, values)
            scale = self._scale(off)
            weights = [3.0 / (2.0 + (each / scale) ** 2) for each in off]
            s0 = sum(weights)
            s1 = sum(w * t for w, t in zip(weights, times, strict=True))
            s2 = sum(w * t * t for w, t in zip(weights, times, strict=True))
            s2 += (scale / slope_sigma) ** 2
            z0 = sum(w * z for w, z in zip(weights, values, strict=True))
            z1 = sum(w * t * z for w, t, z in zip(weights, times, values, strict=True))
            determinant = s0 * s2 - s1 * s1
            self._level = (z0 * s2 - z1 * s1) / determinant
            self._slope = (z1 * s0 - z0 * s1) / determinant
        off = self._residuals(times, values)
        self._sizes = sorted(abs(each) for each in off)
        variance = self._variance_of_one(off)
        s0, s1 = float(n), sum(times)
        s2 = sum(t * t for t in times) + variance / slope_sigma**2
        determinant = s0 * s2 - s1 * s1
        self._variance, self._autocorrelation = variance, self._autocorrelation_factor(off)
        self._covariance = [
            self._autocorrelation * variance * s / determinant for s in (s2, -s1, s0)
        ]

    def at(self, boot_ns: int) -> float:
        """UTC less the time since start."""
        t = (boot_ns - self._boot_ns) * 1e-9
        return self._offset_ns + self._level + self._slope * t

    def sigma_ns(self, boot_ns: int) -> float:
        """Standard deviation of `at`."""
        t = (boot_ns - self._boot_ns) * 1e-9
        level, both, slope = self._covariance
        return math.sqrt(max(level + 2 * t * both + t * t * slope, 0.0))

    @property
    def one_sigma_ns(self) -> float:
        """Standard deviation of one reading: 95 % lie within two of them."""
        n, prior = len(self._sizes), self._prior
        seen = self.quantile_ns(0.95) / 2
        return math.sqrt(
            (prior.prior_weight * prior.one_sigma_ns**2 + n * seen**2) / (prior.prior_weight + n)
        )

    def scatter(self, prior_weight: int) -> _Scatter:
        """What these readings show, for those after a step."""
        return _Scatter(self._variance, self.one_sigma_ns, self._autocorrelation, prior_weight)

    def limit_ns(self, share: float, factor: float) -> float:
        """What more than that is off is not the scatter of these readings."""
        return factor * math.sqrt(self._autocorrelation) * max(self.quantile_ns(share), MS_NS)

    def quantile_ns(self, share: float) -> float:
        """What that share of the readings is off by at most."""
        return self._sizes[min(len(self._sizes) - 1, int(share * len(self._sizes)))]

    def _residuals(self, times: list[float], values: list[float]) -> list[float]:
        pairs = zip(times, values, strict=True)
        return [z - self._level - self._slope * t for t, z in pairs]

    def _scale(self, off: list[float]) -> float:
        """Robust standard deviation of the core of the readings."""
        return max(1.4826 * statistics.median(abs(each) for each in off), TRUNCATION_SIGMA_NS)

    def _variance_of_one(self, off: list[float]) -> float:
        """That of a reading, as far as it enters the line; few readings are not believed."""
        n, scale = len(off), self._scale(off)
        square = sum((3 * u / (2 + u * u)) ** 2 for u in (each / scale for each in off)) / n
        slope = sum(3 * (2 - u * u) / (2 + u * u) ** 2 for u in (r / scale for r in off)) / n
        seen = scale**2 * square / max(slope, 0.3) ** 2
        prior_weight = self._prior.prior_weight
        return (prior_weight * self._prior.variance + n * seen) / (prior_weight + max(n - 2, 0))

    def _autocorrelation_factor(self, off: list[float]) -> float:
        """By how much the variance of the line is larger than were all readings independent, from
        how alike neighbours are (autocorrelation of first order)."""
        scale, n, prior = self._scale(off), len(off), self._prior
        scores = [3 * u / (2 + u * u) for u in (each / scale for each in off)]
        products = sum(a * b for a, b in pairwise(scores))
        square = sum(score * score for score in scores)
        # The line takes out what would have been alike; few readings say little.
        autocorrelation_factor = min(
            max((products / square if square else 0.0) + 2 / n, 0.0), CORRELATION_MAX
        )
        autocorrelation_factor *= n / (n + PRIOR_WEIGHT)
        factor = (1 + autocorrelation_factor) / (1 - autocorrelation_factor)
        return (prior.prior_weight * prior.autocorrelation_factor + n * factor) / (
            prior.prior_weight + n
        )
