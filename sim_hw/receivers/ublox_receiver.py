"""An emulated u-blox receiver with event input.

Its messages are encoded in `ublox_messages`; epochs and edges are those of every receiver.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

from sim_hw.faults.catalogue import MARK, NAVIGATION
from sim_hw.receivers.emulated_receiver import (
    LATENCY_NS,
    STROBE_WIDTH_NS,
    EmulatedReceiver,
    ReceiverAccuracy,
    ReceiverState,
)
from sim_hw.receivers.nmea_sentences import gga, rmc
from sim_hw.receivers.ublox_messages import (
    Satellite,
    mon_ver,
    nav_att,
    nav_pvt,
    nav_sat,
    nav_timegps,
    nav_timels,
    tim_tm2,
)
from sim_hw.world.world_clock import WorldClock

__all__ = ["LATENCY_NS", "STROBE_WIDTH_NS", "ReceiverAccuracy", "ReceiverState", "UbloxReceiver"]

TIM_TM2 = b"\xb5\x62\x0d\x03"
CLOCK_BIAS_MAX_NS = 500_000
"""The receiver steers its epochs to whole ms of GPS time and misses by up to half of one."""

_SATELLITES = (
    Satellite(0, 5, 47, 71, 120),
    Satellite(0, 13, 45, 52, 201),
    Satellite(0, 15, 44, 48, 288),
    Satellite(0, 18, 42, 33, 66),
    Satellite(0, 23, 41, 27, 322),
    Satellite(0, 24, 39, 21, 140),
    Satellite(2, 2, 46, 66, 15),
    Satellite(2, 7, 44, 49, 250),
    Satellite(2, 8, 41, 30, 178),
    Satellite(2, 30, 38, 19, 95),
    Satellite(6, 1, 45, 58, 340),
    Satellite(6, 8, 43, 44, 48),
    Satellite(6, 23, 40, 29, 225),
    Satellite(6, 24, 36, 17, 300),
)


class UbloxReceiver(EmulatedReceiver):
    """The receiver, from `start()` to `close()`; a host opens `port`.

    `chatter` adds other messages of a real stream: NMEA, NAV-SAT, MON-VER. Marks are sent with the
    epoch after them, the last edge of each kind only. Whatever the host writes is discarded.
    """

    sends_events_immediately: ClassVar[bool] = False
    clock_bias_max_ns: ClassVar[int] = CLOCK_BIAS_MAX_NS

    def __init__(
        self,
        clock: WorldClock,
        state: Callable[[int], ReceiverState],
        *,
        chatter: bool = True,
        **settings: Any,
    ) -> None:
        super().__init__(clock, state, **settings)
        self._chatter = chatter
        self._has_sent_version = False
        self._rising_count = self._edge_count
        self._last_rising_ns = 0
        self._last_falling_ns = 0

    def epoch_bytes(self, epoch_gps_ns: int) -> bytes:
        """All messages of the receiver for one epoch; edges up to it are consumed."""
        state = self.state(epoch_gps_ns)
        accuracy, leap_seconds = self.accuracy, self.leap_seconds
        satellites = len(_SATELLITES)
        is_first_of_second = self.is_first_of_second(epoch_gps_ns)
        parts = []
        if self._chatter:
            parts += [
                rmc(epoch_gps_ns, state, leap_seconds),
                gga(epoch_gps_ns, state, satellites, leap_seconds),
            ]
        parts.append(nav_pvt(epoch_gps_ns, state, accuracy, satellites, leap_seconds))
        parts.append(nav_att(epoch_gps_ns, state, accuracy))
        parts.append(nav_timegps(epoch_gps_ns, accuracy, leap_seconds))
        if is_first_of_second:
            parts.append(nav_timels(epoch_gps_ns, leap_seconds))
        if self._chatter and is_first_of_second:
            parts.append(nav_sat(epoch_gps_ns, _SATELLITES))
        if self._chatter and not self._has_sent_version:
            self._has_sent_version = True
            parts.append(
                mon_ver("EXT CORE 1.00 (emulated)", "00190000", ("PROTVER=33.20", "MOD=EMULATED"))
            )
        parts.append(self._mark_message(epoch_gps_ns))
        return b"".join(parts)

    def parts(self, data: bytes) -> list[tuple[str, bytes]]:
        """The mark is the last message of its epoch."""
        begin = data.find(TIM_TM2)
        if begin < 0:
            return super().parts(data)
        return [(NAVIGATION, data[:begin]), (MARK, data[begin:])]

    def _mark_message(self, epoch_gps_ns: int) -> bytes:
        """TIM-TM2 for the edges since the last epoch: only the last of each kind is reported."""
        due = self.take_edges(epoch_gps_ns)
        if not due:
            return b""
        rising = [edge.gps_ns for edge in due if edge.is_rising]
        falling = [edge.gps_ns for edge in due if not edge.is_rising]
        self._rising_count = max(
            (edge.number for edge in due if edge.is_rising), default=self._rising_count
        )
        self.counts["mark_messages"] += 1
        self._last_rising_ns = rising[-1] if rising else self._last_rising_ns
        self._last_falling_ns = falling[-1] if falling else self._last_falling_ns
        return tim_tm2(
            rising_gps_ns=self._last_rising_ns,
            falling_gps_ns=self._last_falling_ns,
            is_new_rising=bool(rising),
            is_new_falling=bool(falling),
            rising_count=self._rising_count,
            accuracy_ns=self.accuracy.mark_ns,
        )
