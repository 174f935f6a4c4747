"""GPS time on the host's monotonic clock, and its uncertainty at every instant.

There are three sources. Edges of a pulse per second are exact, but their second is unknown. Event
marks of pulses that the host gave are as accurate as the pulse's host time. Navigation messages
come up to 700 ms late and only resolve the second. `daemon.onboard.timing.clock_model` is the model
of two clocks.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Final, Literal

from daemon.onboard.timing.clock_model import ClockModel, Estimate, Pair

SECOND_NS: Final = 1_000_000_000
ARRIVAL_MIN_NS: Final = 0
"""An autopilot on the network sends its position within a millisecond, a serial line after 10."""
ARRIVAL_MAX_NS: Final = 700_000_000
COARSE_SIGMA_NS: Final = round((ARRIVAL_MAX_NS - ARRIVAL_MIN_NS) / math.sqrt(12))
"""Of an instant that lies anywhere between both."""
MESSAGES_MAX: Final = 50
MESSAGES_TO_RESOLVE_SECOND: Final = 3
EARLY_TOLERANCE_NS: Final = 5_000_000
LATENESS_MAX_NS: Final = 900_000_000
"""A message further from the clock than these was held up, or the receiver's time has stepped."""
EARLY_MESSAGES_MAX: Final = 5
"""So many in succession cannot have been held up: the receiver's time has stepped."""
LONG_GAP_NS: Final = 100 * SECOND_NS
SECOND_TOLERANCE_NS: Final = 100_000_000
ROUND_TRIPS_MAX: Final = 32
UNUSUAL_RATIO: Final = 1.7
"""A round trip longer than this multiple of the median was delayed."""
RESIDUALS_MAX: Final = 64
PRIOR_WEIGHT: Final = 4.0
"""How many readings the stated sigma of a pulse's host time weighs against what is seen."""
SCATTER_RATIO_MAX: Final = 2.0
"""Edges that scatter by up to so many times what is stated are as they should be."""
PPS_HOLDOVER_NS: Final = 5 * SECOND_NS
MARK_HOLDOVER_NS: Final = 10 * SECOND_NS
MARKS_MISSED: Final = 3

Source = Literal["pps", "marks", "messages"]


@dataclass(frozen=True)
class GpsEstimate:
    """A GPS time with its standard deviation, and what it rests on.

    `is_coarse` if only messages were received so far. `coasting_ns` is how long ago the last
    edge or mark was; where that is longer than usual, `in_holdover`.
    """

    gps_ns: int
    sigma_ns: int
    is_coarse: bool
    source: Source = "marks"
    coasting_ns: int = 0
    in_holdover: bool = False


@dataclass(frozen=True)
class ClockEvent:
    """An event of the clock: stable name, whether it is a fault, and a sentence with the action."""

    name: str
    is_fault: bool
    sentence: str


class RoundTrips:
    """How well the middle of a round trip is the moment asked about, from recent round trips.

    What is usual is taken as jitter of a constant size, since the asymmetry is unknown;
    the excess of a longer round trip counts in full.
    """

    def __init__(self) -> None:
        self._halves: deque[int] = deque(maxlen=ROUND_TRIPS_MAX)

    def add(self, half_width_ns: int) -> None:
        """Note half a round trip."""
        self._halves.append(max(half_width_ns, 1))

    @property
    def median_ns(self) -> float:
        """The median half round trip; 0 before the first."""
        return float(statistics.median(self._halves)) if self._halves else 0.0

    @property
    def systematic_ns(self) -> float:
        """Uncertainty of the common delay: one way takes at most three times the other, and both
        together the shortest round trip."""
        return min(self._halves, default=0) / 2 / math.sqrt(3)

    def sigma_ns(self, half_width_ns: int) -> float:
        """Standard deviation of the middle of a round trip of that half width."""
        usual = self.median_ns or float(half_width_ns)
        excess = max(0.0, half_width_ns - UNUSUAL_RATIO * usual)
        return max(1.0, math.hypot(min(half_width_ns, usual) / math.sqrt(3), excess))


