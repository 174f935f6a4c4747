"""NovAtel logs into records: bytes in, NavSample and EventMark out, no I/O and no clock.

Framing is in `drivers.receivers.novatel.framing`.

Source: NovAtel OEM7 Commands and Logs Reference Manual, OM-20000169.
"""

from __future__ import annotations

import math
import struct
from collections import Counter, deque
from dataclasses import replace
from typing import Any, Final

from drivers.contract import POSITION_FIXES, EventMark, NavSample, Velocity
from drivers.receivers.ascii_numbers import parse_decimal, parse_integer
from drivers.receivers.message_decoder import MessageDecoder, Nav
from drivers.receivers.novatel.framing import NovatelLog, log_of, novatel_framer
from drivers.timescales.gps_time import RECENT_NS, SECOND_NS, WEEK_NS

NAMES: Final = {
    42: "BESTPOS", 99: "BESTVEL", 101: "TIME", 507: "INSPVA", 508: "INSPVAS", 1465: "INSPVAX",
    231: "MARKTIME", 181: "MARKPOS", 615: "MARK2POS", 1738: "MARK3POS", 1739: "MARK4POS",
    1130: "MARK1TIME", 616: "MARK2TIME", 1075: "MARK3TIME", 1076: "MARK4TIME",
    1067: "MARK1PVA", 1068: "MARK2PVA", 1118: "MARK3PVA", 1119: "MARK4PVA",
}  # fmt: skip
_PVA: Final = struct.Struct("<I10dI")
_MARKTIME: Final = struct.Struct("<I4dI")
LAYOUTS: Final = {
    "BESTPOS": struct.Struct("<II3df4x3f4x2fBB6x"),
    "BESTVEL": struct.Struct("<II2f3d4x"),
    "TIME": struct.Struct("<I3dIBBBBII"),
    "INSPVAX": struct.Struct("<II3df6d9fIH"),
}
ASCII_PVA: Final = "i" + "f" * 10 + "w"
ASCII_MARKTIME: Final = "iffffw"
ASCII_KINDS: Final = {
    # Type of each word of a line: whole number, decimal number, word of an enumeration; "-" is not
    # read, hexadecimal status words among them.
    "BESTPOS": "wwffff-fff-ffii",
    "BESTVEL": "wwfffff",
    "TIME": "wfffiiiiiiw",
    "INSPVAX": "ww" + "f" * 19 + "--",
}
INS_FIXES: Final = {
    2: "dead-reckoning", 3: "3d", 6: "dead-reckoning", 7: "3d",
    "INS_HIGH_VARIANCE": "dead-reckoning", "INS_SOLUTION_GOOD": "3d",
    "INS_SOLUTION_FREE": "dead-reckoning", "INS_ALIGNMENT_COMPLETE": "3d",
}  # fmt: skip
COMPUTED: Final = (0, "SOL_COMPUTED")
VALID: Final = (0, 1, "VALID")
MIN_TIME_STATUS: Final = 120
"""Of the numbers of the time status: COARSESTEERING and all that are finer."""
GOOD_TIME_STATES: Final = frozenset(
    ("COARSESTEERING", "FREEWHEELING", "FINEADJUSTING", "FINE", "FINEBACKUPSTEERING",
     "FINESTEERING", "EXACT", "SATTIME")
)  # fmt: skip
SAME_NS: Final = 1000
"""MARKxTIME and MARKxPVA of one edge lie closer; two edges never do."""
POSITION_MARK_ACCURACY_NS: Final = 1_000_000
"""MARKxPOS has the time of its edge in its header only, to the millisecond."""
POSITION_MARK_DELAY_NS: Final = SECOND_NS
"""By then, MARKxTIME or MARKxPVA of the same edge has come."""
MAX_POSITION_MARKS: Final = 16
TIME_ONLY: Final = (1, "FIXEDPOS")
HEIGHT_IS_FIXED: Final = (2, "FIXEDHEIGHT")
"""Position types of BESTPOS whose position, or height, was set and not measured."""
COUNT_BITS: Final = 32
NO_COUNT: Final = 0
"""The logs have no count: ours, of what came, is no witness of what the receiver saw."""


