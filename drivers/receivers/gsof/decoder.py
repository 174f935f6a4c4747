"""GSOF records into NavSample and EventMark: bytes in, records out, no I/O and no clock.

Framing is in `drivers.receivers.gsof.framing`.

Source: Trimble OEM GNSS receiver help, pages of the GSOF messages 1, 2, 8, 12, 16, 49, 50 and 51,
and "GSOF message overview: flags".
"""

from __future__ import annotations

import math
import struct
from typing import Final

from drivers.contract import EventMark, NavSample
from drivers.receivers.gsof.framing import GsofRecord, Transmissions, gsof_framer, records_of
from drivers.receivers.message_decoder import MessageDecoder, Nav
from drivers.timescales.gps_time import MAX_LEAP_SECONDS, SECOND_NS, WEEK_NS

WEEK_MS: Final = 604_800_000
CLOCK_FIXED, PLACE_COMPUTED, HEIGHT_COMPUTED = 1 << 1, 1 << 2, 1 << 3
"""Bits of the position flags 1."""
VELOCITY_VALID, TRACK_VALID = 1 << 0, 1 << 2
"""Bits of the velocity flags."""
TIME_VALID, UTC_OFFSET_VALID = 1 << 0, 1 << 1
"""Bits of the current time flags."""
LEVELLED: Final = 2
"""IMU alignment status from which on roll and pitch are given: degraded."""
ALIGNED: Final = 3
"""Status from which on the heading is given."""
NO_FIX, DEAD_RECKONING, MANUAL_INPUT = 0, 6, 7
"""GPS quality indicators."""
TIME_AGE_NS: Final = 5 * SECOND_NS
RMS_AGE_NS: Final = 2 * SECOND_NS
COUNT_BITS: Final = 16


