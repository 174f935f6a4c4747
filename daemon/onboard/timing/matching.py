"""Which frame and which event mark belong to which pulse: by time and by count, never by order.

Pure and revisable: it knows pulses, frames and marks, no deadlines and no disk. What matches no
pulse, or two equally, stays unmatched and is reported. Marks are in
`daemon.onboard.timing.mark_matching`.
"""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

from daemon.onboard.timing.gps_clock import GpsClock
from daemon.onboard.timing.mark_matching import MarkMatcher
from daemon.onboard.timing.pulses import Cause, FiredPulse, MatchResult
from drivers.contract import EventMark, Frame, FrameStatus

__all__ = ["Cause", "FiredPulse", "MatchResult", "Matcher", "start_of_exposure_mono_ns"]

FRAME_WINDOW_NS: Final = 20_000_000
"""How far a frame's start may lie from its pulse: trigger latency of a head, clock drift between
two latches (100 ppm over a minute is 6 ms)."""
ARRIVAL_LIMIT_NS: Final = 20_000_000_000
"""A frame belongs to a pulse at most this much earlier."""
ARRIVAL_TOLERANCE_NS: Final = 400_000_000
"""A frame that arrives so much off the usual is no witness of when it was exposed."""
ARRIVALS_MAX: Final = 16
STARTS_MIN: Final = 5
"""Number of frames that define the usual distance of a head's starts from their pulses."""
STARTS_MAX: Final = 16
START_TOLERANCE_NS: Final = 500_000
LATCH_DRIFT: Final = 1e-4
"""Largest distance from there, in addition to the uncertainty of pulse, latch and time since the
latch."""
STARTS_TO_RELEARN: Final = 3
"""So many unusual starts in succession that agree are the new usual."""
SPURIOUS_MAX: Final = 3
SPURIOUS_WINDOW_NS: Final = 1_500_000_000
"""A head that sent this many unrequested frames within this time is not trusted."""


@dataclass
class _HeadHistory:
    """What is known of one head. `offset`: its counter less the pulses' count."""

    offset: int | None = None
    arrivals_ns: deque[int] = field(default_factory=lambda: deque(maxlen=ARRIVALS_MAX))
    starts_ns: deque[int] = field(default_factory=lambda: deque(maxlen=STARTS_MAX))
    """How much later than by their pulses exposures began, by the head's clock."""
    unusual_starts_ns: deque[int] = field(default_factory=lambda: deque(maxlen=STARTS_TO_RELEARN))
    spurious_ns: deque[int] = field(default_factory=lambda: deque(maxlen=SPURIOUS_MAX))
    """Start times of unrequested exposures."""

    def is_suspect(self, start_ns: int) -> bool:
        """Whether there were so many unrequested frames that one may match by chance."""
        full = len(self.spurious_ns) == SPURIOUS_MAX
        return full and abs(start_ns - self.spurious_ns[0]) < SPURIOUS_WINDOW_NS

    def is_usual_start(self, offset_ns: int, tolerance_ns: int) -> bool:
        """Whether an exposure that began so much later than by its pulse is like those before.

        The usual start is estimated again when unusual ones agree: the delay of a head may have
        changed.
        """
        if len(self.starts_ns) >= STARTS_MIN:
            median_ns = statistics.median(self.starts_ns)
            # 1.4826: from the median absolute deviation to a standard deviation.
            spread_ns = 6 * 1.4826 * statistics.median(abs(s - median_ns) for s in self.starts_ns)
            window_ns = max(START_TOLERANCE_NS, spread_ns) + tolerance_ns
            if abs(offset_ns - median_ns) > window_ns:
                self.unusual_starts_ns.append(offset_ns)
                unusual_ns = self.unusual_starts_ns
                if (
                    len(unusual_ns) < STARTS_TO_RELEARN
                    or max(unusual_ns) - min(unusual_ns) > window_ns
                ):
                    return False
                self.starts_ns.clear()
        self.unusual_starts_ns.clear()
        self.starts_ns.append(offset_ns)
        return True

    @property
    def median_ns(self) -> int | None:
        """From the start of exposure to the arrival of the frame, as a rule."""
        return round(statistics.median(self.arrivals_ns)) if self.arrivals_ns else None


