"""sbgECom logs into records: bytes in, NavSample and EventMark out, no I/O and no clock.

Framing is in `drivers.receivers.sbg.framing`.

Source: SBG Systems, sbgECom binary messages reference, version 5: UTC_TIME, EKF_NAV, EKF_EULER,
EKF_QUAT, GPS1_POS, EVENT_A to EVENT_E.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Final

from drivers.contract import POSITION_FIXES, EventMark, NavSample
from drivers.receivers.attitude import angles_of
from drivers.receivers.message_decoder import MessageDecoder, Nav
from drivers.receivers.sbg.framing import SbgLog, log_of, sbg_framer
from drivers.timescales.gps_time import (
    RECENT_NS,
    SECOND_NS,
    WEEK_NS,
    UtcFields,
    gps_from_utc,
    utc_ns,
)

CLOCK_VALID: Final = 3
"""The unit's clock has converged to the pulse per second and is within 500 ns of it."""
UTC_KNOWN: Final = (1, 2)
UTC_WITH_LEAP_SECONDS: Final = 2
ATTITUDE_VALID: Final = 1 << 4
HEADING_VALID: Final = 1 << 5
VELOCITY_VALID: Final = 1 << 6
POSITION_VALID: Final = 1 << 7
GPS_POSITION_USED: Final = 1 << 11 | 1 << 15
MODE_VELOCITY: Final = 3
"""Solution mode: the position is integrated from the velocity."""
MODE_POSITION: Final = 4
EVENT_OVERFLOW: Final = 1
STAMP_WRAP_US: Final = 1 << 32
REFERENCE_AGE_NS: Final = 5 * SECOND_NS
"""UTC_TIME comes once a second or faster; an older one is not extrapolated."""
BACKWARD_US: Final = 1_000_000
"""Time stamps that go back by more: the unit was restarted."""
SAME_NS: Final = 2_000
"""Events nearer to each other are one: the unit reports at most one a millisecond."""
RECENT_MARKS: Final = 16
NO_COUNT: Final = 0
"""The logs have no count: ours, of what came, is no witness of what the unit saw."""

Angles = tuple[float | None, float | None, float | None]
NO_ANGLES: Final[Angles] = (None, None, None)


@dataclass(frozen=True)
class _Reference:
    """GPS time of one time stamp; `is_valid` where the clock follows the pulse per second."""

    stamp_us: int
    gps_ns: int
    mono_ns: int
    is_valid: bool


@dataclass(frozen=True)
class _Attitude:
    stamp_us: int
    mono_ns: int
    angles: Angles


