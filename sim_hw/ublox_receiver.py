"""An emulated u-blox receiver with event input, on a pseudo-terminal.

It keeps time by the world clock, reports what `state` says, and stamps the strobe edges it is
given.
"""

from __future__ import annotations

import random
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from sim_hw.pseudo_terminal import PseudoTerminal
from sim_hw.ublox_messages import (
    ReceiverAccuracy,
    ReceiverState,
    Satellite,
    gga,
    itow_ms,
    mon_ver,
    nav_att,
    nav_pvt,
    nav_sat,
    nav_timegps,
    nav_timels,
    rmc,
    tim_tm2,
)
from sim_hw.world_clock import LEAP_SECONDS, NS_PER_S, WorldClock

__all__ = ["ReceiverAccuracy", "ReceiverState", "UbloxReceiver"]

STROBE_WIDTH_NS = 50_000
"""From the rising to the falling edge of a strobe."""

LATENCY_NS = (30_000_000, 80_000_000)
"""From the epoch to its bytes on the serial line: computing and the line itself."""

CLOCK_BIAS_MAX_NS = 500_000
"""The receiver steers its epochs to whole ms of GPS time and misses by up to half of one."""

CLOCK_DRIFT_PPM = 0.2

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
_DRAIN_S = 0.05
_NS_PER_MS = 1_000_000


@dataclass(frozen=True)
class _Edge:
    gps_ns: int
    is_rising: bool


class UbloxReceiver:
    """The receiver, from `start()` to `close()`; a host opens `port`.

    `state` gets a GPS time in ns and says what the receiver reports for it: noise is the caller's.
    `chatter` adds what a real stream holds besides: NMEA, NAV-SAT, MON-VER. Whatever the host
    writes is swallowed; whatever the host does not read is lost and counted.
    """

    def __init__(
        self,
        clock: WorldClock,
        state: Callable[[int], ReceiverState],
        rate_hz: float = 5.0,
        leap_seconds: int = LEAP_SECONDS,
        chatter: bool = True,
        seed: int = 0,
        accuracy: ReceiverAccuracy = ReceiverAccuracy(),  # noqa: B008 - frozen
        first_edge_count: int = 0,
    ) -> None:
        self._clock = clock
        self._state = state
        self._period_ns = round(NS_PER_S / rate_hz)
        self._leap_seconds = leap_seconds
        self._chatter = chatter
        self._accuracy = accuracy
        self._random = random.Random(seed)
        self._bias_at_start_ns = self._random.randrange(-CLOCK_BIAS_MAX_NS, CLOCK_BIAS_MAX_NS)
        self._edges: list[_Edge] = []
        self._rising_count = first_edge_count
        self._last_rising_ns = 0
        self._last_falling_ns = 0
        self._lock = threading.Lock()
        self._terminal = PseudoTerminal()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._counts: Counter[str] = Counter()

    @property
    def port(self) -> str:
        """Path of the serial port a host opens."""
        return self._terminal.port

    def start(self) -> None:
        self._thread = threading.Thread(target=self._run, name="ublox-receiver", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop and unplug. May be called twice."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=5.0)
        self._terminal.close()

    def mark(self, gps_ns: int) -> None:
        """The rising edge of a strobe on EXTINT0 at that GPS time; from any thread.

        It may be announced before it happens; it is reported with the first epoch after it.
        """
        with self._lock:
            self._edges += [_Edge(gps_ns, True), _Edge(gps_ns + STROBE_WIDTH_NS, False)]

    def statistics(self) -> Mapping[str, int]:
        """Counters since creation, by stable name."""
        names = ("epochs", "marks", "mark_messages", "bytes_sent", "bytes_lost", "bytes_swallowed")
        return {name: self._counts[name] for name in names}

    def epoch_after(self, gps_ns: int) -> int:
        """The first navigation epoch later than a GPS time: a whole period, less the clock bias."""
        nominal_ns = (gps_ns // self._period_ns) * self._period_ns
        while (epoch_ns := nominal_ns + self._bias_ns(nominal_ns)) <= gps_ns:
            nominal_ns += self._period_ns
        return epoch_ns

    def epoch_bytes(self, epoch_gps_ns: int) -> bytes:
        """Everything the receiver says for one epoch; edges up to it are used up."""
        state = self._state(epoch_gps_ns)
        accuracy, leap_seconds = self._accuracy, self._leap_seconds
        satellites = len(_SATELLITES)
        is_first_of_second = itow_ms(epoch_gps_ns) % 1000 * _NS_PER_MS < self._period_ns
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
        if self._chatter and self._counts["epochs"] == 0:
            parts.append(
                mon_ver("EXT CORE 1.00 (emulated)", "00190000", ("PROTVER=33.20", "MOD=EMULATED"))
            )
        parts.append(self._mark_message(epoch_gps_ns))
        self._counts["epochs"] += 1
        return b"".join(parts)

    def _mark_message(self, epoch_gps_ns: int) -> bytes:
        """TIM-TM2 for the edges since the last epoch: only the last of each kind is told."""
        with self._lock:
            due = sorted(
                (edge for edge in self._edges if edge.gps_ns <= epoch_gps_ns),
                key=lambda edge: edge.gps_ns,
            )
            self._edges = [edge for edge in self._edges if edge.gps_ns > epoch_gps_ns]
        if not due:
            return b""
        rising = [edge.gps_ns for edge in due if edge.is_rising]
        falling = [edge.gps_ns for edge in due if not edge.is_rising]
        self._rising_count += len(rising)
        self._counts["marks"] += len(rising)
        self._counts["mark_messages"] += 1
        self._last_rising_ns = rising[-1] if rising else self._last_rising_ns
        self._last_falling_ns = falling[-1] if falling else self._last_falling_ns
        return tim_tm2(
            rising_gps_ns=self._last_rising_ns,
            falling_gps_ns=self._last_falling_ns,
            is_new_rising=bool(rising),
            is_new_falling=bool(falling),
            rising_count=self._rising_count,
            accuracy_ns=self._accuracy.mark_ns,
        )

    def _bias_ns(self, nominal_gps_ns: int) -> int:
        """Epoch minus the whole period it is meant for: a slow saw-tooth of 1 ms."""
        elapsed_ns = nominal_gps_ns - self._clock.gps_ns_at_start
        drifted_ns = self._bias_at_start_ns + round(elapsed_ns * CLOCK_DRIFT_PPM * 1e-6)
        return (drifted_ns + CLOCK_BIAS_MAX_NS) % (2 * CLOCK_BIAS_MAX_NS) - CLOCK_BIAS_MAX_NS

    def _run(self) -> None:
        epoch_ns = self.epoch_after(self._clock.gps_ns(time.monotonic_ns()))
        while self._wait_until(self._clock.mono_ns(epoch_ns) + self._random.randrange(*LATENCY_NS)):
            data = self.epoch_bytes(epoch_ns)
            sent = self._terminal.write(data)
            self._counts["bytes_sent"] += sent
            self._counts["bytes_lost"] += len(data) - sent
            epoch_ns = self.epoch_after(epoch_ns)

    def _wait_until(self, mono_ns: int) -> bool:
        """Swallow what the host writes until then. False when it is time to stop."""
        while (left_ns := mono_ns - time.monotonic_ns()) > 0:
            if self._stop.wait(min(left_ns / NS_PER_S, _DRAIN_S)):
                return False
            self._counts["bytes_swallowed"] += len(self._terminal.read(timeout_s=0.0))
        return not self._stop.is_set()
