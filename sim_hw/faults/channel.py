"""The effect of one device's faults on its messages: pure functions of the instants passed in.

The same channel is used behind the sockets and pseudo-terminals of the wire emulators and behind
the devices of the fake clock. Only `Damage` depends on the type of a message, bytes or a frame.
"""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from sim_hw.faults.catalogue import CATALOGUE
from sim_hw.faults.plan import PlannedFault
from sim_hw.world.world_clock import NS_PER_S, NS_PER_WEEK

T = TypeVar("T")

FLOOD_PERIOD_NS = 100_000_000
"""Interval between the unsolicited messages of a flooding device."""
DUPLICATE_AFTER_NS = 1_000_000
REORDER_TIMEOUT_NS = 5_000_000
NOTIFY_INTERVAL_NS = 5 * NS_PER_S
"""A fault that applies again after this time is reported again."""
RECORD_INTERVAL_NS = NS_PER_S // 2
"""A fault that lasts is a hit so often."""


class Damage(Protocol[T]):
    """How a message is damaged."""

    def corrupt(self, message: T, rng: random.Random) -> T:
        """With wrong content: same length, other bits; or a frame of another size."""

    def truncated(self, message: T, rng: random.Random) -> T:
        """Broken off somewhere."""

    def first_half(self, message: T) -> T:
        """Its first half only."""


