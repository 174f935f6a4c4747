"""Which event mark belongs to which pulse: an assignment that may be revised until it is sealed.

A mark is given to a pulse only where its time fits that pulse and no other, and where neither its
count nor its arrival speaks for another. An ambiguous mark stays pending, and is evaluated again
whenever something new is known; what belongs nowhere in the end is spurious.

Source: docs/explanation/mathematics/time.md#which-mark-belongs-to-which-pulse.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import combinations
from typing import Final

from daemon.onboard.timing.gps_clock import GpsClock, GpsEstimate
from daemon.onboard.timing.pulses import Cause, FiredPulse, MatchResult
from drivers.contract import EventMark

WINDOW_NS: Final = 2_000_000
"""Largest distance of a mark from its pulse, in addition to the clock's uncertainty."""
SIGMAS: Final = 5
COARSE_WINDOW_NS: Final = 355_000_000
"""Half of what messages leave open, and a little."""
EARLY_TOLERANCE_NS: Final = 5_000_000
"""No mark arrives before its strobe; so much is forgiven to the pulse's own host time."""
ARRIVAL_MAX_NS: Final = 1_200_000_000
"""A mark comes with the receiver's next epoch, at most a second later, and its way."""
AGREE_NS: Final = 1_000_000
AGREE_RATE: Final = 50e-6
RATE_LIMIT: Final = 1e-3
SAME_NS: Final = 1_000
MARKS_TO_REASSIGN: Final = 2
DUPLICATES_MAX: Final = 256
PENDING_MAX: Final = 32
"""Limits the time spent on a noisy strobe line: the oldest marks are given up."""
PAIRS_MAX: Final = 100


@dataclass(eq=False)
class _PendingMark:
    mark: EventMark
    number: int | None = None
    is_ambiguous: bool = False


@dataclass
class _Channel:
    """What is known of one input of one receiver.

    The offset of its count from the pulses' is confirmed once two marks agree on it.
    """

    last_offset: int | None = None
    is_confirmed: bool = False
    recent_gps_ns: dict[int, None] = field(default_factory=dict)

    @property
    def offset(self) -> int | None:
        return self.last_offset if self.is_confirmed else None

    def learn(self, offset: int) -> None:
        self.is_confirmed = offset == self.last_offset
        self.last_offset = offset


