"""UBX messages into records: bytes in, NavSample and EventMark out, no I/O and no clock.

Framing is in `drivers.receivers.ublox.framing`, the arithmetic of time in
`drivers.timescales.gps_time`; parsing of a single message is pyubx2's.

Source: u-blox M8 receiver description UBX-13003221, sections 32.17 (NAV), 32.19 (TIM), HNR.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Final

from pyubx2 import UBXMessageError, UBXParseError, UBXReader, UBXStreamError, UBXTypeError

from drivers.contract import POSITION_FIXES, EventMark, NavSample
from drivers.receivers.message_decoder import MessageDecoder, Nav
from drivers.receivers.ublox.framing import UbxFramer
from drivers.timescales.gps_time import (
    RECENT_NS,
    SECOND_NS,
    WEEK_NS,
    UtcFields,
    gps_from_utc,
    gps_near,
    utc_ns,
)

LENGTHS: Final = {
    (0x01, 0x05): 32,  # NAV-ATT
    (0x01, 0x07): 92,  # NAV-PVT, protocol 15 and later
    (0x01, 0x20): 16,  # NAV-TIMEGPS
    (0x01, 0x26): 24,  # NAV-TIMELS
    (0x01, 0x61): 4,  # NAV-EOE
    (0x0D, 0x03): 28,  # TIM-TM2
    (0x28, 0x01): 32,  # HNR-ATT
}
FIXES: Final = {0: "none", 1: "dead-reckoning", 2: "2d", 3: "3d", 4: "3d", 5: "time"}
TIME_BASE_RECEIVER: Final = 0
TIME_BASE_UTC: Final = 2
# Quirk: an M8T reports 255, "unknown", for leap seconds that it received. Only 0 means a default.
# Upstream: no report known (2026-11-23).
LEAP_SOURCE_DEFAULT: Final = 0
"""Of NAV-TIMELS: the firmware's own guess."""
ATTITUDE_HISTORY_LENGTH: Final = 64
ACCURACY_UNKNOWN: Final = 0xFFFFFFFF
"""What hAcc, vAcc and sAcc hold before the receiver can estimate them."""


