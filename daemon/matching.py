"""Which frame and which event mark belong to which pulse: by time and by count, never by order.

Pure and revisable: it knows pulses, frames and marks, no exposures and no deadlines. What fits
nothing, or two pulses alike, stays unmatched and is named.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass

from daemon.clock import HostClock
from drivers.contract import EventMark, Frame, FrameStatus

FRAME_WINDOW_NS = 20_000_000
"""How far a frame's start may lie from its pulse: trigger latency of a head, clock drift between
two latches (100 ppm over a minute is 6 ms)."""
MARK_WINDOW_NS = 2_000_000
COUNT_WINDOW_NS = 500_000_000
"""Within this a count decides which pulse a mark is of, where time does not."""
SIGMAS = 5
COARSE_SIGMAS = 2
ARRIVAL_LIMIT_NS = 20_000_000_000
"""A frame without a time of its own belongs to a pulse at most this much earlier."""


class Cause(enum.Enum):
    """What became of a frame or a mark."""

    USED = "used"
    LATE = "late"
    DUPLICATE = "duplicate"
    CORRUPT = "corrupt"
    SPURIOUS = "spurious"


@dataclass(frozen=True)
class Pulse:
    """A pulse that was given, as the matching needs it.

    `mono_ns` with `sigma_ns` is the moment the delays count from; `delays_ns` by cone lead to the
    start of exposure; `strobe_delay_ns` to the mid-exposure of the reference cone, which is what
    the receiver stamps.
    """

    number: int
    mono_ns: int
    sigma_ns: int
    count: int
    delays_ns: Mapping[str, int]
    strobe_delay_ns: int


@dataclass(frozen=True)
class Match:
    """Where a frame or mark belongs: `number` is None where it belongs nowhere."""

    number: int | None
    cause: Cause
    is_ambiguous: bool = False


class Matcher:
    """Matches against the pulses it was told of, until they are forgotten."""

    def __init__(self, cone_of_head: Mapping[str, str], clock: HostClock) -> None:
        self._cone_of_head = cone_of_head
        self._clock = clock
        self._pulses: dict[int, Pulse] = {}
        self._frames: set[tuple[str, int]] = set()
        self._marks: set[int] = set()
        self._counter_offset: dict[str, int] = {}

    def pulse(self, pulse: Pulse) -> None:
        """Note a pulse that was given."""
        self._pulses[pulse.number] = pulse

    def forget_before(self, number: int) -> None:
        """Drop pulses whose frames and marks are counted late by now."""
        for old in [n for n in self._pulses if n < number]:
            del self._pulses[old]
            self._marks.discard(old)
        self._frames = {key for key in self._frames if key[1] >= number}

    def frame(self, frame: Frame) -> Match:
        """The exposure a frame belongs to."""
        if frame.status is not FrameStatus.COMPLETE:
            number = self._pulse_of_frame(frame)
            return Match(number, Cause.CORRUPT)
        number = self._pulse_of_frame(frame)
        if number is None:
            return Match(None, Cause.SPURIOUS)
        if (frame.head, number) in self._frames:
            return Match(number, Cause.DUPLICATE)
        self._frames.add((frame.head, number))
        if frame.counter is not None:
            self._counter_offset[frame.head] = frame.counter - self._pulses[number].count
        return Match(number, Cause.USED)

    def mark(self, mark: EventMark) -> Match:
        """The exposure an event mark belongs to; a used one teaches the host's clock."""
        if not mark.time_valid:
            return Match(None, Cause.CORRUPT)
        modulus = 1 << mark.count_bits
        candidates = self._pulses_near(mark)
        offset = self._counter_offset.get(mark.receiver)
        if len(candidates) != 1 and offset is not None:
            # Time does not decide: the count may, among pulses that time does not exclude.
            near = candidates or self._pulses_near(mark, window_ns=COUNT_WINDOW_NS)
            candidates = [p for p in near if (mark.count - p.count - offset) % modulus == 0]
        if len(candidates) > 1:
            return Match(None, Cause.SPURIOUS, is_ambiguous=True)
        if not candidates:
            return Match(None, Cause.SPURIOUS)
        pulse = candidates[0]
        if pulse.number in self._marks:
            return Match(pulse.number, Cause.DUPLICATE)
        self._marks.add(pulse.number)
        self._counter_offset[mark.receiver] = (mark.count - pulse.count) % modulus
        sigma_ns = pulse.sigma_ns + mark.accuracy_ns
        self._clock.mark_matched(mark.gps_ns, pulse.mono_ns + pulse.strobe_delay_ns, sigma_ns)
        return Match(pulse.number, Cause.USED)

    def _pulse_of_frame(self, frame: Frame) -> int | None:
        start_ns = start_of_exposure_mono_ns(frame)
        cone = self._cone_of_head[frame.head]
        if start_ns is not None:
            near = [
                p.number
                for p in self._pulses.values()
                if abs(p.mono_ns + p.delays_ns[cone] - start_ns) <= FRAME_WINDOW_NS + p.sigma_ns
            ]
            return near[0] if len(near) == 1 else None
        offset = self._counter_offset.get(frame.head)
        if offset is not None and frame.counter is not None:
            counted = [p for p in self._pulses.values() if frame.counter - p.count == offset]
            return counted[0].number if len(counted) == 1 else None
        waiting = [
            p.number
            for p in self._pulses.values()
            if 0 <= frame.mono_ns - p.mono_ns <= ARRIVAL_LIMIT_NS
            and (frame.head, p.number) not in self._frames
        ]
        return waiting[0] if len(waiting) == 1 else None

    def _pulses_near(self, mark: EventMark, *, window_ns: int = 0) -> list[Pulse]:
        """Pulses whose strobe may be this mark; `window_ns` 0 takes what the clock is good for."""
        near = []
        for pulse in self._pulses.values():
            expected = self._clock.gps_at(pulse.mono_ns + pulse.strobe_delay_ns)
            if expected is None:
                continue
            within_ns = window_ns or MARK_WINDOW_NS + SIGMAS * (expected.sigma_ns + pulse.sigma_ns)
            if expected.is_coarse and not window_ns:
                within_ns = COARSE_SIGMAS * expected.sigma_ns
            if abs(mark.gps_ns - expected.gps_ns) <= within_ns:
                near.append(pulse)
        return near


def start_of_exposure_mono_ns(frame: Frame) -> int | None:
    """Start of exposure on the host's clock, through the last latch; None without a latch."""
    if (
        frame.device_ns is None
        or frame.device_clock_ns is None
        or frame.device_clock_mono_ns is None
    ):
        return None
    return frame.device_clock_mono_ns + frame.device_ns - frame.device_clock_ns
