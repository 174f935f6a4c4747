"""MTData2 messages into records: bytes in, NavSample and EventMark out, no I/O and no clock.

Framing is in `drivers.receivers.xsens.framing`.

Source: Xsens MT Low-Level Communication Protocol Documentation, document MT0101P.
"""

from __future__ import annotations

import math
import struct
from typing import Any, Final

from drivers.contract import POSITION_FIXES, EventMark, NavSample, Velocity
from drivers.receivers.attitude import angles_of
from drivers.receivers.message_decoder import MessageDecoder, Nav
from drivers.receivers.xsens.framing import Datum, data_of, xbus_framer
from drivers.timescales.gps_time import (
    SECOND_NS,
    WEEK_NS,
    UtcFields,
    gps_from_utc,
    utc_ns,
)
from drivers.timescales.leap_seconds import leap_seconds_at

FINE_TICK_NS: Final = 100_000
"""SampleTimeFine and the time stamps of triggers count 10 kHz, in 32 bits."""
FINE_WRAP: Final = 1 << 32
UTC_RESOLVED: Final = 0x07
"""Date valid, time of day valid, and no uncertainty of a second left."""
FILTER_VALID: Final = 1 << 1
GNSS_FIX: Final = 1 << 2
FILTER_MODE_SHIFT: Final = 23
MODE_COASTING: Final = 1
MODE_WITH_GNSS: Final = 3
EDGES: Final = {"rising": 1, "falling": 2}
GNSS_AGE_NS: Final = 2 * SECOND_NS
MAX_TRIGGER_AGE_NS: Final = 10 * SECOND_NS
SAME_NS: Final = FINE_TICK_NS
RECENT_MARKS: Final = 16
METRES_PER_DEGREE: Final = 111_320.0
NO_COUNT: Final = 0

Data = dict[str, Datum]
Angles = tuple[float | None, float | None, float | None]