class SbgDecoder(MessageDecoder):
    """Decodes what an SBG inertial unit sends.

    EKF_NAV becomes a NavSample together with the EKF_EULER or EKF_QUAT of the same time stamp, and
    every event of EVENT_A to EVENT_E an EventMark. UTC_TIME ties time stamps to GPS time; without
    it there is neither. Nothing that is fed raises.
    """

    decode_errors = (ValueError, TypeError, OverflowError, struct.error)
    bad_counter = "bad_logs"

    def __init__(self, receiver: str, *, mark_accuracy_ns: int = 1000) -> None:
        super().__init__(
            receiver,
            sbg_framer(),
            ("samples", "samples_without_time", "marks", "marks_duplicate", "marks_far",
             "marks_overflow", "marks_without_time", "restarts"),
        )  # fmt: skip
        self._mark_accuracy_ns = mark_accuracy_ns
        self._reference: _Reference | None = None
        self._stamp_us: int | None = None
        self._attitude: _Attitude | None = None
        self._pending: tuple[SbgLog, int] | None = None
        self._satellites: int | None = None
        self._marks: dict[int, list[int]] = {}
        self._count = 0

    def reset(self) -> None:
        super().reset()
        self._forget_time()

    def on_message(self, message: bytes, mono_ns: int) -> list[Nav]:
        log = log_of(message)
        if log is None:
            return []
        self._check_restart(log.stamp_us)
        decoded: list[Nav] = []
        if log.name == "UTC_TIME":
            self._on_utc(log, mono_ns)
        elif log.name == "EKF_NAV":
            decoded = self._on_navigation(log, mono_ns)
        elif log.name in ("EKF_EULER", "EKF_QUAT"):
            decoded = self._on_attitude(log, mono_ns)
        elif log.name.startswith("EVENT"):
            decoded = self._on_events(log, mono_ns)
        else:
            used = log.values[-1]
            self._satellites = used if log.name == "GPS1_POS" and used != 255 else self._satellites
        self.seen[log.name] += 1
        return decoded

    # Time

    def _forget_time(self) -> None:
        self._reference = self._stamp_us = self._attitude = self._pending = None

    def _check_restart(self, stamp_us: int) -> None:
        if self._stamp_us is not None and -_elapsed_us(stamp_us, self._stamp_us) > BACKWARD_US:
            self.counters["restarts"] += 1
            self._forget_time()
        self._stamp_us = stamp_us

    def _on_utc(self, log: SbgLog, mono_ns: int) -> None:
        status, year, month, day, hour, minute, second, nano, tow_ms = log.values
        utc_status = status >> 6 & 0x0F
        self._reference = None
        if utc_status not in UTC_KNOWN:
            return
        utc = utc_ns(UtcFields(year, month, day, hour, minute, second, nano))
        found = None if utc is None else gps_from_utc(utc, tow_ms)
        if found is None:
            raise ValueError("UTC and GPS time contradict each other")
        gps_ns, leap = found
        if utc_status == UTC_WITH_LEAP_SECONDS:
            self._leap = leap
        is_valid = status >> 1 & 0x0F == CLOCK_VALID and gps_ns >= WEEK_NS
        self._reference = _Reference(log.stamp_us, gps_ns, mono_ns, is_valid)

    def _time_of(self, stamp_us: int, mono_ns: int) -> int | None:
        """GPS time of a time stamp; None without a recent UTC_TIME."""
        reference = self._reference
        if reference is None or mono_ns - reference.mono_ns > REFERENCE_AGE_NS:
            return None
        elapsed_ns = _elapsed_us(stamp_us, reference.stamp_us) * 1000
        return None if abs(elapsed_ns) > REFERENCE_AGE_NS else reference.gps_ns + elapsed_ns

    @property
    def _is_time_valid(self) -> bool:
        return self._reference is not None and self._reference.is_valid

    # Navigation

    def _on_attitude(self, log: SbgLog, mono_ns: int) -> list[Nav]:
        status = log.values[-1]
        if log.name == "EKF_EULER":
            roll, pitch, heading = log.values[0], log.values[1], log.values[2] % math.tau
        else:
            if not 0.9 < math.hypot(*log.values[:4]) < 1.1:
                raise ValueError("a quaternion that is none")
            roll, pitch, heading = angles_of(log.values[:4])
        has_attitude = bool(status & ATTITUDE_VALID)
        angles = (
            roll if has_attitude else None,
            pitch if has_attitude else None,
            heading if has_attitude and status & HEADING_VALID else None,
        )
        self._attitude = _Attitude(log.stamp_us, mono_ns, angles)
        if self._pending is None or self._pending[0].stamp_us != log.stamp_us:
            return []
        return self._emit_pending(angles)

    def _on_navigation(self, log: SbgLog, mono_ns: int) -> list[Nav]:
        decoded = self._emit_pending(NO_ANGLES)
        self._pending = log, mono_ns
        attitude = self._attitude
        if attitude is not None and attitude.stamp_us == log.stamp_us:
            decoded += self._emit_pending(attitude.angles)
        elif attitude is None or mono_ns - attitude.mono_ns > RECENT_NS:
            decoded += self._emit_pending(NO_ANGLES)
        return decoded

    def _emit_pending(self, angles: Angles) -> list[Nav]:
        if self._pending is None:
            return []
        (log, mono_ns), self._pending = self._pending, None
        return self._sample(log, mono_ns, angles)

    def _sample(self, log: SbgLog, mono_ns: int, angles: Angles) -> list[Nav]:
        north, east, down, *rest = log.values
        velocity_sigmas, place, undulation = rest[:3], rest[3:6], rest[6]
        sigmas, status = rest[7:10], rest[10]
        if not (abs(place[0]) <= 90 and abs(place[1]) <= 360):
            raise ValueError("a position that is none")
        fix = _fix(status)
        gps_ns = self._time_of(log.stamp_us, mono_ns)
        if gps_ns is None:
            self.counters["samples_without_time"] += 1
            self.fix, self.satellites = "none", self._satellites
            return []
        if self._is_time_valid:
            self._gps_ns = gps_ns
        self.counters["samples"] += 1
        has_position = fix in POSITION_FIXES
        has_velocity = has_position and bool(status & VELOCITY_VALID)
        return [
            NavSample(
                receiver=self.receiver,
                gps_ns=gps_ns,
                mono_ns=mono_ns,
                fix=fix,
                satellites=self._satellites,
                latitude_deg=place[0] if has_position else None,
                longitude_deg=place[1] if has_position else None,
                height_m=place[2] + undulation if has_position else None,
                horizontal_sigma_m=math.hypot(*sigmas[:2]) if has_position else None,
                vertical_sigma_m=sigmas[2] if has_position else None,
                velocity_ned_mps=(north, east, down) if has_velocity else None,
                speed_sigma_mps=math.hypot(*velocity_sigmas) if has_velocity else None,
                roll_rad=angles[0],
                pitch_rad=angles[1],
                heading_rad=angles[2],
                leap_seconds=self._leap,
                time_valid=self._is_time_valid,
                sigma_source="receiver" if has_position else "none",
            )
        ]

    # Marks

    def _on_events(self, log: SbgLog, mono_ns: int) -> list[Nav]:
        channel = ord(log.name[-1]) - ord("A") + 1
        status, *offsets_us = log.values
        self.counters["marks_overflow"] += status & EVENT_OVERFLOW
        gps_ns = self._time_of(log.stamp_us, mono_ns)
        given_us = [0, *(us for bit, us in enumerate(offsets_us, start=1) if status >> bit & 1)]
        if gps_ns is None:
            self.counters["marks_without_time"] += len(given_us)
            return []
        return [
            mark
            for offset_us in given_us
            for mark in self._mark(channel, gps_ns + offset_us * 1000, mono_ns)
        ]

    def _mark(self, channel: int, gps_ns: int, mono_ns: int) -> list[Nav]:
        recent = self._marks.setdefault(channel, [])
        if any(abs(gps_ns - at) <= SAME_NS for at in recent):
            self.counters["marks_duplicate"] += 1
            return []
        recent.append(gps_ns)
        del recent[:-RECENT_MARKS]
        is_valid = self._is_time_valid and self.is_near_navigation(gps_ns)
        self.counters["marks"] += 1
        self._count = (self._count + 1) % (1 << 32)
        return [
            EventMark(
                receiver=self.receiver,
                channel=channel,
                gps_ns=gps_ns,
                accuracy_ns=self._mark_accuracy_ns,
                count=self._count,
                count_bits=NO_COUNT,
                time_valid=is_valid,
                mono_ns=mono_ns,
            )
        ]


def _elapsed_us(later_us: int, earlier_us: int) -> int:
    """From one time stamp to another, the short way around their wrap."""
    half = STAMP_WRAP_US // 2
    return (later_us - earlier_us + half) % STAMP_WRAP_US - half


def _fix(status: int) -> str:
    mode = status & 0x0F
    if mode == MODE_VELOCITY:
        return "dead-reckoning"
    if mode != MODE_POSITION:
        return "none"
    is_measured = status & POSITION_VALID and status & GPS_POSITION_USED
    return "3d" if is_measured else "dead-reckoning"
