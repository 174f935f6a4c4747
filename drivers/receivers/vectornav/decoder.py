"""VectorNav binary outputs into records: bytes in, NavSample and EventMark out, no I/O, no clock.

Framing is in `drivers.receivers.vectornav.framing`.

Source: VectorNav VN-200 user manual UM004, VN-300 user manual UM005, chapter "Communication".
"""

from __future__ import annotations

import math
import struct
from typing import Any, Final

from drivers.contract import POSITION_FIXES, EventMark, NavSample
from drivers.receivers.attitude import angles_of
from drivers.receivers.message_decoder import MessageDecoder, Nav
from drivers.receivers.vectornav.framing import fields_of, vectornav_framer
from drivers.timescales.gps_time import MAX_LEAP_SECONDS, SECOND_NS, WEEK_NS

DATE_OK: Final = 1 << 1
"""Of the time status: TimeGps and GpsWeek are valid."""
UTC_OK: Final = 1 << 2
STATUS_AGE_NS: Final = 2 * SECOND_NS
MODE_ALIGNING: Final = 1
MODE_TRACKING: Final = 2
GNSS_FIX: Final = 1 << 2
"""Of the INS status, whose lowest two bits are its mode."""
GNSS_FIXES: Final = {1: "time", 2: "2d", 3: "3d"}
OSCILLATOR_PPM: Final = 20
"""By which the time since an edge is uncertain; the unit's crystal."""
FIRST_MARK_AGE_NS: Final = SECOND_NS
"""An older edge was before the first message, and is not reported."""
MAX_MARK_AGE_NS: Final = 60 * SECOND_NS
COUNT_BITS: Final = 32

Fields = dict[str, tuple[Any, ...]]
Angles = tuple[float | None, float | None, float | None]


