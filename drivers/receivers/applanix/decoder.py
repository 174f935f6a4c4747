"""Applanix groups into records: bytes in, NavSample and EventMark out, no I/O and no clock.

Framing is in `drivers.receivers.applanix.framing`.

Source: Applanix POS AV and POS MV V5 user interface control documents, PUBS-ICD-004089, section 3.
"""

from __future__ import annotations

import math
import struct
from typing import Any, Final

from drivers.contract import EventMark, NavSample
from drivers.receivers.applanix.framing import Group, applanix_framer, group_of
from drivers.receivers.message_decoder import MessageDecoder, Nav
from drivers.timescales.gps_time import MAX_LEAP_SECONDS, SECOND_NS, WEEK_NS

GPS_TIME: Final = 1
UTC_TIME: Final = 2
"""Kinds of a time in seconds of the week; the others count from power-on or are the user's."""
SYNCHRONIZED: Final = 2
"""Of the PPS group: fully synchronized; 3 goes on with an old offset."""
SYNC_AGE_NS: Final = 5 * SECOND_NS
WEEK_AGE_NS: Final = 60 * SECOND_NS
PERFORMANCE_AGE_NS: Final = 2 * SECOND_NS
MAX_ALIGNED: Final = 1
"""Alignment status: full navigation or fine alignment; above it the heading is coarse."""
NO_SOLUTION: Final = 6
"""Alignment status from which on there is no position: levelling, initial, none."""
COUNT_BITS: Final = 32


