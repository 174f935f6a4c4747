"""Which frame and which event mark belong to which pulse: by time and by count, never by order.

Pure and revisable: it knows pulses, frames and marks, no deadlines and no disk. What fits nothing,
or two pulses alike, stays unmatched and is named. Marks are in `daemon.mark_matching`.
"""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from daemon.clock import HostClock
from daemon.mark_matching import MarkMatcher
from daemon.pulses import Cause, Match, Pulse
from drivers.contract import EventMark, Frame, FrameStatus

__all__ = ["Cause", "Match", "Matcher", "Pulse", "start_of_exposure_mono_ns"]

FRAME_WINDOW_NS: Final = 20_000_000
"""How far a frame's start may lie from its pulse: trigger latency of a head, clock drift between
two latches (100 ppm over a minute is 6 ms)."""
ARRIVAL_LIMIT_NS: Final = 20_000_000_000
"""A frame belongs to a pulse at most this much earlier."""
USUAL_SLACK_NS: Final = 400_000_000
"""A frame that arrives so much off the usual is no witness of when it was exposed."""
ARRIVALS_KEPT: Final = 16


@dataclass
class _HeadRecord:
    """What is known of one head. `offset`: its counter less the pulses' count."""

    offset: int | None = None
    arrivals_ns: deque[int] = field(default_factory=lambda: deque(maxlen=ARRIVALS_KEPT))

    @property
    def usual_ns(self) -> int | None:
        """From the start of exposure to the arrival of the frame, as a rule."""
        return round(statistics.median(self.arrivals_ns)) if self.arrivals_ns else None


class Matcher:
    """Matches against the pulses it was told of, until they are forgotten.

    A mark's match may be revised until its exposure is sealed (`mark_of` says the present one); a
    frame's is final, since its pixels are stored under the exposure's number.
    """

    def __init__(self, cone_of_head: Mapping[str, str], clock: HostClock) -> None:
        self._cone_of_head = cone_of_head
        self._pulses: dict[int, Pulse] = {}
        self._frames: set[tuple[str, int]] = set()
        self._heads = {head: _HeadRecord() for head in cone_of_head}
        self.marks = MarkMatcher(clock)

    def pulse(self, pulse: Pulse) -> None:
        """Note a pulse that was given."""
        self._pulses[pulse.number] = pulse
        self.marks.pulse(pulse)

    def forget_before(self, number: int) -> None:
        """Drop pulses whose frames and marks are counted late by now."""
        for old in [n for n in self._pulses if n < number]:
            del self._pulses[old]
        self._frames = {key for key in self._frames if key[1] >= number}
        self.marks.forget_before(number)

    def mark(self, mark: EventMark) -> Match:
        """The exposure an event mark belongs to, by what is known now."""
        return self.marks.mark(mark)

    def mark_of(self, number: int) -> EventMark | None:
        """The mark an exposure has, by what is known now."""
        return self.marks.mark_of(number)

    def frame(self, frame: Frame) -> Match:
        """The exposure a frame belongs to."""
        number, is_ambiguous = self._pulse_of(frame)
        if frame.status is not FrameStatus.COMPLETE:
            return Match(number, Cause.CORRUPT)
        if number is None:
            return Match(None, Cause.SPURIOUS, is_ambiguous)
        if (frame.head, number) in self._frames:
            return Match(number, Cause.DUPLICATE)
        self._frames.add((frame.head, number))
        pulse, head = self._pulses[number], self._heads[frame.head]
        if frame.counter is not None:
            head.offset = frame.counter - pulse.count
        head.arrivals_ns.append(frame.mono_ns - self._start_ns(frame, pulse))
        return Match(number, Cause.USED)

    def _pulse_of(self, frame: Frame) -> tuple[int | None, bool]:
        """The pulse of a frame, or None and whether that is for doubt."""
        possible = [pulse for pulse in self._pulses.values() if self._arrives(frame, pulse)]
        counted = self._counted(frame, possible)
        start_ns = start_of_exposure_mono_ns(frame)
        if start_ns is not None:
            near = [p for p in possible if self._is_near(frame, p, start_ns)]
            if len(near) != 1:
                return None, len(near) > 1
            pulse = near[0]
            is_other = counted is not None and counted is not pulse
            if is_other and counted is not None and self._speaks_for(frame, counted):
                # The head's clock says one pulse, its count and perhaps the arrival another.
                is_sure = self._speaks_for(frame, pulse)
                return (pulse.number, False) if is_sure else (None, True)
            return pulse.number, False
        if counted is not None:
            # Without a time of its own, a count alone may be that of before a restart.
            head = self._heads[frame.head]
            if head.usual_ns is None or self._speaks_for(frame, counted):
                return counted.number, False
            return None, True
        waiting = [p for p in possible if (frame.head, p.number) not in self._frames]
        return (waiting[0].number, False) if len(waiting) == 1 else (None, len(waiting) > 1)

    def _start_ns(self, frame: Frame, pulse: Pulse) -> int:
        return pulse.mono_ns + pulse.delays_ns[self._cone_of_head[frame.head]]

    def _arrives(self, frame: Frame, pulse: Pulse) -> bool:
        """Whether the frame came after its exposure began, and not ages after."""
        age_ns = frame.mono_ns - self._start_ns(frame, pulse)
        return -FRAME_WINDOW_NS - pulse.sigma_ns <= age_ns <= ARRIVAL_LIMIT_NS

    def _is_near(self, frame: Frame, pulse: Pulse, start_ns: int) -> bool:
        window_ns = FRAME_WINDOW_NS + pulse.sigma_ns + (frame.latch_sigma_ns or 0)
        return abs(self._start_ns(frame, pulse) - start_ns) <= window_ns

    def _counted(self, frame: Frame, possible: list[Pulse]) -> Pulse | None:
        """The pulse a frame is of by its count; None where that tells nothing."""
        offset = self._heads[frame.head].offset
        if offset is None or frame.counter is None:
            return None
        counted = [p for p in possible if frame.counter - p.count == offset]
        return counted[0] if len(counted) == 1 else None

    def _speaks_for(self, frame: Frame, pulse: Pulse) -> bool:
        """Whether the frame's arrival is what is usual for that pulse, and it waits for one."""
        usual_ns = self._heads[frame.head].usual_ns
        if usual_ns is None or (frame.head, pulse.number) in self._frames:
            return False
        return abs(frame.mono_ns - self._start_ns(frame, pulse) - usual_ns) <= USUAL_SLACK_NS


def start_of_exposure_mono_ns(frame: Frame) -> int | None:
    """Start of exposure on the host's clock, through the last latch; None without a latch."""
    if (
        frame.device_ns is None
        or frame.device_clock_ns is None
        or frame.device_clock_mono_ns is None
    ):
        return None
    return frame.device_clock_mono_ns + frame.device_ns - frame.device_clock_ns