class VectornavDecoder(MessageDecoder):
    """Decodes what a VectorNav unit sends in binary.

    A message with TimeGps and a position becomes a NavSample. A message whose SyncInCnt differs
    from the one before becomes an EventMark: TimeGps less TimeSyncIn. Whether time is valid is in
    TimeStatus or TimeInfo; without either no time is. Nothing that is fed raises.
    """

    decode_errors = (ValueError, TypeError, OverflowError, struct.error)
    bad_counter = "bad_outputs"

    def __init__(self, receiver: str, *, mark_accuracy_ns: int = 1000) -> None:
        super().__init__(
            receiver,
            vectornav_framer(),
            ("samples", "samples_duplicate", "marks", "marks_far", "marks_lost",
             "marks_without_time"),
        )  # fmt: skip
        self._mark_accuracy_ns = mark_accuracy_ns
        self._time_status: tuple[int, int] | None = None
        self._sync_count: int | None = None
        self._sample_ns: int | None = None
        self._satellites: int | None = None
        self._gnss_fix: str | None = None

    def reset(self) -> None:
        super().reset()
        self._time_status = None

    def on_message(self, message: bytes, mono_ns: int) -> list[Nav]:
        fields = fields_of(message)
        if "NumSats" in fields:
            (self._satellites,) = fields["NumSats"]
        if "Fix" in fields:
            self._gnss_fix = GNSS_FIXES.get(fields["Fix"][0], "none")
        self._on_time_status(fields, mono_ns)
        decoded = self._mark(fields, mono_ns) + self._sample(fields, mono_ns)
        for name in fields:
            self.seen[name] += 1
        return decoded

    # Time

    def _on_time_status(self, fields: Fields, mono_ns: int) -> None:
        if "TimeInfo" in fields:
            status, leap = fields["TimeInfo"]
            self._time_status = status, mono_ns
            if status & UTC_OK and 0 <= leap <= MAX_LEAP_SECONDS:
                self._leap = leap
        if "TimeStatus" in fields:
            self._time_status = fields["TimeStatus"][0], mono_ns

    def _is_time_valid(self, gps_ns: int, mono_ns: int) -> bool:
        if self._time_status is None or gps_ns < WEEK_NS:
            return False
        status, status_mono_ns = self._time_status
        return bool(status & DATE_OK) and mono_ns - status_mono_ns <= STATUS_AGE_NS

    # Navigation

    def _sample(self, fields: Fields, mono_ns: int) -> list[Nav]:
        if not ("TimeGps" in fields and "Position" in fields):
            return []
        (gps_ns,) = fields["TimeGps"]
        latitude, longitude, height = fields["Position"]
        if not (abs(latitude) <= 90 and abs(longitude) <= 360) or gps_ns >= 1 << 63:
            raise ValueError("a position or a time that is none")
        if gps_ns == self._sample_ns:
            self.counters["samples_duplicate"] += 1
            return []
        self._sample_ns = gps_ns
        is_valid = self._is_time_valid(gps_ns, mono_ns)
        if is_valid:
            self._gps_ns = gps_ns
        self.counters["samples"] += 1
        fix, angles = self._solution(fields)
        has_position = fix in POSITION_FIXES
        has_height = has_position and fix != "2d"
        position_sigma_m = fields["PosU"][0] if has_position and "PosU" in fields else None
        velocity = fields.get("Velocity") if has_position else None
        return [
            NavSample(
                receiver=self.receiver,
                gps_ns=gps_ns,
                mono_ns=mono_ns,
                fix=fix,
                satellites=self._satellites,
                latitude_deg=latitude if has_position else None,
                longitude_deg=longitude if has_position else None,
                height_m=height if has_height else None,
                horizontal_sigma_m=position_sigma_m,
                vertical_sigma_m=position_sigma_m if has_height else None,
                velocity_ned_mps=None
                if velocity is None
                else (velocity[0], velocity[1], velocity[2]),
                speed_sigma_mps=fields["VelU"][0] if velocity and "VelU" in fields else None,
                roll_rad=angles[0],
                pitch_rad=angles[1],
                heading_rad=angles[2],
                leap_seconds=self._leap,
                time_valid=is_valid,
                sigma_source="none" if position_sigma_m is None else "receiver",
            )
        ]

    def _solution(self, fields: Fields) -> tuple[str, Angles]:
        """Fix and attitude by the INS status, or by the GNSS fix where there is none."""
        roll, pitch, heading = _attitude(fields)
        if "InsStatus" not in fields:
            return self._gnss_fix or "none", (None, None, None)
        (status,) = fields["InsStatus"]
        mode, has_gnss = status & 0x03, bool(status & GNSS_FIX)
        if mode == MODE_TRACKING:
            return "3d" if has_gnss else "dead-reckoning", (roll, pitch, heading)
        if mode == MODE_ALIGNING:
            # The heading is not observed yet.
            return "3d" if has_gnss else "none", (roll, pitch, None)
        return "none", (None, None, None)

    # Marks

    def _mark(self, fields: Fields, mono_ns: int) -> list[Nav]:
        if "SyncInCnt" not in fields:
            return []
        (count,) = fields["SyncInCnt"]
        previous, is_new = self._sync_count, count != self._sync_count and count != 0
        if is_new and not ("TimeGps" in fields and "TimeSyncIn" in fields):
            if previous is not None:
                self.counters["marks_without_time"] += 1
            self._sync_count = count
            return []
        self._sync_count = count
        if not is_new:
            return []
        (gps_ns,), (age_ns,) = fields["TimeGps"], fields["TimeSyncIn"]
        if age_ns > (FIRST_MARK_AGE_NS if previous is None else MAX_MARK_AGE_NS):
            self.counters["marks_without_time"] += previous is not None
            return []
        if not 0 <= gps_ns - age_ns < 1 << 63:
            raise ValueError("a mark before GPS time began")
        if previous is not None and count > previous:
            self.counters["marks_lost"] += count - previous - 1
        gps_ns -= age_ns
        is_valid = self._is_time_valid(gps_ns, mono_ns) and self.is_near_navigation(gps_ns)
        self.counters["marks"] += 1
        return [
            EventMark(
                receiver=self.receiver,
                channel=1,
                gps_ns=gps_ns,
                accuracy_ns=self._mark_accuracy_ns + age_ns * OSCILLATOR_PPM // 1_000_000,
                count=count,
                count_bits=COUNT_BITS,
                time_valid=is_valid,
                mono_ns=mono_ns,
            )
        ]


def _attitude(fields: Fields) -> Angles:
    if "YawPitchRoll" in fields:
        yaw, pitch, roll = (math.radians(angle) for angle in fields["YawPitchRoll"])
        return roll, pitch, yaw % math.tau
    if "Quaternion" in fields:
        x, y, z, w = fields["Quaternion"]
        if not 0.9 < math.hypot(x, y, z, w) < 1.1:
            raise ValueError("a quaternion that is none")
        return angles_of((w, x, y, z))
    return None, None, None