class NovatelDecoder(MessageDecoder):
    """Decodes what a NovAtel receiver sends.

    INSPVAX, INSPVA or INSPVAS become a NavSample; BESTPOS with BESTVEL does while no inertial
    solution comes. MARKxTIME and MARKxPVA become one EventMark together. Nothing that is fed
    raises.
    """

    decode_errors = (ValueError, TypeError, IndexError, OverflowError, struct.error)
    bad_counter = "bad_logs"

    def __init__(self, receiver: str, *, mark_accuracy_ns: int = 100) -> None:
        super().__init__(
            receiver,
            novatel_framer(),
            ("samples", "marks", "marks_coarse", "marks_duplicate", "marks_far"),
        )
        self._mark_accuracy_ns = mark_accuracy_ns
        self._time_good = False
        self._sample_ns = -1
        self._inertial_ns: int | None = None
        self._velocity: tuple[int, tuple[float, float, float]] | None = None
        self._satellites: int | None = None
        self._sigmas: tuple[float | None, float | None, float | None] = (None, None, None)
        self._marks: dict[int, list[int]] = {}
        self._counts: Counter[int] = Counter()
        self._position_marks: deque[tuple[int, EventMark]] = deque(maxlen=MAX_POSITION_MARKS)
        """Marks of MARKxPOS that wait for a better one, with the edge's input."""

    def on_message(self, message: bytes, mono_ns: int) -> list[Nav]:
        return self._on_log(log_of(message), mono_ns)

    def _on_log(self, log: NovatelLog, mono_ns: int) -> list[Nav]:
        name = NAMES.get(log.identity, "") if isinstance(log.identity, int) else log.identity
        name = name.removesuffix("S") if name == "INSPVAS" else name
        if name not in NAMES.values():
            return []
        if isinstance(log.time_status, int):
            self._time_good = log.time_status >= MIN_TIME_STATUS
        elif log.time_status is not None:
            self._time_good = log.time_status in GOOD_TIME_STATES
        values = _values(name, log.body)
        if any(isinstance(value, float) and not math.isfinite(value) for value in values):
            raise ValueError(f"{name} holds a number that is none")
        decoded: list[Nav] = self._coarse_marks(_header_ns(log))
        if name.startswith("MARK") and name.endswith("POS"):
            self._on_mark_position(_input_of(name), _header_ns(log), mono_ns)
        elif name.startswith("MARK"):
            decoded += self._on_mark(
                _input_of(name), values, is_pva=name.endswith("PVA"), mono_ns=mono_ns
            )
        elif name == "TIME":
            if values[10] in VALID[1:]:
                self._leap = round(-values[3])
        elif name == "BESTVEL":
            if values[0] in COMPUTED:
                speed, track, up = values[4:7]
                course = math.radians(track)
                ned = (speed * math.cos(course), speed * math.sin(course), -up)
                self._velocity = (_header_ns(log), ned)
        elif name == "BESTPOS":
            decoded += self._on_bestpos(log, values, mono_ns)
        elif name == "INSPVAX":
            self._sigmas = (math.hypot(*values[12:14]), values[14], math.hypot(*values[15:18]))
            height = values[4] + values[5]
            inertial = (*values[2:4], height, *values[6:12], values[0])
            decoded += self._on_inertial(_header_ns(log), inertial, mono_ns)
        else:
            decoded += self._on_inertial(_gps_ns(values[0], values[1]), values[2:], mono_ns)
        self.seen[name] += 1
        return decoded

    # Navigation

    def _on_inertial(self, gps_ns: int, values: tuple[Any, ...], mono_ns: int) -> list[Nav]:
        latitude, longitude, height, north, east, up, roll, pitch, azimuth, status = values
        fix = INS_FIXES.get(status, "none")
        if fix != "none":
            self._inertial_ns = gps_ns
        if gps_ns == self._sample_ns:
            return []
        return self._sample(
            gps_ns,
            mono_ns,
            fix=fix,
            place=(latitude, longitude, height),
            velocity=(north, east, -up),
            attitude=(math.radians(roll), math.radians(pitch), math.radians(azimuth) % math.tau),
        )

    def _on_bestpos(self, log: NovatelLog, values: tuple[Any, ...], mono_ns: int) -> list[Nav]:
        gps_ns = _header_ns(log)
        self._satellites = int(values[12])
        if self._inertial_ns is not None and abs(gps_ns - self._inertial_ns) < RECENT_NS:
            return []
        speed_sigma = self._sigmas[2]
        self._sigmas = (math.hypot(values[6], values[7]), values[8], speed_sigma)
        velocity: Velocity | None = None
        if self._velocity is not None and abs(gps_ns - self._velocity[0]) < SECOND_NS:
            velocity = self._velocity[1]
        return self._sample(
            gps_ns,
            mono_ns,
            fix=_fix(values[0], values[1]),
            place=(values[2], values[3], values[4] + values[5]),
            velocity=velocity,
            attitude=(None, None, None),
        )

    def _sample(
        self,
        gps_ns: int,
        mono_ns: int,
        *,
        fix: str,
        place: tuple[float, float, float],
        velocity: Velocity | None,
        attitude: tuple[float | None, float | None, float | None],
    ) -> list[Nav]:
        valid = self._time_good and gps_ns >= WEEK_NS
        if not (abs(place[0]) <= 90 and abs(place[1]) <= 360):
            raise ValueError("a position that is none")
        self._sample_ns = gps_ns
        if valid:
            self._gps_ns = gps_ns
        self.counters["samples"] += 1
        has_position = fix in POSITION_FIXES
        has_height = has_position and fix != "2d"
        horizontal_m, vertical_m, speed_mps = self._sigmas if has_position else (None, None, None)
        return [
            NavSample(
                receiver=self.receiver,
                gps_ns=gps_ns,
                mono_ns=mono_ns,
                fix=fix,
                satellites=self._satellites,
                latitude_deg=place[0] if has_position else None,
                longitude_deg=place[1] if has_position else None,
                height_m=place[2] if has_height else None,
                horizontal_sigma_m=horizontal_m,
                vertical_sigma_m=vertical_m if has_height else None,
                velocity_ned_mps=velocity if has_position else None,
                speed_sigma_mps=None if velocity is None else speed_mps,
                roll_rad=attitude[0] if has_position else None,
                pitch_rad=attitude[1] if has_position else None,
                heading_rad=attitude[2] if has_position else None,
                leap_seconds=self._leap,
                time_valid=valid,
                sigma_source="none" if horizontal_m is None else "receiver",
            )
        ]

    # Marks

    def _on_mark(
        self, channel: int, values: tuple[Any, ...], *, is_pva: bool, mono_ns: int
    ) -> list[Nav]:
        gps_ns = _gps_ns(values[0], values[1])
        valid = self._time_good and gps_ns >= WEEK_NS
        accuracy_ns = self._mark_accuracy_ns
        if not is_pva:
            # GPS time = receiver time - clock offset; MARKxPVA has it applied already.
            gps_ns -= round(values[2] * 1e9)
            accuracy_ns = max(accuracy_ns, min(round(abs(values[3]) * 1e9), SECOND_NS))
            valid = valid and values[5] in VALID
        recent = self._marks.setdefault(channel, [])
        if any(abs(gps_ns - at) <= SAME_NS for at in recent):
            self.counters["marks_duplicate"] += 1
            return []
        recent.append(gps_ns)
        del recent[:-16]
        valid = valid and self.is_near_navigation(gps_ns)
        self.counters["marks"] += 1
        count = self._counts[channel] = (self._counts[channel] + 1) % (1 << COUNT_BITS)
        return [
            EventMark(self.receiver, channel, gps_ns, accuracy_ns, count, NO_COUNT, valid, mono_ns)
        ]

    def _on_mark_position(self, channel: int, gps_ns: int, mono_ns: int) -> None:
        valid = self._time_good and gps_ns >= WEEK_NS
        accuracy_ns = max(self._mark_accuracy_ns, POSITION_MARK_ACCURACY_NS)
        mark = EventMark(self.receiver, channel, gps_ns, accuracy_ns, 0, NO_COUNT, valid, mono_ns)
        self._position_marks.append((channel, mark))

    def _coarse_marks(self, header_ns: int) -> list[Nav]:
        """Marks of MARKxPOS for whose edge no better one has come."""
        coarse: list[Nav] = []
        while self._position_marks:
            channel, mark = self._position_marks[0]
            if header_ns - mark.gps_ns < POSITION_MARK_DELAY_NS:
                break
            self._position_marks.popleft()
            recent = self._marks.setdefault(channel, [])
            if any(abs(mark.gps_ns - at) <= POSITION_MARK_ACCURACY_NS for at in recent):
                continue
            recent.append(mark.gps_ns)
            del recent[:-16]
            self.counters["marks"] += 1
            self.counters["marks_coarse"] += 1
            count = self._counts[channel] = (self._counts[channel] + 1) % (1 << COUNT_BITS)
            valid = mark.time_valid and self.is_near_navigation(mark.gps_ns)
            coarse.append(replace(mark, count=count, time_valid=valid))
        return coarse