class _PulseLateness:
    """By how much pulses really come later than the middle of their round trip, by PPS."""

    def __init__(self) -> None:
        self._residuals: dict[Hashable, tuple[float, float]] = {}

    def add(self, key: Hashable, residual_ns: float, sigma_ns: float) -> None:
        self._residuals[key] = (residual_ns, sigma_ns)
        while len(self._residuals) > RESIDUALS_MAX:
            del self._residuals[next(iter(self._residuals))]

    def clear(self) -> None:
        self._residuals.clear()

    def estimate(self, prior_sigma_ns: float, sigma_ns: float) -> tuple[float, float]:
        """Mean lateness, and the standard deviation of one pulse's against it."""
        prior = max(prior_sigma_ns, 1.0)
        if not self._residuals:
            return 0.0, math.hypot(prior, sigma_ns)
        middle = statistics.median(r for r, _ in self._residuals.values())
        spread = statistics.median(abs(r - middle) / s for r, s in self._residuals.values())
        limit = 4.0 * max(1.0, 1.4826 * spread)
        weights = [
            (r, min(1.0, limit * s / max(abs(r - middle), 1e-9)) / s**2)
            for r, s in self._residuals.values()
        ]
        total = sum(w for _, w in weights)
        mean = sum(w * r for r, w in weights) / total
        square = sum(w * (r - mean) ** 2 for r, w in weights)
        scale2 = (PRIOR_WEIGHT + square) / (PRIOR_WEIGHT + len(weights) - 1)
        variance_of_mean = scale2 / total
        share = prior**2 / (prior**2 + variance_of_mean)
        variance = share * variance_of_mean + scale2 * sigma_ns**2
        return share * mean, math.sqrt(variance)