class ApplanixDecoder(MessageDecoder):
    """Decodes what an Applanix system sends on its data ports.

    Group 1 becomes a NavSample with the accuracy of group 2, groups 5, 6 and 30 to 33 EventMarks.
    Group 3 gives the week, group 7 whether time is synchronized; without them no time is valid.
    Nothing that is fed raises.
    """

    decode_errors = (ValueError, TypeError, OverflowError, struct.error)
    bad_counter = "bad_groups"

    def __init__(self, receiver: str, *, mark_accuracy_ns: int = 1000) -> None:
        super().__init__(
            receiver,
            applanix_framer(),
            ("samples", "samples_without_time", "marks", "marks_duplicate", "marks_far",
             "marks_lost", "marks_without_time"),
        )  # fmt: skip
        self._mark_accuracy_ns = mark_accuracy_ns
        self._week_ns: tuple[int, int] | None = None
        """GPS time of the last group 3, and its arrival."""
        self._offset_s = 0
        self._sync: tuple[int, int] | None = None
        self._performance: tuple[int, tuple[float, ...]] | None = None
        self._satellites: int | None = None
        self._pulses: dict[int, int] = {}

    def reset(self) -> None:
        super().reset()
        self._week_ns = self._sync = self._performance = None

    def on_message(self, message: bytes, mono_ns: int) -> list[Nav]:
        group = group_of(message)
        if group is None:
            return []
        decoded: list[Nav] = []
        if group.name == "PrimaryGnss":
            self._on_gnss(group, mono_ns)
        elif group.name == "Pps":
            self._sync = group.values[1], mono_ns
        elif group.name == "Performance":
            self._performance = mono_ns, group.values
        elif group.name == "Navigation":
            decoded = self._on_navigation(group, mono_ns)
        else:
            decoded = self._on_event(int(group.name[-1]), group, mono_ns)
        self.seen[group.name] += 1
        return decoded

    # Time

    def _on_gnss(self, group: Group, mono_ns: int) -> None:
        _, self._satellites, week, offset_s = group.values
        if not (0 < week < 65_536 and abs(offset_s) <= MAX_LEAP_SECONDS):
            self._week_ns = None
            return
        self._leap = self._offset_s = round(abs(offset_s))
        tow_ns = self._tow_ns(group)
        self._week_ns = None if tow_ns is None else (week * WEEK_NS + tow_ns, mono_ns)

    def _tow_ns(self, group: Group) -> int | None:
        """GPS time of the week; None where neither time is of GPS or UTC."""
        for wanted, offset_s in ((GPS_TIME, 0), (UTC_TIME, self._offset_s)):
            for seconds, kind in zip(group.times_s, group.time_kinds, strict=True):
                if kind == wanted:
                    if not 0 <= seconds <= 604_800:
                        raise ValueError("a time of the week that is none")
                    return round(seconds * 1e9) + offset_s * SECOND_NS
        return None

    def _gps_ns_of(self, group: Group, mono_ns: int) -> int | None:
        tow_ns = self._tow_ns(group)
        if tow_ns is None or self._week_ns is None or mono_ns - self._week_ns[1] > WEEK_AGE_NS:
            return None
        near_ns = self._week_ns[0]
        return near_ns + (tow_ns - near_ns + WEEK_NS // 2) % WEEK_NS - WEEK_NS // 2

    def _is_synchronized(self, gps_ns: int, mono_ns: int) -> bool:
        if self._sync is None or gps_ns < WEEK_NS:
            return False
        status, status_mono_ns = self._sync
        return status == SYNCHRONIZED and mono_ns - status_mono_ns <= SYNC_AGE_NS

    # Navigation

    def _on_navigation(self, group: Group, mono_ns: int) -> list[Nav]:
        latitude, longitude, height, north, east, down, roll, pitch, heading = group.values[:9]
        alignment = group.values[-1]
        if not (abs(latitude) <= 90 and abs(longitude) <= 360):
            raise ValueError("a position that is none")
        gps_ns = self._gps_ns_of(group, mono_ns)
        if gps_ns is None:
            self.counters["samples_without_time"] += 1
            self.fix, self.satellites = "none", self._satellites
            return []
        is_valid = self._is_synchronized(gps_ns, mono_ns)
        if is_valid:
            self._gps_ns = gps_ns
        self.counters["samples"] += 1
        has_position = alignment < NO_SOLUTION
        horizontal_m, vertical_m, speed_mps = self._sigmas(mono_ns, has_position=has_position)
        return [
            NavSample(
                receiver=self.receiver,
                gps_ns=gps_ns,
                mono_ns=mono_ns,
                fix=("3d" if self._satellites else "dead-reckoning") if has_position else "none",
                satellites=self._satellites,
                latitude_deg=latitude if has_position else None,
                longitude_deg=longitude if has_position else None,
                height_m=height if has_position else None,
                horizontal_sigma_m=horizontal_m,
                vertical_sigma_m=vertical_m,
                velocity_ned_mps=(north, east, down) if has_position else None,
                speed_sigma_mps=speed_mps,
                roll_rad=math.radians(roll) if has_position else None,
                pitch_rad=math.radians(pitch) if has_position else None,
                heading_rad=math.radians(heading) % math.tau if alignment <= MAX_ALIGNED else None,
                leap_seconds=self._leap,
                time_valid=is_valid,
                sigma_source="none" if horizontal_m is None else "receiver",
            )
        ]

    def _sigmas(
        self, mono_ns: int, *, has_position: bool
    ) -> tuple[float | None, float | None, float | None]:
        """Of place, height and speed, by the last group 2."""
        recent = self._performance
        if not has_position or recent is None or mono_ns - recent[0] > PERFORMANCE_AGE_NS:
            return None, None, None
        rms: tuple[Any, ...] = recent[1]
        return math.hypot(*rms[:2]), rms[2], math.hypot(*rms[3:6])

    # Marks

    def _on_event(self, channel: int, group: Group, mono_ns: int) -> list[Nav]:
        (pulse,) = group.values
        previous = self._pulses.get(channel)
        if pulse == previous:
            self.counters["marks_duplicate"] += 1
            return []
        self._pulses[channel] = pulse
        if previous is not None and pulse > previous:
            self.counters["marks_lost"] += pulse - previous - 1
        gps_ns = self._gps_ns_of(group, mono_ns)
        if gps_ns is None:
            self.counters["marks_without_time"] += 1
            return []
        is_valid = self._is_synchronized(gps_ns, mono_ns) and self.is_near_navigation(gps_ns)
        self.counters["marks"] += 1
        return [
            EventMark(
                receiver=self.receiver,
                channel=channel,
                gps_ns=gps_ns,
                accuracy_ns=self._mark_accuracy_ns,
                count=pulse,
                count_bits=COUNT_BITS,
                time_valid=is_valid,
                mono_ns=mono_ns,
            )
        ]