class BytesDamage:
    """Damage to messages given as bytes."""

    def corrupt(self, message: bytes, rng: random.Random) -> bytes:
        damaged = bytearray(message)
        for _ in range(rng.randint(1, 8)):
            if damaged:
                damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        return bytes(damaged)

    def truncated(self, message: bytes, rng: random.Random) -> bytes:
        return message[: rng.randrange(max(len(message), 1))]

    def first_half(self, message: bytes) -> bytes:
        return message[: len(message) // 2]


@dataclass(frozen=True)
class Delivery(Generic[T]):
    """A message that goes out at `at_ns`."""

    at_ns: int
    message: T


@dataclass(frozen=True)
class FaultOccurrence:
    """A fault did something: `what` is the message's own name, or "" where it hit the device."""

    fault: str
    at_ns: int
    what: str = ""


@dataclass
class _ArmedFault:
    planned: PlannedFault
    begins_ns: int | None = None
    is_spent: bool = False
    was_on: bool = False

    def is_on(self, now_ns: int) -> bool:
        if self.begins_ns is None or now_ns < self.begins_ns or self.is_spent:
            return False
        duration_s = self.planned.duration_s
        return duration_s is None or now_ns < self.begins_ns + round(duration_s * NS_PER_S)


class Channel(Generic[T]):
    """The way out of one device, with its faults.

    Times are ns of the caller's clock. `begin` sets time zero; `pulse` reports a
    pulse of the trigger unit, for faults that begin with one. From any thread.
    """

    def __init__(
        self,
        planned: Iterable[PlannedFault],
        damage: Damage[T],
        *,
        seed: int | str,
        report: Callable[[str], None] | None = None,
    ) -> None:
        self._armed = [_ArmedFault(fault) for fault in planned]
        self._damage = damage
        self._rng = random.Random(f"faults-{seed}")
        self._lock = threading.RLock()
        self._last: dict[str, T] = {}
        self._reordered: list[tuple[str, T]] = []
        self._next_flood_ns = 0
        self._report = report
        self._recorded_ns: dict[str, int] = {}
        self.occurrences: list[FaultOccurrence] = []

    @property
    def is_faultless(self) -> bool:
        """Whether nothing is planned here."""
        return not self._armed

    def begin(self, now_ns: int) -> None:
        """The devices are ready: seconds of the plan count from here."""
        with self._lock:
            for armed in self._armed:
                if armed.planned.at_s is not None:
                    armed.begins_ns = now_ns + round(armed.planned.at_s * NS_PER_S)

    def add(self, planned: Iterable[PlannedFault], now_ns: int) -> None:
        """Plan further faults, their seconds counted from `now_ns`."""
        with self._lock:
            for fault in planned:
                begins_ns = None if fault.at_s is None else now_ns + round(fault.at_s * NS_PER_S)
                self._armed.append(_ArmedFault(fault, begins_ns))

    def pulse(self, count: int, now_ns: int) -> None:
        """The trigger unit gives pulse `count`."""
        with self._lock:
            for armed in self._armed:
                if armed.begins_ns is None and armed.planned.at_pulse == count:
                    armed.begins_ns = now_ns

    # What the device asks of its own state

    def is_connected(self, now_ns: int) -> bool:
        """Whether power and cable are as they should be."""
        return not (
            self._is_on("cable-pulled", now_ns, note=True)
            or self._is_on("power-cycle", now_ns, note=True)
        )

    def is_silent(self, now_ns: int) -> bool:
        """Whether the device sends nothing although it is connected."""
        return self._is_on("silent", now_ns, note=True)

    def is_powered(self, now_ns: int) -> bool:
        """Whether the power is on."""
        return not self._is_on("power-cycle", now_ns)

    def has_power_cycled(self, now_ns: int) -> bool:
        """True once after each power cycle: counts, clocks and settings are to be as new."""
        return self._ended_once("power-cycle", now_ns)

    def counter_restarts(self, now_ns: int) -> bool:
        """True once for each counter-reset."""
        with self._lock:
            for armed in self._armed:
                if armed.planned.name == "counter-reset" and armed.is_on(now_ns):
                    armed.is_spent = True
                    self._record("counter-reset", now_ns)
                    return True
        return False

    def sensor_is_open(self, now_ns: int) -> bool:
        """Whether the probes' wires are broken."""
        return self._is_on("open-sensor", now_ns, note=True)

    def clock_error_ns(self, now_ns: int) -> int:
        """How far the device's clock is ahead of what it would be."""
        error_ns = 0
        with self._lock:
            for armed in self._armed:
                fault = armed.planned
                if fault.kind.level != "clock" or armed.begins_ns is None:
                    continue
                is_on = armed.is_on(now_ns)
                # A step is one at its beginning and at its end, a wrong week as long as it lasts.
                if is_on != armed.was_on or (is_on and fault.name == "wrong-week"):
                    armed.was_on = is_on
                    self._record(fault.name, now_ns)
                if not is_on:
                    continue
                if fault.name == "clock-step":
                    error_ns += round(fault.amount * NS_PER_S)
                elif fault.name == "wrong-week":
                    error_ns += int(fault.amount) * NS_PER_WEEK
                else:
                    error_ns += round((now_ns - armed.begins_ns) * fault.amount * 1e-6)
        return error_ns

    def flood_is_due(self, now_ns: int) -> bool:
        """Whether an unsolicited message is due now."""
        if not self._is_on("flooding", now_ns, note=True) or now_ns < self._next_flood_ns:
            return False
        self._next_flood_ns = now_ns + FLOOD_PERIOD_NS
        return self.is_connected(now_ns)

    def noise(self, length: int) -> bytes:
        """Bytes of a flood."""
        return self._rng.randbytes(length)

    # What becomes of a message

    def send(
        self, message: T, now_ns: int, *, topic: str = "", what: str = ""
    ) -> list[Delivery[T]]:
        """What goes out, and when, for a message that is sent now.

        `topic` is what kind of message it is, `what` its own name for `hits`.
        """
        with self._lock:
            released = [
                Delivery(now_ns + REORDER_TIMEOUT_NS, m)
                for _, m in self._reordered
                if m is not message
            ]
            self._reordered.clear()
            for name in ("cable-pulled", "power-cycle", "silent"):
                if self._is_on(name, now_ns):
                    self._record(name, now_ns, what)
                    return []
            return [*self._sent(message, now_ns, topic, what), *released]

    def _sent(self, message: T, now_ns: int, topic: str, what: str) -> list[Delivery[T]]:
        # Here `silent` suppresses some topics; a silent device does not get here.
        if self._take("silent", now_ns, topic, what) is not None:
            return []
        last = self._last.get(topic)
        if self._take("stuck", now_ns, topic, what) is not None and last is not None:
            message = last
        elif self._take("older-frame", now_ns, topic, what) is not None and last is not None:
            # What was sent last stays the older one for the time this lasts.
            message = last
        else:
            self._last[topic] = message
        if self._take("corrupt", now_ns, topic, what) is not None:
            message = self._damage.corrupt(message, self._rng)
        if self._take("truncated", now_ns, topic, what) is not None:
            message = self._damage.truncated(message, self._rng)
        if self._take("half-frame", now_ns, topic, what) is not None:
            message = self._damage.first_half(message)
        if self._take("lost", now_ns, topic, what) is not None:
            return []
        if self._take("reordered", now_ns, topic, what) is not None:
            self._reordered.append((topic, message))
            return []
        late = self._take("late", now_ns, topic, what)
        at_ns = now_ns + (round(late.amount * NS_PER_S) if late is not None else 0)
        sent = [Delivery(at_ns, message)]
        if self._take("duplicate", now_ns, topic, what) is not None:
            sent.append(Delivery(at_ns + DUPLICATE_AFTER_NS, message))
        return sent

    def _take(self, name: str, now_ns: int, topic: str = "", what: str = "") -> PlannedFault | None:
        """A fault of that name that is on; one without a duration is spent by this."""
        with self._lock:
            for armed in self._armed:
                fault = armed.planned
                if fault.name != name or not armed.is_on(now_ns):
                    continue
                if fault.topic not in ("", topic):
                    continue
                # A frame of an earlier pulse may be delivered after this one was requested.
                if fault.at_pulse is not None and what.isdecimal() and int(what) < fault.at_pulse:
                    continue
                armed.is_spent = fault.duration_s is None
                self._record(name, now_ns, what)
                return fault
        return None

    def _is_on(self, name: str, now_ns: int, *, note: bool = False) -> bool:
        """Whether a fault of the whole device is on; one of some of its messages is not."""
        if not self._armed:
            return False
        with self._lock:
            on = any(
                a.planned.name == name and not a.planned.topic and a.is_on(now_ns)
                for a in self._armed
            )
            if on and note:
                self._record(name, now_ns)
            return on

    def _ended_once(self, name: str, now_ns: int) -> bool:
        with self._lock:
            for armed in self._armed:
                if armed.planned.name != name or armed.begins_ns is None or armed.is_spent:
                    continue
                if now_ns >= armed.begins_ns and not armed.is_on(now_ns):
                    armed.is_spent = True
                    return True
        return False

    def _record(self, name: str, now_ns: int, what: str = "") -> None:
        """Keep a hit; what only lasts is kept once in a while."""
        last_ns = self._recorded_ns.get(name)
        if self._report is not None and (last_ns is None or now_ns - last_ns >= NOTIFY_INTERVAL_NS):
            self._report(f"fault {name}: {CATALOGUE[name].description}")
        if what or last_ns is None or now_ns - last_ns >= RECORD_INTERVAL_NS:
            self._recorded_ns[name] = now_ns
            self.occurrences.append(FaultOccurrence(name, now_ns, what))


def for_device(planned: Sequence[PlannedFault], device: str) -> tuple[PlannedFault, ...]:
    """The faults of one device."""
    return tuple(fault for fault in planned if fault.device == device)