class UbxDecoder(MessageDecoder):
    """Decodes what a u-blox receiver sends.

    NAV-PVT becomes a NavSample; NAV-ATT or HNR-ATT of the same iTOW gives its attitude. TIM-TM2
    becomes an EventMark where it has a new edge of the kind `edge`. NAV-TIMEGPS and NAV-TIMELS
    give week and leap seconds. Everything else is framed and left alone. Nothing that is fed
    raises.
    """

    # Quirk: pyubx2 raises KeyError and AttributeError for some contents, not only its own errors.
    # Upstream: semuconsulting/pyubx2#79, semuconsulting/pyubx2#109.
    decode_errors = (
        UBXMessageError,
        UBXParseError,
        UBXStreamError,
        UBXTypeError,
        AttributeError,
        ValueError,
        KeyError,
    )

    def __init__(self, receiver: str, *, edge: str = "rising") -> None:
        self._ubx = UbxFramer(LENGTHS)
        super().__init__(receiver, self._ubx, ("samples", "marks", "marks_other_edge", "marks_far"))
        self._is_falling = edge == "falling"
        self._leap_is_default = False
        self._timegps_ns: int | None = None
        self._attitudes: deque[tuple[int, tuple[float, float, float]]] = deque(
            maxlen=ATTITUDE_HISTORY_LENGTH
        )
        self._attitude_follows = False
        self._without_attitude: int | None = None
        self._held: tuple[Any, int] | None = None
        self._handlers: Mapping[str, Callable[[Any, int], list[Nav]]] = {
            "NAV-PVT": self._on_pvt,
            "NAV-ATT": self._on_attitude,
            "HNR-ATT": self._on_attitude,
            "NAV-TIMEGPS": self._on_timegps,
            "NAV-TIMELS": self._on_timels,
            "NAV-EOE": self._on_end_of_epoch,
            "TIM-TM2": self._on_mark,
        }

    @property
    def other_bytes(self) -> int:
        """Bytes of text: NMEA and the like."""
        return self._ubx.other_bytes

    def reset(self) -> None:
        super().reset()
        self._held = None
        self._attitudes.clear()

    def on_message(self, message: bytes, mono_ns: int) -> list[Nav]:
        if (message[2], message[3]) not in LENGTHS:
            return []
        parsed = UBXReader.parse(message)
        identity = str(parsed.identity)
        decoded = self._handlers[identity](parsed, mono_ns)
        self.seen[identity] += 1
        return decoded

    # Navigation

    def _on_pvt(self, message: Any, mono_ns: int) -> list[Nav]:
        released = self._release()
        if self._attitude_follows and self._attitude_at(message.iTOW) is None:
            self._held = (message, mono_ns)
            return released
        return [*released, self._sample(message, mono_ns)]

    def _on_attitude(self, message: Any, _mono_ns: int) -> list[Nav]:
        itow = int(message.iTOW)
        degrees = (message.roll, message.pitch, message.heading)
        roll, pitch, heading = (math.radians(angle) for angle in degrees)
        self._attitudes.append((itow, (roll, pitch, heading)))
        # A receiver whose attitude comes after the position of the same epoch is waited for from
        # now on; one that sends it before, or none, costs no delay.
        if itow == self._without_attitude:
            self._attitude_follows = True
        if self._held is not None and self._held[0].iTOW == itow:
            return self._release()
        return []

    def _on_end_of_epoch(self, message: Any, _mono_ns: int) -> list[Nav]:
        if self._held is not None and self._held[0].iTOW == message.iTOW:
            return self._release()
        return []

    def _release(self) -> list[Nav]:
        if self._held is None:
            return []
        (message, mono_ns), self._held = self._held, None
        return [self._sample(message, mono_ns)]

    def _attitude_at(self, itow: int) -> tuple[float, float, float] | None:
        return next((angles for at, angles in self._attitudes if at == itow), None)

    def _sample(self, message: Any, mono_ns: int) -> NavSample:
        gps_ns, time_valid = self._gps_of(message)
        attitude = self._attitude_at(message.iTOW)
        self._without_attitude = message.iTOW if attitude is None else None
        roll, pitch, heading = attitude or (None, None, None)
        usable = bool(message.gnssFixOk) and not message.invalidLlh
        fix = FIXES.get(message.fixType, "none") if usable else "none"
        has_position = fix in POSITION_FIXES
        # In a 2d fix the height is one that the receiver holds, not one that it measured.
        has_height = has_position and fix != "2d"
        velocity = (message.velN * 1e-3, message.velE * 1e-3, message.velD * 1e-3)
        self.counters["samples"] += 1
        return NavSample(
            receiver=self.receiver,
            gps_ns=gps_ns,
            mono_ns=mono_ns,
            fix=fix,
            satellites=int(message.numSV),
            latitude_deg=float(message.lat) if has_position else None,
            longitude_deg=float(message.lon) if has_position else None,
            height_m=message.height * 1e-3 if has_height else None,
            horizontal_sigma_m=_accuracy(message.hAcc) if has_position else None,
            vertical_sigma_m=_accuracy(message.vAcc) if has_height else None,
            velocity_ned_mps=velocity if has_position else None,
            speed_sigma_mps=_accuracy(message.sAcc) if has_position else None,
            roll_rad=roll,
            pitch_rad=pitch,
            heading_rad=heading,
            leap_seconds=self._leap,
            time_valid=time_valid,
        )

    def _gps_of(self, message: Any) -> tuple[int, bool]:
        """GPS time of a NAV-PVT, and whether it can be trusted."""
        fields = UtcFields(
            year=message.year,
            month=message.month,
            day=message.day,
            hour=message.hour,
            minute=message.min,
            second=message.second,
            nano=message.nano,
        )
        utc = utc_ns(fields)
        both = None if utc is None else gps_from_utc(utc, message.iTOW)
        if both is not None and message.validDate and message.validTime and message.fullyResolved:
            gps_ns, leap = both
            if not self._leap_is_default:
                self._leap = leap
            self._gps_ns = gps_ns
            return gps_ns, True
        if self._timegps_ns is not None:
            # UTC is not resolved yet, but NAV-TIMEGPS has just reported week and time of week.
            gps_ns = gps_near(message.iTOW, self._timegps_ns)
            return gps_ns, abs(gps_ns - self._timegps_ns) < RECENT_NS
        return (both[0] if both else message.iTOW * 1_000_000), False

    # Time

    def _on_timegps(self, message: Any, _mono_ns: int) -> list[Nav]:
        if message.towValid and message.weekValid:
            gps_ns = message.week * WEEK_NS + message.iTOW * 1_000_000 + message.fTOW
            self._gps_ns = self._timegps_ns = gps_ns
        else:
            self._timegps_ns = None
        if message.leapSValid and not self._leap_is_default:
            self._leap = int(message.leapS)
        return []

    def _on_timels(self, message: Any, _mono_ns: int) -> list[Nav]:
        self._leap_is_default = message.srcOfCurrLs == LEAP_SOURCE_DEFAULT
        known = message.validCurrLs and not self._leap_is_default
        self._leap = int(message.currLs) if known else None
        return []

    # Marks

    def _on_mark(self, message: Any, mono_ns: int) -> list[Nav]:
        if self._is_falling:
            is_new, is_other = message.newFallingEdge, message.newRisingEdge
            week, tow_ms, sub_ms_ns = message.wnF, message.towMsF, message.towSubMsF
        else:
            is_new, is_other = message.newRisingEdge, message.newFallingEdge
            week, tow_ms, sub_ms_ns = message.wnR, message.towMsR, message.towSubMsR
        if not is_new:
            self.counters["marks_other_edge"] += is_other
            self.other_edges += is_other
            return []
        self.other_edges = 0
        gps_ns = week * WEEK_NS + tow_ms * 1_000_000 + sub_ms_ns
        valid = bool(message.time) and message.timeBase != TIME_BASE_RECEIVER
        if message.timeBase == TIME_BASE_UTC:
            valid = valid and self._leap is not None
            gps_ns += (self._leap or 0) * SECOND_NS
        valid = valid and self.is_near_navigation(gps_ns)
        self.counters["marks"] += 1
        return [
            EventMark(
                receiver=self.receiver,
                channel=int(message.ch),
                gps_ns=gps_ns,
                accuracy_ns=int(message.accEst),
                count=int(message.count),
                # Quirk: the receiver counts rising edges only; falling ones have no count.
                # Upstream: manual: UBX-13003221, section 32.19, UBX-TIM-TM2, count.
                count_bits=0 if self._is_falling else 16,
                time_valid=valid,
                mono_ns=mono_ns,
            )
        ]


def _accuracy(value: int) -> float | None:
    """Metres, or metres per second, of an accuracy in mm; None where the receiver states none."""
    return None if value == ACCURACY_UNKNOWN else value * 1e-3