class XsensDecoder(MessageDecoder):
    """Decodes what an Xsens MTi sends.

    An MTData2 with UtcTime and LatLon becomes a NavSample, one with TriggerIn1 to 3, UtcTime and
    SampleTimeFine an EventMark. GPS time follows from UTC with the leap seconds of GnssPvtData, or
    of the table where that does not come. Nothing that is fed raises.
    """

    decode_errors = (ValueError, TypeError, OverflowError, struct.error)
    bad_counter = "bad_data"

    def __init__(
        self, receiver: str, *, edge: str = "rising", mark_accuracy_ns: int = FINE_TICK_NS
    ) -> None:
        super().__init__(
            receiver,
            xbus_framer(),
            ("samples", "samples_without_time", "marks", "marks_duplicate", "marks_far",
             "marks_other_edge", "marks_without_time"),
        )  # fmt: skip
        self._polarity = EDGES[edge]
        self._mark_accuracy_ns = mark_accuracy_ns
        self._gnss: tuple[int, tuple[float, float, float]] | None = None
        self._satellites: int | None = None
        self._marks: dict[int, list[int]] = {}

    def reset(self) -> None:
        super().reset()
        self._gnss = None

    def on_message(self, message: bytes, mono_ns: int) -> list[Nav]:
        data = data_of(message)
        if data is None:
            return []
        if "GnssPvtData" in data:
            self._on_gnss(data["GnssPvtData"].values, mono_ns)
        gps = self._gps_of(data)
        decoded = self._on_triggers(data, gps, mono_ns)
        if "LatLon" in data:
            decoded += self._on_position(data, gps, mono_ns)
        for name in data:
            self.seen[name] += 1
        return decoded

    # Time

    def _on_gnss(self, values: tuple[Any, ...], mono_ns: int) -> None:
        itow_ms, year, month, day, hour, minute, second, valid, _, nano = values[:10]
        utc = utc_ns(UtcFields(year, month, day, hour, minute, second, nano))
        if valid & UTC_RESOLVED == UTC_RESOLVED and utc is not None:
            found = gps_from_utc(utc, itow_ms)
            if found is not None:
                self._leap = found[1]
        self._satellites = values[12]
        horizontal, vertical, speed = values[18], values[19], values[25]
        self._gnss = mono_ns, (horizontal * 1e-3, vertical * 1e-3, speed * 1e-3)

    def _gps_of(self, data: Data) -> tuple[int, bool] | None:
        """GPS time of a message, and whether the unit vouches for it; None without UtcTime."""
        if "UtcTime" not in data:
            return None
        nano, year, month, day, hour, minute, second, flags = data["UtcTime"].values
        utc = utc_ns(UtcFields(year, month, day, hour, minute, second, nano))
        if utc is None:
            if flags & UTC_RESOLVED == UTC_RESOLVED:
                raise ValueError("a date that is none")
            return None
        leap = leap_seconds_at(utc) if self._leap is None else self._leap
        gps_ns = utc + leap * SECOND_NS
        return gps_ns, flags & UTC_RESOLVED == UTC_RESOLVED and gps_ns >= WEEK_NS

    # Navigation

    def _on_position(self, data: Data, gps: tuple[int, bool] | None, mono_ns: int) -> list[Nav]:
        latitude, longitude = data["LatLon"].values
        if not (abs(latitude) <= 90 and abs(longitude) <= 360):
            raise ValueError("a position that is none")
        if gps is None:
            self.counters["samples_without_time"] += 1
            self.fix, self.satellites = "none", self._satellites
            return []
        gps_ns, is_valid = gps
        if is_valid:
            self._gps_ns = gps_ns
        self.counters["samples"] += 1
        status = data["StatusWord"].values[0] if "StatusWord" in data else 0
        fix = _fix(status)
        has_position = fix in POSITION_FIXES
        height = data["AltitudeEllipsoid"].values[0] if "AltitudeEllipsoid" in data else None
        horizontal_m, vertical_m, speed_mps = self._sigmas(data["LatLon"], mono_ns)
        velocity = _velocity(data["VelocityXYZ"]) if "VelocityXYZ" in data else None
        roll, pitch, heading = _attitude(data) if status & FILTER_VALID else (None, None, None)
        return [
            NavSample(
                receiver=self.receiver,
                gps_ns=gps_ns,
                mono_ns=mono_ns,
                fix=fix,
                satellites=self._satellites,
                latitude_deg=latitude if has_position else None,
                longitude_deg=longitude if has_position else None,
                height_m=height if has_position else None,
                horizontal_sigma_m=horizontal_m if has_position else None,
                vertical_sigma_m=vertical_m if has_position and height is not None else None,
                velocity_ned_mps=velocity if has_position else None,
                speed_sigma_mps=speed_mps if has_position and velocity is not None else None,
                roll_rad=roll,
                pitch_rad=pitch,
                heading_rad=heading,
                leap_seconds=self._leap,
                time_valid=is_valid,
                sigma_source="none" if horizontal_m is None or not has_position else "receiver",
                leap_source="table" if self._leap is None else "receiver",
            )
        ]

    def _sigmas(self, position: Datum, mono_ns: int) -> Angles:
        """Of place, height and speed: those of GnssPvtData, and the resolution of the format."""
        if self._gnss is None or mono_ns - self._gnss[0] > GNSS_AGE_NS:
            return None, None, None
        horizontal_m, vertical_m, speed_mps = self._gnss[1]
        if position.number_format == "float32":
            steps = (2.0 ** (math.frexp(degrees)[1] - 24) for degrees in position.values)
            resolution_m = math.hypot(*steps) * METRES_PER_DEGREE / math.sqrt(12)
            horizontal_m = math.hypot(horizontal_m, resolution_m)
        return horizontal_m, vertical_m, speed_mps

    # Marks

    def _on_triggers(self, data: Data, gps: tuple[int, bool] | None, mono_ns: int) -> list[Nav]:
        return [
            mark
            for name in ("TriggerIn1", "TriggerIn2", "TriggerIn3")
            if name in data
            for mark in self._mark(int(name[-1]), data, gps, mono_ns)
        ]

    def _mark(
        self, channel: int, data: Data, gps: tuple[int, bool] | None, mono_ns: int
    ) -> list[Nav]:
        _, polarity, ticks, frame_number = data[f"TriggerIn{channel}"].values
        if polarity in EDGES.values() and polarity != self._polarity:
            self.counters["marks_other_edge"] += 1
            self.other_edges += 1
            return []
        self.other_edges = 0
        if gps is None or "SampleTimeFine" not in data:
            self.counters["marks_without_time"] += 1
            return []
        message_ns, is_valid = gps
        (fine,) = data["SampleTimeFine"].values
        since_ticks = (fine - ticks + FINE_WRAP // 2) % FINE_WRAP - FINE_WRAP // 2
        gps_ns = message_ns - since_ticks * FINE_TICK_NS
        if abs(since_ticks) * FINE_TICK_NS > MAX_TRIGGER_AGE_NS:
            self.counters["marks_far"] += 1
            is_valid = False
        recent = self._marks.setdefault(channel, [])
        if any(abs(gps_ns - at) <= SAME_NS for at in recent):
            self.counters["marks_duplicate"] += 1
            return []
        recent.append(gps_ns)
        del recent[:-RECENT_MARKS]
        self.counters["marks"] += 1
        is_valid = is_valid and self.is_near_navigation(gps_ns)
        return [
            EventMark(
                receiver=self.receiver,
                channel=channel,
                gps_ns=gps_ns,
                accuracy_ns=self._mark_accuracy_ns,
                count=frame_number,
                count_bits=NO_COUNT,
                time_valid=is_valid,
                mono_ns=mono_ns,
            )
        ]


def _fix(status: int) -> str:
    if not status & FILTER_VALID:
        return "none"
    mode = status >> FILTER_MODE_SHIFT & 0x07
    if mode == MODE_WITH_GNSS and status & GNSS_FIX:
        return "3d"
    return "dead-reckoning" if mode in (MODE_COASTING, MODE_WITH_GNSS) else "none"


def _velocity(datum: Datum) -> Velocity:
    """North, east, down of a velocity in the coordinate system of its identifier."""
    x, y, z = datum.values
    if datum.frame == "ENU":
        return y, x, -z
    return (x, y, z) if datum.frame == "NED" else (x, -y, -z)


def _attitude(data: Data) -> Angles:
    """Roll, pitch and heading of a body with axes forward, right and down."""
    if "EulerAngles" in data:
        datum = data["EulerAngles"]
        roll, pitch, yaw = (math.radians(angle) for angle in datum.values)
    elif "Quaternion" in data:
        datum = data["Quaternion"]
        w, x, y, z = datum.values
        if not 0.9 < math.hypot(w, x, y, z) < 1.1:
            raise ValueError("a quaternion that is none")
        roll, pitch, yaw = angles_of((w, x, y, z))
    else:
        return None, None, None
    if datum.frame == "NED":
        return roll, pitch, yaw % math.tau
    # Axes forward, left and up: the angles about left and up count the other way.
    heading = math.pi / 2 - yaw if datum.frame == "ENU" else -yaw
    return roll, -pitch, heading % math.tau