class Matcher:
    """Matches frames and marks with the recorded pulses, until these are dropped.

    A mark's match may be revised until its exposure is sealed (`mark_of` is the present one); a
    frame's is final, since its pixels are stored under the exposure's number.
    """

    def __init__(self, cone_of_head: Mapping[str, str], clock: GpsClock) -> None:
        self._cone_of_head = cone_of_head
        self._pulses: dict[int, FiredPulse] = {}
        self._frames: set[tuple[str, int]] = set()
        self._heads = {head: _HeadHistory() for head in cone_of_head}
        self.marks = MarkMatcher(clock)

    def pulse(self, pulse: FiredPulse) -> None:
        """Note a pulse that was given."""
        self._pulses[pulse.number] = pulse
        self.marks.pulse(pulse)

    def forget_before(self, number: int) -> None:
        """Drop pulses whose frames and marks are counted late by now."""
        for old in [n for n in self._pulses if n < number]:
            del self._pulses[old]
        self._frames = {key for key in self._frames if key[1] >= number}
        self.marks.forget_before(number)

    def mark(self, mark: EventMark) -> MatchResult:
        """The exposure an event mark belongs to, by what is known now."""
        return self.marks.mark(mark)

    def mark_of(self, number: int) -> EventMark | None:
        """The mark an exposure has, by what is known now."""
        return self.marks.mark_of(number)

    def frame(self, frame: Frame) -> MatchResult:
        """The exposure a frame belongs to."""
        number, possible = self._pulse_of(frame)
        if frame.status is not FrameStatus.COMPLETE:
            return MatchResult(number, Cause.CORRUPT, bool(possible), possible)
        if number is not None and not self._is_typical_start(frame, self._pulses[number]):
            possible, number = (number,), None
        if number is None:
            start_ns = start_of_exposure_mono_ns(frame)
            if start_ns is not None:
                self._heads[frame.head].spurious_ns.append(start_ns)
            return MatchResult(None, Cause.SPURIOUS, bool(possible), possible)
        if (frame.head, number) in self._frames:
            return MatchResult(number, Cause.DUPLICATE)
        self._frames.add((frame.head, number))
        pulse, head = self._pulses[number], self._heads[frame.head]
        if frame.counter is not None:
            head.offset = frame.counter - pulse.count
        head.arrivals_ns.append(frame.mono_ns - self._start_ns(frame, pulse))
        return MatchResult(number, Cause.USED)

    def has_pulse_of(self, frame: Frame) -> bool:
        """Whether the frame's own time identifies its pulse."""
        if start_of_exposure_mono_ns(frame) is None:
            return False
        return self._pulse_of(frame)[0] is not None

    def _pulse_of(self, frame: Frame) -> tuple[int | None, tuple[int, ...]]:
        """The pulse of a frame, or None and those it may be of."""
        possible = [pulse for pulse in self._pulses.values() if self._arrives(frame, pulse)]
        by_count = self._pulse_by_count(frame, possible)
        start_ns = start_of_exposure_mono_ns(frame)
        if start_ns is not None:
            near = [p for p in possible if self._is_near(frame, p, start_ns)]
            if len(near) != 1:
                return None, _numbers(near)
            pulse = near[0]
            differs = by_count is not None and by_count is not pulse
            if differs and by_count is not None and self._supports(frame, by_count):
                # The head's clock indicates one pulse, its count and perhaps its arrival another.
                is_supported = self._supports(frame, pulse)
                return (pulse.number, ()) if is_supported else (None, _numbers([pulse, by_count]))
            return pulse.number, ()
        waiting = [p for p in possible if (frame.head, p.number) not in self._frames]
        if by_count is not None:
            # Without a time of its own, a count alone may be that of before a restart.
            head = self._heads[frame.head]
            if head.median_ns is None or self._supports(frame, by_count):
                return by_count.number, ()
            return None, _numbers(waiting)
        return (waiting[0].number, ()) if len(waiting) == 1 else (None, _numbers(waiting))

    def _is_typical_start(self, frame: Frame, pulse: FiredPulse) -> bool:
        """Whether a frame near a pulse began as its head's frames do, and not there by chance."""
        start_ns = start_of_exposure_mono_ns(frame)
        if start_ns is None or (frame.head, pulse.number) in self._frames:
            return True
        head = self._heads[frame.head]
        if head.is_suspect(start_ns):
            return False
        since_latch_ns = abs((frame.device_ns or 0) - (frame.device_clock_ns or 0))
        tolerance_ns = (
            pulse.sigma_ns + 3 * (frame.latch_sigma_ns or 0) + round(LATCH_DRIFT * since_latch_ns)
        )
        return head.is_usual_start(start_ns - self._start_ns(frame, pulse), tolerance_ns)

    def _start_ns(self, frame: Frame, pulse: FiredPulse) -> int:
        return pulse.mono_ns + pulse.delays_ns[self._cone_of_head[frame.head]]

    def _arrives(self, frame: Frame, pulse: FiredPulse) -> bool:
        """Whether the frame came after its exposure began, and not ages after."""
        age_ns = frame.mono_ns - self._start_ns(frame, pulse)
        return -FRAME_WINDOW_NS - pulse.sigma_ns <= age_ns <= ARRIVAL_LIMIT_NS

    def _is_near(self, frame: Frame, pulse: FiredPulse, start_ns: int) -> bool:
        window_ns = FRAME_WINDOW_NS + pulse.sigma_ns + (frame.latch_sigma_ns or 0)
        return abs(self._start_ns(frame, pulse) - start_ns) <= window_ns

    def _pulse_by_count(self, frame: Frame, possible: list[FiredPulse]) -> FiredPulse | None:
        """The pulse a frame is of by its count; None if that is ambiguous."""
        offset = self._heads[frame.head].offset
        if offset is None or frame.counter is None:
            return None
        by_count = [p for p in possible if frame.counter - p.count == offset]
        return by_count[0] if len(by_count) == 1 else None

    def _supports(self, frame: Frame, pulse: FiredPulse) -> bool:
        """Whether the frame's arrival is what is usual for that pulse, and it waits for one."""
        median_ns = self._heads[frame.head].median_ns
        if median_ns is None or (frame.head, pulse.number) in self._frames:
            return False
        return abs(frame.mono_ns - self._start_ns(frame, pulse) - median_ns) <= ARRIVAL_TOLERANCE_NS


def _numbers(pulses: Iterable[FiredPulse]) -> tuple[int, ...]:
    return tuple(pulse.number for pulse in pulses)


def start_of_exposure_mono_ns(frame: Frame) -> int | None:
    """Start of exposure on the host's clock, through the last latch; None without a latch."""
    if (
        frame.device_ns is None
        or frame.device_clock_ns is None
        or frame.device_clock_mono_ns is None
    ):
        return None
    return frame.device_clock_mono_ns + frame.device_ns - frame.device_clock_ns