class MarkMatcher:
    """Event marks against pulses. Pulses are noted first; everything may come in any order."""

    def __init__(self, clock: GpsClock) -> None:
        self._clock = clock
        self._pulses: dict[int, FiredPulse] = {}
        self._sealed: dict[int, bool] = {}
        self._pending: list[_PendingMark] = []
        self._evicted: list[EventMark] = []
        self._assigned: dict[int, _PendingMark] = {}
        self._corroborated: set[int] = set()
        self._channels: dict[tuple[str, int], _Channel] = {}

    def pulse(self, pulse: FiredPulse) -> None:
        """Note a pulse; a mark that came before it may now be its own."""
        self._pulses[pulse.number] = pulse
        self._clock.pulse_given(pulse.sigma_ns)
        self.reconsider()

    def forget_before(self, number: int) -> None:
        """Drop pulses whose marks are counted late by now."""
        for old in [n for n in self._pulses if n < number]:
            del self._pulses[old]
            self._sealed.pop(old, None)
            self._assigned.pop(old, None)
            self._corroborated.discard(old)

    def mark(self, mark: EventMark) -> MatchResult:
        """Take a mark in, and say what is known of it by now.

        DUPLICATE, CORRUPT and LATE are final; USED and PENDING may change until the exposure is
        sealed.
        """
        if not mark.time_valid:
            return MatchResult(None, Cause.CORRUPT)
        channel = self._channels.setdefault((mark.receiver, mark.channel), _Channel())
        if any(at in channel.recent_gps_ns for at in range(mark.gps_ns - 1, mark.gps_ns + 2)):
            clone = next((h.number for h in self._all_marks() if _is_same(h.mark, mark)), None)
            return MatchResult(clone, Cause.DUPLICATE)
        channel.recent_gps_ns[mark.gps_ns] = None
        while len(channel.recent_gps_ns) > DUPLICATES_MAX:
            del channel.recent_gps_ns[next(iter(channel.recent_gps_ns))]
        pending = _PendingMark(mark)
        self._pending.append(pending)
        while len(self._pending) > PENDING_MAX:
            self._evicted.append(self._pending.pop(0).mark)
        number = self._sealed_exposure_of(pending)
        if number is not None:
            self._pending.remove(pending)
            already = number in self._assigned
            return MatchResult(number, Cause.DUPLICATE if already else Cause.LATE)
        pulse = None if self._is_coarse() else self._pulse_of(pending)
        if pulse is not None:
            self._assign(pending, pulse)
            self.reconsider()
        elif self._is_coarse():
            self.reconsider()
        elif len(self._pending) >= MARKS_TO_REASSIGN:
            self._reassign()
        if pending.number is not None:
            return MatchResult(pending.number, Cause.USED)
        clone = self._assigned_exposure_of(pending)
        if clone is not None:
            self._pending.remove(pending)
            return MatchResult(clone, Cause.DUPLICATE)
        return MatchResult(None, Cause.PENDING, pending.is_ambiguous)

    def reconsider(self) -> None:
        """Look again at every mark that is held; to be called when something new is known."""
        changed = True
        while changed:
            changed = False
            for pending in list(self._pending):
                pulse = self._pulse_of(pending)
                if pulse is not None:
                    self._assign(pending, pulse)
                    changed = True
        if len(self._pending) >= MARKS_TO_REASSIGN:
            self._reassign()

    def mark_of(self, number: int) -> EventMark | None:
        """The mark an exposure has, as far as is known by now."""
        pending = self._assigned.get(number)
        return None if pending is None else pending.mark

    def is_corroborated(self, number: int) -> bool:
        """Whether more than its own mark speaks for a pulse's mark."""
        return number in self._corroborated

    @property
    def oldest_pending_ns(self) -> int | None:
        """Arrival of the oldest mark that has no pulse; None without one."""
        return min((pending.mark.mono_ns for pending in self._pending), default=None)

    def has_ambiguous(self, number: int) -> bool:
        """Whether a held mark may be this pulse's, among others."""
        pulse = self._pulses.get(number)
        return pulse is not None and any(
            pending.is_ambiguous and pulse in self._candidates(pending) for pending in self._pending
        )

    def seal(self, number: int) -> bool:
        """The exposure is sealed: its mark is final. Whether it has one."""
        self._sealed[number] = True
        return number in self._assigned

    def give_up(self, before_mono_ns: int) -> list[EventMark]:
        """Marks that arrived before an instant and belong nowhere: final, and forgotten."""
        spurious = [
            pending.mark for pending in self._pending if pending.mark.mono_ns < before_mono_ns
        ]
        self._pending = [
            pending for pending in self._pending if pending.mark.mono_ns >= before_mono_ns
        ]
        evicted, self._evicted = self._evicted, []
        return [*evicted, *spurious]

    # One mark

    def _pulse_of(self, pending: _PendingMark) -> FiredPulse | None:
        """The one pulse a held mark can be of; None where there is none, or a doubt."""
        candidates = self._candidates(pending)
        free = [p for p in candidates if p.number not in self._assigned and not self._is_sealed(p)]
        by_count = self._pulse_by_count(pending.mark)
        is_coarse = self._is_coarse()
        if is_coarse and len(free) > 1 and by_count is not None:
            free = [pulse for pulse in free if pulse is by_count]
        pending.is_ambiguous = len(free) > 1
        if len(free) != 1:
            return None
        pulse = free[0]
        if is_coarse:
            # Two marks for one pulse, or two pulses for one mark: still ambiguous.
            rivals = [h for h in self._pending if h is not pending and pulse in self._candidates(h)]
            pending.is_ambiguous = bool(rivals) or len(candidates) > 1
            if pending.is_ambiguous and by_count is not pulse:
                return None
            if not self._arrives_in_time(pending.mark, pulse) and by_count is not pulse:
                return None
            return pulse
        if self._clock.is_suspect and by_count is not pulse:
            pending.is_ambiguous = True
            return None
        if (
            by_count is not None
            and by_count is not pulse
            and not self._arrives_in_time(pending.mark, pulse)
        ):
            is_free = by_count.number not in self._assigned and not self._is_sealed(by_count)
            if is_free and self._arrives_in_time(pending.mark, by_count):
                pending.is_ambiguous = True
                return None
        return pulse

    def _assign(self, pending: _PendingMark, pulse: FiredPulse) -> None:
        mark = pending.mark
        is_first = self._is_coarse()
        pending.number, pending.is_ambiguous = pulse.number, False
        self._pending.remove(pending)
        self._assigned[pulse.number] = pending
        if mark.count_bits:
            channel = self._channels[(mark.receiver, mark.channel)]
            channel.learn((mark.count - pulse.count) % (1 << mark.count_bits))
        self._update_clock(pending, pulse)
        if is_first:
            return
        self._corroborated.add(pulse.number)
        self._corroborated |= {n for n in self._assigned if not self._sealed.get(n)}

    def _update_clock(self, pending: _PendingMark, pulse: FiredPulse) -> None:
        self._clock.mark_matched(
            pending.mark.gps_ns,
            pulse.mono_ns + pulse.strobe_delay_ns,
            pulse.sigma_ns,
            accuracy_ns=pending.mark.accuracy_ns,
            key=pulse.number,
        )

    def _candidates(self, pending: _PendingMark) -> list[FiredPulse]:
        """Pulses whose strobe this mark may be by time and arrival."""
        mark, found = pending.mark, []
        reference = self._clock.gps_at(mark.mono_ns)
        if reference is None:
            return []
        for pulse in self._pulses.values():
            strobe_ns = pulse.mono_ns + pulse.strobe_delay_ns
            # A clock is never off by more than this: most pulses need no closer look.
            separation_ns = mark.mono_ns - strobe_ns
            rough_ns = mark.gps_ns - (reference.gps_ns - separation_ns)
            limit_ns = COARSE_WINDOW_NS + pulse.sigma_ns + SIGMAS * reference.sigma_ns
            if abs(rough_ns) > limit_ns + abs(round(separation_ns * RATE_LIMIT)):
                continue
            if separation_ns < -EARLY_TOLERANCE_NS - SIGMAS * pulse.sigma_ns:
                continue
            expected = self._clock.pulse_at(strobe_ns, pulse.sigma_ns)
            if expected is None:
                continue
            if abs(mark.gps_ns - expected.gps_ns) <= _window(expected, pulse):
                found.append(pulse)
        return found

    def _pulse_by_count(self, mark: EventMark) -> FiredPulse | None:
        """The pulse a mark is of by its count; None if it has none, or if that is ambiguous."""
        channel = self._channels[(mark.receiver, mark.channel)]
        if not mark.count_bits or channel.offset is None:
            return None
        modulus = 1 << mark.count_bits
        expected_count = (mark.count - channel.offset) % modulus
        found = [
            pulse
            for pulse in self._pulses.values()
            if pulse.count % modulus == expected_count and _arrives(mark, pulse)
        ]
        return found[0] if len(found) == 1 else None

    def _sealed_exposure_of(self, pending: _PendingMark) -> int | None:
        """The sealed exposure a mark is late for, or a second mark of."""
        if self._is_coarse():
            return None
        candidates = self._candidates(pending)
        sealed = [pulse for pulse in candidates if self._is_sealed(pulse)]
        return sealed[0].number if len(candidates) == len(sealed) == 1 else None

    def _assigned_exposure_of(self, pending: _PendingMark) -> int | None:
        if self._is_coarse() or self._clock.is_suspect:
            return None
        candidates = self._candidates(pending)
        if (
            len(candidates) == 1
            and candidates[0].number in self._assigned
            and self._arrives_in_time(pending.mark, candidates[0])
        ):
            return candidates[0].number
        return None

    def _is_coarse(self) -> bool:
        return self._clock.is_coarse

    def _is_sealed(self, pulse: FiredPulse) -> bool:
        return self._sealed.get(pulse.number, False)

    def _arrives_in_time(self, mark: EventMark, pulse: FiredPulse) -> bool:
        return mark.mono_ns - pulse.mono_ns - pulse.strobe_delay_ns <= ARRIVAL_MAX_NS

    def _all_marks(self) -> Iterable[_PendingMark]:
        yield from self._pending
        yield from self._assigned.values()

    # Several marks

    def _reassign(self) -> None:
        """Marks that match no pulse, but do so after one common shift: then the clock is
        wrong, not they. Only where there is one such shift."""
        pairs = [
            (pending, pulse)
            for pending in self._pending
            for pulse in self._pulses.values()
            if _arrives(pending.mark, pulse)
            and self._arrives_in_time(pending.mark, pulse)
            and not self._is_sealed(pulse)
        ]
        if len(pairs) > PAIRS_MAX:
            return  # so much noise explains anything
        best: list[list[tuple[_PendingMark, FiredPulse]]] = []
        for first, second in combinations(pairs, 2):
            if first[0] is second[0] or first[1] is second[1] or not _agree(first, second):
                continue
            group = _group(first, [pair for pair in pairs if _agree(first, pair)])
            if not any({_key(p) for p in group} <= {_key(p) for p in other} for other in best):
                best.append(group)
        best.sort(key=len, reverse=True)
        if not best or len(best[0]) < MARKS_TO_REASSIGN:
            return
        if len(best) > 1 and len(best[1]) >= len(best[0]) - 1:
            return  # another shift explains them as well
        group = best[0]
        if not all(self._count_allows(pending.mark, pulse) for pending, pulse in group):
            return
        if not self._clock.messages_allow(round(sum(map(_shift, group)) / len(group))):
            return
        against = sum(not self._sealed.get(number) for number in self._assigned)
        if len(group) <= against:
            return
        self._clock.restart()
        for number, assigned in list(self._assigned.items()):
            if not self._sealed.get(number):
                del self._assigned[number]
                self._corroborated.discard(number)
                assigned.number = None
                self._pending.append(assigned)
        for pending, pulse in group:
            self._assign(pending, pulse)

    def _count_allows(self, mark: EventMark, pulse: FiredPulse) -> bool:
        channel = self._channels[(mark.receiver, mark.channel)]
        if not mark.count_bits or channel.offset is None:
            return True
        return (mark.count - pulse.count - channel.offset) % (1 << mark.count_bits) == 0