def _input_of(name: str) -> int:
    """The mark input of a log; MARKTIME and MARKPOS are of the first one."""
    return int(name[4]) if name[4].isdigit() else 1


def _fix(status: object, kind: object) -> str:
    """The fix of a BESTPOS, by its solution status and position type."""
    if status not in COMPUTED:
        return "none"
    if kind in TIME_ONLY:
        return "time"
    return "2d" if kind in HEIGHT_IS_FIXED else "3d"


def _values(name: str, body: bytes | list[str]) -> tuple[Any, ...]:
    is_mark_time = name.endswith("TIME")
    name = "BESTPOS" if name.endswith("POS") else name
    if isinstance(body, bytes):
        return LAYOUTS.get(name, _MARKTIME if is_mark_time else _PVA).unpack_from(body)
    kinds = ASCII_KINDS.get(name, ASCII_MARKTIME if is_mark_time else ASCII_PVA)
    if len(body) < len(kinds):
        raise ValueError(f"{name} has {len(body)} words; {len(kinds)} are needed")
    return tuple(_READ[kind](text) for kind, text in zip(kinds, body, strict=False) if kind != "-")


def _enumerated(text: str) -> int | str:
    """A word of an enumeration; its number where the receiver has no word for it."""
    return int(text) if text.isascii() and text.isdigit() else text


_READ: Final = {"i": parse_integer, "f": parse_decimal, "w": _enumerated}


def _gps_ns(week: int, seconds: float) -> int:
    return _gps_of(week, round(seconds * 1e9))


def _header_ns(log: NovatelLog) -> int:
    return _gps_of(log.week, log.tow_ns)


def _gps_of(week: int, tow_ns: int) -> int:
    if not (0 <= week < 65_536 and 0 <= tow_ns <= WEEK_NS):
        raise ValueError(f"week {week} or time of week {tow_ns} ns out of range")
    return week * WEEK_NS + tow_ns