class GpsClock:
    """GPS time of host instants. A pure model: it reads no clock itself."""

    def __init__(self) -> None:
        self._marks = ClockModel()
        self._pps = ClockModel()
        self._pps_sigma_ns = 0.0
        self._second: int | None = None
        self._lateness = _PulseLateness()
        self.round_trips = RoundTrips()
        self._messages: deque[tuple[int, int]] = deque(maxlen=MESSAGES_MAX)
        self._last_message: tuple[int, int] | None = None
        self._early_messages: list[tuple[int, int]] = []
        self.is_suspect = False
        self._last_mark_ns: int | None = None
        self._pulses_since_mark = 0
        self._awaits_mark = False
        self._active_alarms: dict[str, bool] = {}
        self._events: list[ClockEvent] = []
        self._steps_reported = 0

    # Input

    def message_arrived(self, gps_ns: int, mono_ns: int) -> None:
        """Note a navigation message: it left at `gps_ns` and arrived, late, at `mono_ns`."""
        self._last_message = (gps_ns, mono_ns)
        self._check_message(gps_ns, mono_ns)
        if not self.is_suspect:
            self._messages.append((gps_ns, mono_ns))
            self._resolve_second()

    def pps_edge(self, mono_ns: int, sigma_ns: int) -> None:
        """Note an edge of the pulse per second."""
        last = self._pps.last
        if last is None:
            count_ns = 0
        else:
            since_ns = mono_ns - last.from_ns
            if since_ns > LONG_GAP_NS:
                # Over so long a gap the clock's rate matters for which second this is.
                expected = self._pps.at(mono_ns)
                since_ns = since_ns if expected is None else expected.to_ns - last.to_ns
            count_ns = last.to_ns + round(since_ns / SECOND_NS) * SECOND_NS
            if count_ns <= last.to_ns:
                return  # the same second again
        self._pps_sigma_ns = float(sigma_ns)
        self._pps.add(Pair(mono_ns, count_ns, float(max(sigma_ns, 1))))
        self._resolve_second()

    def pulse_given(self, half_width_ns: int) -> None:
        """Note that a pulse was given, known to half its round trip."""
        self.round_trips.add(half_width_ns)
        self._pulses_since_mark += 1

    def mark_matched(
        self,
        gps_ns: int,
        mono_ns: int,
        sigma_ns: int,
        *,
        accuracy_ns: int = 0,
        key: Hashable = None,
    ) -> None:
        """Note an event mark of an instant whose host time is known to `sigma_ns`.

        `accuracy_ns` is the receiver's own; `key` lets the mark be taken back.
        """
        if not self.round_trips.median_ns:
            self.round_trips.add(sigma_ns)
        reading = math.hypot(self.round_trips.sigma_ns(sigma_ns), accuracy_ns)
        pps = self._through_pps(mono_ns)
        if pps is None and self._pps.last is not None:
            self._resolve_second_by_mark(gps_ns, mono_ns)
            pps = self._through_pps(mono_ns)
        if pps is not None:
            self._lateness.add(key, float(gps_ns - pps.to_ns), reading)
        self._marks.add(Pair(mono_ns, gps_ns, reading, key))
        self._last_mark_ns = max(mono_ns, self._last_mark_ns or mono_ns)
        self._pulses_since_mark = 0
        self._awaits_mark = False

    def receiver_recovered(self) -> None:
        """The receiver delivers again: that its marks are missing is not known any more."""
        self._pulses_since_mark = 0
        self._awaits_mark = True

    def restart(self) -> None:
        """Forget everything: the receiver's time has stepped. Edges are kept without their GPS
        times."""
        self._marks.clear()
        self._messages.clear()
        self._early_messages.clear()
        self._lateness.clear()
        self._second = None
        self.is_suspect = False
        self._last_mark_ns = None

    # Queries

    @property
    def is_coarse(self) -> bool:
        """Whether navigation messages are the only source of time."""
        return not len(self._marks) and (self._second is None or not len(self._pps))

    def messages_allow(self, shift_ns: int) -> bool:
        """Whether GPS less host time may be that, by the last message that came."""
        if self._last_message is None:
            return True
        gps_ns, mono_ns = self._last_message
        return -EARLY_TOLERANCE_NS <= mono_ns + shift_ns - gps_ns <= LATENESS_MAX_NS

    def gps_at(self, mono_ns: int) -> GpsEstimate | None:
        """GPS time of a host instant, or None before the receiver has spoken."""
        found = []
        pps = self._through_pps(mono_ns)
        if pps is not None:
            sigma_ns = math.hypot(pps.sigma_ns, self._pps_systematic_ns())
            found.append(self._as_gps_estimate(pps, sigma_ns, "pps", mono_ns))
        marks = self._marks.at(mono_ns)
        if marks is not None:
            # All pulses may have a common delay.
            sigma_ns = math.hypot(marks.sigma_ns, self.round_trips.systematic_ns)
            found.append(self._as_gps_estimate(marks, sigma_ns, "marks", mono_ns))
        if found:
            return min(found, key=lambda estimate: estimate.sigma_ns)
        return self._coarse(mono_ns)

    def pulse_at(self, mono_ns: int, half_width_ns: int) -> GpsEstimate | None:
        """GPS time of a pulse whose host time is known to half its round trip.

        The common delay of all pulses is estimated from other marks and is included.
        """
        reading_ns = self.round_trips.sigma_ns(half_width_ns)
        found = []
        marks = self._marks.at(mono_ns, reading_sigma_ns=reading_ns)
        if marks is not None:
            found.append(self._as_gps_estimate(marks, marks.sigma_ns, "marks", mono_ns))
        pps = self._through_pps(mono_ns)
        if pps is not None:
            systematic_ns = math.hypot(self.round_trips.systematic_ns, self._pps_systematic_ns())
            lateness_ns, spread_ns = self._lateness.estimate(systematic_ns, reading_ns)
            shifted = Estimate(pps.to_ns + round(lateness_ns), 0.0, pps.gap_ns)
            sigma_ns = math.hypot(pps.sigma_ns, spread_ns)
            found.append(self._as_gps_estimate(shifted, sigma_ns, "pps", mono_ns))
        if found:
            return min(found, key=lambda estimate: estimate.sigma_ns)
        return self._coarse(mono_ns)

    def sigma_of(self, mono_ns: int, source: Source) -> int:
        """What the clock itself is unsure by at an instant, by one of its witnesses."""
        if source == "messages":
            return COARSE_SIGMA_NS
        if source == "pps":
            estimate = self._through_pps(mono_ns)
            own_ns = self._pps_systematic_ns()
        else:
            estimate, own_ns = self._marks.at(mono_ns), 0.0
        return 0 if estimate is None else round(math.hypot(estimate.sigma_ns, own_ns))

    def events(self, mono_ns: int) -> list[ClockEvent]:
        """Events since the last call."""
        events, self._events = self._events, []
        events += self._alarm(
            "pps-holdover",
            self._is_silent(self._pps.last, mono_ns, PPS_HOLDOVER_NS),
            "no edge of the pulse per second for {0:.0f} s: the clock coasts, {1}; check the PPS "
            "cable and the receiver's fix",
            "the pulse per second is back",
            mono_ns,
            since_ns=self._pps.last.from_ns if self._pps.last else mono_ns,
        )
        has_marks = self._last_mark_ns is not None and not len(self._pps)
        silent = self._pulses_since_mark >= MARKS_MISSED
        events += self._alarm(
            "mark-holdover",
            has_marks and silent and mono_ns - (self._last_mark_ns or 0) > MARK_HOLDOVER_NS,
            "no event mark for {0:.0f} s: times are interpolated, {1}; check the strobe cable and "
            "that the receiver sends its marks",
            "the receiver delivers again; the next exposure shows whether its event marks do"
            if self._awaits_mark
            else "event marks are back",
            mono_ns,
            since_ns=self._last_mark_ns or 0,
        )
        events += self._alarm(
            "second-unnamed",
            bool(len(self._pps)) and self._second is None and len(self._messages) >= MESSAGES_MAX,
            "the pulse per second cannot be named: no navigation message comes 10 to 700 ms after "
            "its epoch; check that PPS and messages are of the same receiver",
            "the pulse per second is named",
            mono_ns,
            since_ns=mono_ns,
        )
        steps = self._marks.steps + self._pps.steps
        if steps > self._steps_reported:
            self._steps_reported = steps
            events.append(
                ClockEvent(
                    "clock-stepped",
                    True,
                    "edges or event marks moved against the host's clock; what came before is not "
                    "used any more; check receiver and strobe cable if it happens again",
                )
            )
        return events

    # Implementation

    def _as_gps_estimate(
        self, estimate: Estimate, sigma_ns: float, source: Source, mono_ns: int
    ) -> GpsEstimate:
        limit_ns = PPS_HOLDOVER_NS if source == "pps" else MARK_HOLDOVER_NS
        return GpsEstimate(
            gps_ns=estimate.to_ns,
            sigma_ns=max(1, round(sigma_ns)),
            is_coarse=False,
            source=source,
            coasting_ns=estimate.gap_ns,
            in_holdover=estimate.gap_ns > limit_ns,
        )

    def _coarse(self, mono_ns: int) -> GpsEstimate | None:
        if not self._messages:
            return None
        minimum = min(mono - gps for gps, mono in self._messages)
        centre = (ARRIVAL_MIN_NS + ARRIVAL_MAX_NS) // 2
        return GpsEstimate(mono_ns - minimum + centre, COARSE_SIGMA_NS, True, "messages")

    def _pps_systematic_ns(self) -> float:
        """Common delay of all edges: as stated, or more if they scatter by more."""
        return self._pps_sigma_ns * max(1.0, self._pps.reading_scale() / SCATTER_RATIO_MAX)

    def _through_pps(self, mono_ns: int) -> Estimate | None:
        if self._second is None:
            return None
        estimate = self._pps.at(mono_ns)
        if estimate is None:
            return None
        resolved_ns = estimate.to_ns + self._second * SECOND_NS
        return Estimate(resolved_ns, estimate.sigma_ns, estimate.gap_ns)

    def _resolve_second(self) -> None:
        """Resolve the second of the edges from messages, if they are unambiguous."""
        if self._second is not None or len(self._messages) < MESSAGES_TO_RESOLVE_SECOND:
            return
        offsets_ns = []
        for gps_ns, mono_ns in self._messages:
            edge = self._pps.at(mono_ns)
            if edge is None:
                return
            offsets_ns.append(gps_ns - edge.to_ns)
        # The message with the least delay counts: the edge is up to 700 ms later than its time.
        second = math.ceil((max(offsets_ns) + ARRIVAL_MIN_NS) / SECOND_NS)
        if second * SECOND_NS <= max(offsets_ns) + ARRIVAL_MAX_NS:
            self._second = second

    def _resolve_second_by_mark(self, gps_ns: int, mono_ns: int) -> None:
        edge = self._pps.at(mono_ns)
        if edge is None:
            return
        gap_ns = gps_ns - edge.to_ns
        second = round(gap_ns / SECOND_NS)
        if abs(gap_ns - second * SECOND_NS) < SECOND_TOLERANCE_NS:
            self._second = second

    def _check_message(self, gps_ns: int, mono_ns: int) -> None:
        """Check a message against the clock; after a step of the receiver's time, restart."""
        expected = self.gps_at(mono_ns)
        if expected is None or expected.is_coarse:
            self.is_suspect = False
            return
        lateness_ns = expected.gps_ns - gps_ns
        is_early = lateness_ns < -EARLY_TOLERANCE_NS - 5 * expected.sigma_ns
        self.is_suspect = is_early or lateness_ns > LATENESS_MAX_NS + 5 * expected.sigma_ns
        if not is_early:
            self._early_messages.clear()
            return
        self._early_messages.append((gps_ns, mono_ns))
        if len(self._early_messages) >= EARLY_MESSAGES_MAX:
            messages = list(self._early_messages)
            self.restart()
            self._messages.extend(messages)
            self._resolve_second()
            self._events.append(
                ClockEvent(
                    "receiver-stepped",
                    True,
                    f"the receiver's time is {-lateness_ns * 1e-9:.3f} s ahead of what it was; its "
                    "clock is estimated again; check its firmware and week number",
                )
            )

    def _is_silent(self, last: Pair | None, mono_ns: int, limit_ns: int) -> bool:
        return last is not None and mono_ns - last.from_ns > limit_ns

    def _alarm(
        self,
        name: str,
        condition: bool,
        sentence: str,
        cleared: str,
        mono_ns: int,
        *,
        since_ns: int,
    ) -> list[ClockEvent]:
        if condition == self._active_alarms.get(name, False):
            return []
        self._active_alarms[name] = condition
        if not condition:
            return [ClockEvent(name, False, cleared)]
        estimate = self.gps_at(mono_ns)
        accuracy = "no time of the receiver is known yet"
        if estimate is not None:
            accuracy = f"its time is good to {estimate.sigma_ns * 1e-6:.3g} ms now"
        silent_s = (mono_ns - since_ns) * 1e-9
        return [ClockEvent(name, True, sentence.format(silent_s, accuracy))]