class GsofDecoder(MessageDecoder):
    """Decodes what a Trimble receiver or an Applanix board sends as GSOF.

    A transmission with record 49 becomes a NavSample of the inertial solution with the accuracy of
    record 50, another one with records 1 and 2 a NavSample of the antenna with records 8 and 12.
    Record 51 becomes an EventMark. Nothing that is fed raises.
    """

    decode_errors = (ValueError, TypeError, OverflowError, struct.error)
    bad_counter = "bad_records"

    def __init__(self, receiver: str, *, mark_accuracy_ns: int = 1000) -> None:
        super().__init__(
            receiver,
            gsof_framer(),
            ("samples", "samples_without_time", "transmissions_incomplete", "marks",
             "marks_duplicate", "marks_far", "marks_lost"),
        )  # fmt: skip
        self._mark_accuracy_ns = mark_accuracy_ns
        self._transmissions = Transmissions()
        self._clock_fixed_mono_ns: int | None = None
        """Arrival of the last record with a time that the receiver calls fixed."""
        self._rms: tuple[int, tuple[float, ...]] | None = None
        self._satellites: int | None = None
        self._numbers: dict[int, int] = {}

    def reset(self) -> None:
        super().reset()
        self._transmissions.reset()
        self._clock_fixed_mono_ns = self._rms = self._satellites = None

    def on_message(self, message: bytes, mono_ns: int) -> list[Nav]:
        content = self._transmissions.add(message)
        self.counters["transmissions_incomplete"] = self._transmissions.incomplete
        if content is None:
            return []
        records = list(records_of(content))
        by_name = {record.name: record for record in records}
        for record in records:
            self.seen[record.name] += 1
        if "Utc" in by_name:
            self._on_utc(by_name["Utc"])
        if "InsRms" in by_name:
            self._rms = mono_ns, by_name["InsRms"].values
        if "Time" in by_name:
            self._on_time(by_name["Time"], mono_ns)
        decoded: list[Nav] = []
        if "InsNavigation" in by_name:
            decoded += self._on_ins(by_name["InsNavigation"], mono_ns)
        elif "Time" in by_name and "Llh" in by_name:
            decoded += self._on_antenna(by_name, mono_ns)
        for record in records:
            if record.name == "EventMarker":
                decoded += self._on_event(record, mono_ns)
        return decoded

    # Time

    def _on_utc(self, record: GsofRecord) -> None:
        _, _, offset_s, flags = record.values
        self._leap = None
        if flags & UTC_OFFSET_VALID and 0 < offset_s <= MAX_LEAP_SECONDS:
            self._leap = offset_s

    def _on_time(self, record: GsofRecord, mono_ns: int) -> None:
        time_ms, week, self._satellites, flags, _, _ = record.values
        if flags & CLOCK_FIXED and _gps_ns(week, time_ms) is not None:
            self._clock_fixed_mono_ns = mono_ns

    def _is_timed(self, mono_ns: int) -> bool:
        fixed_ns = self._clock_fixed_mono_ns
        return fixed_ns is not None and mono_ns - fixed_ns <= TIME_AGE_NS

    # Navigation

    def _on_ins(self, record: GsofRecord, mono_ns: int) -> list[Nav]:
        week, time_ms, alignment, quality, latitude, longitude, height = record.values[:7]
        north, east, down, _, roll, pitch, heading = record.values[7:14]
        gps_ns = _gps_ns(week, time_ms)
        if not (abs(latitude) <= 90 and abs(longitude) <= 360):
            raise ValueError("a position that is none")
        if gps_ns is None:
            return self._without_time()
        has_position = quality not in (NO_FIX, MANUAL_INPUT)
        if has_position and quality != DEAD_RECKONING:
            self._clock_fixed_mono_ns = mono_ns
        fix = "dead-reckoning" if quality == DEAD_RECKONING else "3d"
        sigmas = self._ins_sigmas(mono_ns) if has_position else (None, None, None)
        return [
            self._sample(
                gps_ns,
                mono_ns,
                fix=fix if has_position else "none",
                place=(latitude, longitude, height) if has_position else (None, None, None),
                velocity=(north, east, down) if has_position else None,
                sigmas=sigmas,
                attitude_deg=(
                    roll if alignment >= LEVELLED else None,
                    pitch if alignment >= LEVELLED else None,
                    heading if alignment >= ALIGNED else None,
                ),
            )
        ]

    def _ins_sigmas(self, mono_ns: int) -> tuple[float | None, float | None, float | None]:
        """Of place, height and speed, by the last record 50."""
        if self._rms is None or mono_ns - self._rms[0] > RMS_AGE_NS:
            return None, None, None
        rms = self._rms[1][4:10]
        return math.hypot(*rms[:2]), rms[2], math.hypot(*rms[3:])

    def _on_antenna(self, by_name: dict[str, GsofRecord], mono_ns: int) -> list[Nav]:
        time_ms, week, _, flags, _, _ = by_name["Time"].values
        gps_ns = _gps_ns(week, time_ms)
        if gps_ns is None:
            return self._without_time()
        latitude_rad, longitude_rad, height = by_name["Llh"].values
        if not (abs(latitude_rad) <= math.pi / 2 and abs(longitude_rad) <= math.tau):
            raise ValueError("a position that is none")
        has_place, has_height = bool(flags & PLACE_COMPUTED), bool(flags & HEIGHT_COMPUTED)
        fix = "none" if not has_place else "3d" if has_height else "2d"
        place = math.degrees(latitude_rad), math.degrees(longitude_rad), height
        horizontal_m, vertical_m = self._antenna_sigmas(by_name.get("Sigma"))
        return [
            self._sample(
                gps_ns,
                mono_ns,
                fix=fix,
                place=(
                    place[0] if has_place else None,
                    place[1] if has_place else None,
                    place[2] if has_place and has_height else None,
                ),
                velocity=_velocity(by_name.get("Velocity")) if has_place else None,
                sigmas=(
                    horizontal_m if has_place else None,
                    vertical_m if has_place and has_height else None,
                    None,
                ),
                attitude_deg=(None, None, None),
            )
        ]

    @staticmethod
    def _antenna_sigmas(record: GsofRecord | None) -> tuple[float | None, float | None]:
        if record is None:
            return None, None
        _, east, north, _, up = record.values[:5]
        return math.hypot(east, north), up

    def _without_time(self) -> list[Nav]:
        self.counters["samples_without_time"] += 1
        self.fix, self.satellites = "none", self._satellites
        return []

    def _sample(
        self,
        gps_ns: int,
        mono_ns: int,
        *,
        fix: str,
        place: tuple[float | None, float | None, float | None],
        velocity: tuple[float, float, float] | None,
        sigmas: tuple[float | None, float | None, float | None],
        attitude_deg: tuple[float | None, float | None, float | None],
    ) -> NavSample:
        is_valid = self._is_timed(mono_ns)
        if is_valid:
            self._gps_ns = gps_ns
        self.counters["samples"] += 1
        roll, pitch, heading = (
            None if angle is None else math.radians(angle) for angle in attitude_deg
        )
        return NavSample(
            receiver=self.receiver,
            gps_ns=gps_ns,
            mono_ns=mono_ns,
            fix=fix,
            satellites=self._satellites,
            latitude_deg=place[0],
            longitude_deg=place[1],
            height_m=place[2],
            horizontal_sigma_m=sigmas[0],
            vertical_sigma_m=sigmas[1],
            velocity_ned_mps=velocity,
            speed_sigma_mps=sigmas[2],
            roll_rad=roll,
            pitch_rad=pitch,
            heading_rad=None if heading is None else heading % math.tau,
            leap_seconds=self._leap,
            time_valid=is_valid,
            sigma_source="none" if sigmas[0] is None else "receiver",
        )

    # Marks

    def _on_event(self, record: GsofRecord, mono_ns: int) -> list[Nav]:
        port, week, seconds, number = record.values
        number &= (1 << COUNT_BITS) - 1
        gps_ns = _gps_ns(week, seconds * 1000)
        if gps_ns is None:
            raise ValueError("an event without a time")
        previous = self._numbers.get(port)
        if number == previous:
            self.counters["marks_duplicate"] += 1
            return []
        self._numbers[port] = number
        if previous is not None and number > previous:
            self.counters["marks_lost"] += number - previous - 1
        self.counters["marks"] += 1
        return [
            EventMark(
                receiver=self.receiver,
                channel=port,
                gps_ns=gps_ns,
                accuracy_ns=self._mark_accuracy_ns,
                count=number,
                count_bits=COUNT_BITS,
                time_valid=self._is_timed(mono_ns) and self.is_near_navigation(gps_ns),
                mono_ns=mono_ns,
            )
        ]


def _gps_ns(week: int, time_ms: float) -> int | None:
    """GPS time; None where the receiver does not know the week.

    Raises:
        ValueError: the time is of no week.
    """
    if not 0 <= time_ms < WEEK_MS:
        raise ValueError("a time of the week that is none")
    return week * WEEK_NS + round(time_ms * 1e6) if week > 0 else None


def _velocity(record: GsofRecord | None) -> tuple[float, float, float] | None:
    """North, east, down; None unless speed and track are valid."""
    if record is None:
        return None
    flags, speed, track, up = record.values
    if flags & (VELOCITY_VALID | TRACK_VALID) != VELOCITY_VALID | TRACK_VALID:
        return None
    return speed * math.cos(track), speed * math.sin(track), -up
