"""NMEA sentences into records: bytes in, NavSample and EventMark out, no I/O and no clock.

Taking a sentence apart is in `drivers.nmea.sentences`.

Source: NMEA 0183 as published in gpsd's "NMEA Revealed"; Trimble's $PTNL,EVT; $PASHR as inertial
systems send it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

from drivers.contract import EventMark, NavSample
from drivers.gps_time import DAY_NS, RECENT_NS, SECOND_NS, WEEK_NS
from drivers.leap_seconds import leap_seconds_at
from drivers.message_decoder import MessageDecoder, Nav
from drivers.message_framer import MessageFramer
from drivers.nmea.sentences import (
    angle_deg,
    checksum_fits,
    day_number,
    day_of,
    fields_of,
    number,
    number_or_none,
    size_of,
    time_of_day_ns,
)

KNOT_MPS: Final = 1852 / 3600
KMH_MPS: Final = 1 / 3.6
FIXES: Final = {0: "none", 6: "dead-reckoning", 7: "none", 8: "none"}
"""By GGA quality; every other one is a fix of position and height."""
COUNT_BITS: Final = 16


@dataclass
class _Epoch:
    """What has come for one UTC time of day."""

    time: tuple[int, bool]
    """Time of day in ns, and whether that is within a leap second."""
    mono_ns: int
    kinds: set[str] = field(default_factory=set)
    day: int | None = None
    trusted: bool = False
    position: tuple[float, float] | None = None
    height_m: float | None = None
    quality: int | None = None
    satellites: int = 0
    hdop: float | None = None
    sigmas_m: tuple[float, float] | None = None
    speed_mps: float | None = None
    course_rad: float | None = None
    heading_rad: float | None = None
    roll_rad: float | None = None
    pitch_rad: float | None = None
    told: bool = False


class NmeaDecoder(MessageDecoder):
    """Decodes what an NMEA 0183 receiver sends.

    Sentences of one UTC time (RMC, GGA, GST, ZDA, PASHR, and VTG and HDT that follow them) become
    one NavSample, as soon as all kinds of the epoch before have come or the next epoch begins.
    $PTNL,EVT becomes an EventMark. Nothing that is fed raises.
    """

    unreadable = (ValueError, IndexError, OverflowError)
    bad_counter = "bad_sentences"

    def __init__(
        self,
        receiver: str,
        *,
        range_error_m: float = 5.0,
        speed_sigma_mps: float = 0.5,
        mark_accuracy_ns: int = 1000,
    ) -> None:
        super().__init__(
            receiver,
            MessageFramer(b"$", size_of, checksum_fits),
            ("samples", "samples_without_date", "marks", "marks_far"),
        )
        self._range_error_m = range_error_m
        self._speed_sigma_mps = speed_sigma_mps
        self._mark_accuracy_ns = mark_accuracy_ns
        self._utc_ns: int | None = None
        self._epoch: _Epoch | None = None
        self._expected: frozenset[str] = frozenset()
        self._timed: Mapping[str, Callable[[_Epoch, list[str]], None]] = {
            "RMC": self._on_rmc,
            "GGA": self._on_gga,
            "GST": self._on_gst,
            "ZDA": self._on_zda,
            "PASHR": self._on_pashr,
        }

    def reset(self) -> None:
        super().reset()
        self._epoch = None

    def on_message(self, message: bytes, mono_ns: int) -> list[Nav]:
        return self._on_sentence(fields_of(message), mono_ns)

    def _on_sentence(self, fields: list[str], mono_ns: int) -> list[Nav]:
        if fields[0] == "PTNL":
            if fields[1] != "EVT":
                return []
            mark = self._mark(fields, mono_ns)
            self.seen["PTNL,EVT"] += 1
            return [mark]
        kind = fields[0][2:]
        if fields[0] == "PASHR" and fields[1][:1].isdigit():
            kind = "PASHR"
        elif len(fields[0]) != 5 or fields[0].startswith("P"):
            return []
        made: list[Nav] = []
        if kind in self._timed:
            time = time_of_day_ns(fields[1])
            if self._epoch is None or self._epoch.time != time:
                made = self._close()
                self._epoch = _Epoch(time, mono_ns)
            self._timed[kind](self._epoch, fields)
        elif kind in ("VTG", "HDT") and self._epoch is not None:
            (self._on_vtg if kind == "VTG" else self._on_hdt)(self._epoch, fields)
        else:
            return []
        self.seen[kind] += 1
        self._epoch.kinds.add(kind)
        if self._expected and self._expected <= self._epoch.kinds:
            made.extend(self._tell(self._epoch))
        return made

    # Sentences

    def _on_rmc(self, epoch: _Epoch, fields: list[str]) -> None:
        position = _position(fields[3:7])
        speed, course = number_or_none(fields[7]), number_or_none(fields[8])
        if fields[9]:
            epoch.day = day_of(fields[9])
        epoch.trusted = epoch.trusted or fields[2] == "A"
        epoch.position = epoch.position or position
        if speed is not None:
            epoch.speed_mps = speed * KNOT_MPS
        if course is not None:
            epoch.course_rad = math.radians(course)

    def _on_gga(self, epoch: _Epoch, fields: list[str]) -> None:
        quality = int(number(fields[6]))
        position = _position(fields[2:6])
        height, undulation = number_or_none(fields[9]), number_or_none(fields[11])
        satellites, hdop = int(number_or_none(fields[7]) or 0), number_or_none(fields[8])
        epoch.quality, epoch.satellites, epoch.hdop = quality, satellites, hdop
        epoch.position = position or epoch.position
        epoch.trusted = epoch.trusted or quality not in FIXES
        if height is not None:
            epoch.height_m = height + (undulation or 0.0)

    def _on_gst(self, epoch: _Epoch, fields: list[str]) -> None:
        if all(fields[6:9]):
            latitude, longitude, height = (number(text) for text in fields[6:9])
            epoch.sigmas_m = (math.hypot(latitude, longitude), height)

    def _on_zda(self, epoch: _Epoch, fields: list[str]) -> None:
        if all(fields[2:5]):
            day, month, year = (int(number(text)) for text in fields[2:5])
            epoch.day = day_number(year, month, day)

    def _on_vtg(self, epoch: _Epoch, fields: list[str]) -> None:
        course, speed = number_or_none(fields[1]), number_or_none(fields[7])
        # RMC of the same epoch has a time of its own, VTG has none.
        if epoch.course_rad is None and course is not None:
            epoch.course_rad = math.radians(course)
        if epoch.speed_mps is None and speed is not None:
            epoch.speed_mps = speed * KMH_MPS

    def _on_hdt(self, epoch: _Epoch, fields: list[str]) -> None:
        heading = number_or_none(fields[1])
        if heading is not None:
            epoch.heading_rad = math.radians(heading)

    def _on_pashr(self, epoch: _Epoch, fields: list[str]) -> None:
        heading, roll, pitch = (number_or_none(fields[n].removeprefix("+")) for n in (2, 4, 5))
        if heading is not None:
            epoch.heading_rad = math.radians(heading)
        epoch.roll_rad = None if roll is None else math.radians(roll)
        epoch.pitch_rad = None if pitch is None else math.radians(pitch)

    # Epochs

    def _close(self) -> list[Nav]:
        if self._epoch is None:
            return []
        self._expected = frozenset(self._epoch.kinds)
        return self._tell(self._epoch)

    def _tell(self, epoch: _Epoch) -> list[Nav]:
        if epoch.told or epoch.position is None:
            return []
        epoch.told = True
        at = self._gps_of(epoch)
        if at is None:
            self.counters["samples_without_date"] += 1
            return []
        gps_ns, valid = at
        speed, course = epoch.speed_mps or 0.0, epoch.course_rad or 0.0
        assumed_m = self._range_error_m * (epoch.hdop if epoch.hdop is not None else 10.0)
        horizontal_m, vertical_m = epoch.sigmas_m or (assumed_m, 2 * assumed_m)
        if epoch.quality is None:
            fix = "2d" if epoch.trusted else "none"
        else:
            fix = FIXES.get(epoch.quality, "2d" if epoch.height_m is None else "3d")
        self.counters["samples"] += 1
        return [
            NavSample(
                receiver=self.receiver,
                gps_ns=gps_ns,
                mono_ns=epoch.mono_ns,
                fix=fix,
                satellites=epoch.satellites,
                latitude_deg=epoch.position[0],
                longitude_deg=epoch.position[1],
                height_m=epoch.height_m or 0.0,
                horizontal_sigma_m=horizontal_m,
                vertical_sigma_m=vertical_m,
                velocity_ned_mps=(speed * math.cos(course), speed * math.sin(course), 0.0),
                speed_sigma_mps=self._speed_sigma_mps,
                roll_rad=epoch.roll_rad,
                pitch_rad=epoch.pitch_rad,
                heading_rad=epoch.heading_rad,
                leap_seconds=self._leap,
                time_valid=valid,
            )
        ]

    def _gps_of(self, epoch: _Epoch) -> tuple[int, bool] | None:
        of_day, in_leap_second = epoch.time
        valid = epoch.trusted
        if epoch.day is not None:
            utc = epoch.day * DAY_NS + of_day
        elif self._utc_ns is not None:
            # No date of its own: the nearest such time of day, over midnight too.
            away = (of_day - self._utc_ns + DAY_NS // 2) % DAY_NS - DAY_NS // 2
            utc = self._utc_ns + away
            valid = valid and abs(away) < RECENT_NS
        else:
            return None
        leap = leap_seconds_at(utc - SECOND_NS if in_leap_second else utc)
        gps_ns = utc + leap * SECOND_NS
        if valid:
            self._utc_ns, self._gps_ns, self._leap = utc, gps_ns, leap
        return gps_ns, valid

    # Marks

    def _mark(self, fields: list[str], mono_ns: int) -> EventMark:
        of_day, _ = time_of_day_ns(fields[2])
        channel, count, week, day, leap = (int(number(text)) for text in fields[3:8])
        if not (0 <= day <= 6 and 0 <= leap <= 99 and 0 <= week < 65_536 and count >= 0):
            raise ValueError("week, day or leap seconds of an event out of range")
        start = week * WEEK_NS + day * DAY_NS
        by_utc_day = start + of_day + leap * SECOND_NS
        by_gps_day = start + (of_day + leap * SECOND_NS) % DAY_NS
        gps_ns, valid = by_utc_day, True
        if self._gps_ns is not None:
            # In the last seconds of a UTC day the GPS day is the next one already, and whose day
            # and week the sentence gives differs by receiver: navigation decides.
            near = self._gps_ns
            gps_ns = min((by_utc_day, by_gps_day), key=lambda at: abs(at - near))
            valid = self.near_navigation(gps_ns)
        elif by_utc_day != by_gps_day:
            valid = False
        self.counters["marks"] += 1
        return EventMark(
            receiver=self.receiver,
            channel=channel,
            gps_ns=gps_ns,
            accuracy_ns=self._mark_accuracy_ns,
            count=count % (1 << COUNT_BITS),
            count_bits=COUNT_BITS,
            time_valid=valid,
            mono_ns=mono_ns,
        )


def _position(fields: list[str]) -> tuple[float, float] | None:
    latitude = angle_deg(fields[0], fields[1], 90)
    longitude = angle_deg(fields[2], fields[3], 180)
    return None if latitude is None or longitude is None else (latitude, longitude)