def _window(expected: GpsEstimate, pulse: FiredPulse) -> int:
    if expected.is_coarse:
        # On a busy machine the round trip of a pulse alone exceeds the little.
        return COARSE_WINDOW_NS + pulse.sigma_ns
    return WINDOW_NS + SIGMAS * expected.sigma_ns


def _arrives(mark: EventMark, pulse: FiredPulse) -> bool:
    """Whether the mark came after the strobe, as it must."""
    early_ns = pulse.mono_ns + pulse.strobe_delay_ns - mark.mono_ns
    return early_ns <= EARLY_TOLERANCE_NS + SIGMAS * pulse.sigma_ns


def _is_same(a: EventMark, b: EventMark) -> bool:
    same_input = (a.receiver, a.channel) == (b.receiver, b.channel)
    return same_input and abs(a.gps_ns - b.gps_ns) <= SAME_NS


def _shift(pair: tuple[_PendingMark, FiredPulse]) -> int:
    pending, pulse = pair
    return pending.mark.gps_ns - pulse.mono_ns - pulse.strobe_delay_ns


def _agree(a: tuple[_PendingMark, FiredPulse], b: tuple[_PendingMark, FiredPulse]) -> bool:
    separation_ns = abs(a[1].mono_ns - b[1].mono_ns)
    tolerance = AGREE_NS + SIGMAS * (a[1].sigma_ns + b[1].sigma_ns) + separation_ns * AGREE_RATE
    return abs(_shift(a) - _shift(b)) <= tolerance


def _group(
    first: tuple[_PendingMark, FiredPulse], agreeing: list[tuple[_PendingMark, FiredPulse]]
) -> list[tuple[_PendingMark, FiredPulse]]:
    """The pairs that agree, less those whose mark or pulse occurs twice."""
    marks = Counter(id(pending) for pending, _ in agreeing)
    pulses = Counter(pulse.number for _, pulse in agreeing)
    return [
        p for p in agreeing if (marks[id(p[0])] == 1 and pulses[p[1].number] == 1) or p is first
    ]


def _key(pair: tuple[_PendingMark, FiredPulse]) -> tuple[int, int]:
    return id(pair[0]), pair[1].number
