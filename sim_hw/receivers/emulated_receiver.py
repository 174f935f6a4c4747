"""Base of the emulated GNSS receivers: epochs, the receiver's own clock, strobe edges.

The messages of each kind of receiver are in its own file.
"""

from __future__ import annotations

import random
import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar

from sim_hw.devices.device_loop import DeviceLine, LineDevice
from sim_hw.devices.pseudo_terminal import PseudoTerminal
from sim_hw.faults.catalogue import MARK, NAVIGATION
from sim_hw.world.world_clock import LEAP_SECONDS, NS_PER_S, WorldClock

STROBE_WIDTH_NS = 50_000
"""From the rising to the falling edge of a strobe."""
LATENCY_NS = (30_000_000, 80_000_000)
"""From the epoch to its bytes on the serial line: computing and the line itself."""
EVENT_LATENCY_NS = (8_000_000, 30_000_000)
"""Likewise from an edge, where the receiver reports it immediately."""
CLOCK_DRIFT_PPM = 0.2
BOOT_NS = 3 * NS_PER_S
"""From power on to the first position."""
STEP_NS = 2 * NS_PER_S
"""An epoch so far from now was planned by a clock that has stepped since."""


@dataclass(frozen=True)
class ReceiverState:
    """The state that the receiver reports at one instant.

    Geographic coordinates in WGS 84, height above the ellipsoid, velocity north, east, down.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float
    velocity_ned_mps: tuple[float, float, float]
    roll_deg: float
    pitch_deg: float
    heading_deg: float


@dataclass(frozen=True)
class ReceiverAccuracy:
    """What the receiver believes of its own standard deviations."""

    horizontal_m: float = 0.02
    vertical_m: float = 0.03
    speed_mps: float = 0.03
    roll_pitch_deg: float = 0.02
    heading_deg: float = 0.05
    time_ns: int = 20
    mark_ns: int = 25


@dataclass(frozen=True)
class Edge:
    """One edge of a strobe; `number` counts the strobes since the receiver was switched on."""

    gps_ns: int
    is_rising: bool
    number: int


class EmulatedReceiver(LineDevice):
    """A receiver that keeps time by the world clock and reports the result of `state`.

    `state` maps a GPS time in ns to what the receiver reports for it: noise is the caller's.
    Epochs are whole periods of the receiver's own clock, which is off GPS by `bias_ns`: a slow
    saw-tooth within `clock_bias_max_ns`. Unless `sends_events_immediately`, edges wait for the
    epoch after them. With `is_active_low` strobes fall first and rise at their end.
    """

    sends_events_immediately: ClassVar[bool] = True
    clock_bias_max_ns: ClassVar[int] = 0

    def __init__(
        self,
        clock: WorldClock,
        state: Callable[[int], ReceiverState],
        rate_hz: float = 5.0,
        leap_seconds: int = LEAP_SECONDS,
        seed: int = 0,
        accuracy: ReceiverAccuracy = ReceiverAccuracy(),
        first_edge_count: int = 0,
        line: DeviceLine | None = None,
        is_active_low: bool = False,
    ) -> None:
        super().__init__(type(self).__name__, line or PseudoTerminal())
        self.clock = clock
        self.state = state
        self.leap_seconds = leap_seconds
        self.accuracy = accuracy
        self.random = random.Random(seed)
        self._is_active_low = is_active_low
        self._period_ns = round(NS_PER_S / rate_hz)
        widest_ns = self.clock_bias_max_ns
        self._bias_at_start_ns = self.random.randrange(-widest_ns, widest_ns) if widest_ns else 0
        self._edges: list[Edge] = []
        self._edge_count = first_edge_count
        self._lock = threading.Lock()
        self._epoch_ns: int | None = None
        self._epoch_due_ns = 0
        self._event_latency_ns = 0
        self._last_event_due_ns = 0
        self._silent_until_ns = 0
        self._topic = NAVIGATION

    @abstractmethod
    def epoch_bytes(self, epoch_gps_ns: int) -> bytes:
        """All messages of the receiver for one epoch, at that GPS time."""

    def event_bytes(self, edge: Edge) -> bytes:
        """The messages of the receiver for one edge, if it reports edges immediately."""
        return b""

    def mark(self, gps_ns: int) -> None:
        """The first edge of a strobe at that GPS time; from any thread.

        It may be announced before it happens.
        """
        with self._lock:
            self._edge_count += 1
            number = self._edge_count
            self._edges += [
                Edge(gps_ns, not self._is_active_low, number),
                Edge(gps_ns + STROBE_WIDTH_NS, self._is_active_low, number),
            ]
            self._edges.sort(key=lambda edge: edge.gps_ns)

    def take_edges(self, until_gps_ns: int) -> list[Edge]:
        """The edges up to a GPS time, in their order; they are used up."""
        with self._lock:
            due = [edge for edge in self._edges if edge.gps_ns <= until_gps_ns]
            self._edges = [edge for edge in self._edges if edge.gps_ns > until_gps_ns]
        self.counts["marks"] += sum(edge.is_rising for edge in due)
        return due

    def bias_ns(self, nominal_gps_ns: int) -> int:
        """True time of an epoch less the time by the receiver's own clock."""
        widest_ns = self.clock_bias_max_ns
        if not widest_ns:
            return 0
        elapsed_ns = nominal_gps_ns - self.clock.gps_ns_at_start
        drifted_ns = self._bias_at_start_ns + round(elapsed_ns * CLOCK_DRIFT_PPM * 1e-6)
        return (drifted_ns + widest_ns) % (2 * widest_ns) - widest_ns

    def epoch_after(self, gps_ns: int) -> int:
        """GPS time of the first epoch later than a GPS time."""
        nominal_ns = (gps_ns // self._period_ns - 1) * self._period_ns
        while (epoch_ns := nominal_ns + self.bias_ns(nominal_ns)) <= gps_ns:
            nominal_ns += self._period_ns
        return epoch_ns

    def nominal_ns(self, epoch_gps_ns: int) -> int:
        """The reading of the receiver's own clock at an epoch: a multiple of the period."""
        return (epoch_gps_ns + self._period_ns // 2) // self._period_ns * self._period_ns

    def is_first_of_second(self, epoch_gps_ns: int) -> bool:
        return self.nominal_ns(epoch_gps_ns) % NS_PER_S < self._period_ns

    def statistics(self) -> Mapping[str, int]:
        return {
            **super().statistics(),
            **{name: self.counts[name] for name in ("epochs", "marks", "mark_messages")},
        }

    # Faults

    def parts(self, data: bytes) -> list[tuple[str, bytes]]:
        return [(self._topic, data)]

    def restart_count(self) -> None:
        with self._lock:
            self._edge_count = 0

    def restart(self) -> None:
        with self._lock:
            self._edge_count = 0
            self._edges.clear()
        self._silent_until_ns = time.monotonic_ns() + BOOT_NS

    # Turns: epochs, and edges between them

    def due_mono_ns(self) -> int:
        now_ns = time.monotonic_ns()
        has_stepped = abs(self._epoch_due_ns - now_ns) > STEP_NS + self._period_ns
        if self._epoch_ns is None or has_stepped:
            # The first epoch, or the receiver's clock is not what it was.
            self._plan_epoch(self.clock.gps_ns(now_ns))
        edge_due_ns = self._edge_due_ns()
        return self._epoch_due_ns if edge_due_ns is None else min(edge_due_ns, self._epoch_due_ns)

    def emit_due(self) -> bytes:
        edge_due_ns = self._edge_due_ns()
        if edge_due_ns is not None and edge_due_ns < self._epoch_due_ns:
            with self._lock:
                edge = self._edges.pop(0)
            self.counts["marks"] += edge.is_rising
            self._event_latency_ns, self._last_event_due_ns = 0, edge_due_ns
            self._topic = MARK
            return self.event_bytes(edge)
        assert self._epoch_ns is not None
        self._topic = NAVIGATION
        data = self.epoch_bytes(self._epoch_ns)
        self.counts["epochs"] += 1
        self._plan_epoch(self._epoch_ns)
        return data if time.monotonic_ns() >= self._silent_until_ns else b""

    def _plan_epoch(self, after_gps_ns: int) -> None:
        self._epoch_ns = self.epoch_after(after_gps_ns)
        self._epoch_due_ns = self.clock.mono_ns(self._epoch_ns) + self.random.randrange(*LATENCY_NS)

    def _edge_due_ns(self) -> int | None:
        if not self.sends_events_immediately:
            return None
        with self._lock:
            if not self._edges:
                return None
            first_ns = self._edges[0].gps_ns
        if not self._event_latency_ns:
            self._event_latency_ns = self.random.randrange(*EVENT_LATENCY_NS)
        due_ns = self.clock.mono_ns(first_ns) + self._event_latency_ns
        return max(due_ns, self._last_event_due_ns)
