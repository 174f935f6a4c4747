"""Which event mark belongs to which pulse: an assignment that may be revised until it is sealed.

A mark is given to a pulse only where its time fits that pulse and no other, and where neither its
count nor its arrival speaks for another. What cannot be decided is held, and looked at again
whenever something new is known; what belongs nowhere in the end is spurious.

Source: docs/mathematics/time.md#which-mark-belongs-to-which-pulse.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import combinations
from typing import Final

from daemon.onboard.timing.clock import GpsEstimate, HostClock
from daemon.onboard.timing.pulses import Cause, Match, Pulse
from drivers.contract import EventMark

WINDOW_NS: Final = 2_000_000
"""How far a mark may lie from its pulse beside what the clock is unsure of."""
SIGMAS: Final = 5
COARSE_WINDOW_NS: Final = 355_000_000
"""Half of what messages leave open, and a little."""
BEFORE_NS: Final = 5_000_000
"""No mark arrives before its strobe; so much is forgiven to the pulse's own host time."""
USUAL_NS: Final = 1_200_000_000
"""A mark comes with the receiver's next epoch, at most a second later, and its way."""
AGREE_NS: Final = 1_000_000
AGREE_RATE: Final = 50e-6
RATE_LIMIT: Final = 1e-3
SAME_NS: Final = 1_000
MARKS_TO_RETHINK: Final = 2
DUPLICATES_KEPT: Final = 256
HELD_AT_MOST: Final = 32
"""A strobe line full of noise must not cost the service its time: the oldest are given up."""
PAIRS_TO_RETHINK: Final = 100


@dataclass(eq=False)
class _Held:
    mark: EventMark
    number: int | None = None
    is_ambiguous: bool = False


@dataclass
class _Channel:
    """What is known of one input of one receiver.

    Its count less the pulses' is believed once two marks have said the same of it.
    """

    last_offset: int | None = None
    is_confirmed: bool = False
    seen: dict[int, None] = field(default_factory=dict)

    @property
    def offset(self) -> int | None:
        return self.last_offset if self.is_confirmed else None

    def learn(self, offset: int) -> None:
        self.is_confirmed = offset == self.last_offset
        self.last_offset = offset


class MarkMatcher:
    """Event marks against pulses. Pulses are noted first; everything may come in any order."""

    def __init__(self, clock: HostClock) -> None:
        self._clock = clock
        self._pulses: dict[int, Pulse] = {}
        self._sealed: dict[int, bool] = {}
        self._held: list[_Held] = []
        self._crowded_out: list[EventMark] = []
        self._given: dict[int, _Held] = {}
        self._corroborated: set[int] = set()
        self._channels: dict[tuple[str, int], _Channel] = {}

    def pulse(self, pulse: Pulse) -> None:
        """Note a pulse; a mark that came before it may now be its own."""
        self._pulses[pulse.number] = pulse
        self._clock.pulse_given(pulse.sigma_ns)
        self.reconsider()

    def forget_before(self, number: int) -> None:
        """Drop pulses whose marks are counted late by now."""
        for old in [n for n in self._pulses if n < number]:
            del self._pulses[old]
            self._sealed.pop(old, None)
            self._given.pop(old, None)
            self._corroborated.discard(old)

    def mark(self, mark: EventMark) -> Match:
        """Take a mark in, and say what is known of it by now.

        DUPLICATE, CORRUPT and LATE are final; USED and PENDING may change until the exposure is
        sealed.
        """
        if not mark.time_valid:
            return Match(None, Cause.CORRUPT)
        channel = self._channels.setdefault((mark.receiver, mark.channel), _Channel())
        if any(at in channel.seen for at in range(mark.gps_ns - 1, mark.gps_ns + 2)):
            twin = next((h.number for h in self._everything() if _is_same(h.mark, mark)), None)
            return Match(twin, Cause.DUPLICATE)
        channel.seen[mark.gps_ns] = None
        while len(channel.seen) > DUPLICATES_KEPT:
            del channel.seen[next(iter(channel.seen))]
        held = _Held(mark)
        self._held.append(held)
        while len(self._held) > HELD_AT_MOST:
            self._crowded_out.append(self._held.pop(0).mark)
        number = self._late_for(held)
        if number is not None:
            self._held.remove(held)
            already = number in self._given
            return Match(number, Cause.DUPLICATE if already else Cause.LATE)
        pulse = None if self._is_coarse() else self._pulse_of(held)
        if pulse is not None:
            self._give(held, pulse)
            self.reconsider()
        elif self._is_coarse():
            self.reconsider()
        elif len(self._held) >= MARKS_TO_RETHINK:
            self._rethink()
        if held.number is not None:
            return Match(held.number, Cause.USED)
        twin = self._belongs_to_a_marked(held)
        if twin is not None:
            self._held.remove(held)
            return Match(twin, Cause.DUPLICATE)
        return Match(None, Cause.PENDING, held.is_ambiguous)

    def reconsider(self) -> None:
        """Look again at every mark that is held; to be called when something new is known."""
        changed = True
        while changed:
            changed = False
            for held in list(self._held):
                pulse = self._pulse_of(held)
                if pulse is not None:
                    self._give(held, pulse)
                    changed = True
        if len(self._held) >= MARKS_TO_RETHINK:
            self._rethink()

    def mark_of(self, number: int) -> EventMark | None:
        """The mark an exposure has, as far as is known by now."""
        held = self._given.get(number)
        return None if held is None else held.mark

    def is_corroborated(self, number: int) -> bool:
        """Whether more than its own mark speaks for a pulse's mark."""
        return number in self._corroborated

    def has_ambiguous(self, number: int) -> bool:
        """Whether a held mark may be this pulse's, among others."""
        pulse = self._pulses.get(number)
        return pulse is not None and any(
            held.is_ambiguous and pulse in self._near(held) for held in self._held
        )

    def seal(self, number: int) -> bool:
        """The exposure is sealed: its mark is final. Whether it has one."""
        self._sealed[number] = True
        return number in self._given

    def give_up(self, before_mono_ns: int) -> list[EventMark]:
        """Marks that arrived before an instant and belong nowhere: final, and forgotten."""
        spurious = [held.mark for held in self._held if held.mark.mono_ns < before_mono_ns]
        self._held = [held for held in self._held if held.mark.mono_ns >= before_mono_ns]
        crowded_out, self._crowded_out = self._crowded_out, []
        return [*crowded_out, *spurious]

    # One mark

    def _pulse_of(self, held: _Held) -> Pulse | None:
        """The one pulse a held mark can be of; None where there is none, or a doubt."""
        near = self._near(held)
        free = [p for p in near if p.number not in self._given and not self._is_sealed(p)]
        counted = self._counted(held.mark)
        is_coarse = self._is_coarse()
        if is_coarse and len(free) > 1 and counted is not None:
            free = [pulse for pulse in free if pulse is counted]
        held.is_ambiguous = len(free) > 1
        if len(free) != 1:
            return None
        pulse = free[0]
        if is_coarse:
            # Two marks for one pulse, or two pulses for one mark: nothing tells them apart yet.
            rivals = [h for h in self._held if h is not held and pulse in self._near(h)]
            held.is_ambiguous = bool(rivals) or len(near) > 1
            if held.is_ambiguous and counted is not pulse:
                return None
            if not self._is_usual(held.mark, pulse) and counted is not pulse:
                return None
            return pulse
        if self._clock.is_doubtful and counted is not pulse:
            held.is_ambiguous = True
            return None
        if counted is not None and counted is not pulse and not self._is_usual(held.mark, pulse):
            is_free = counted.number not in self._given and not self._is_sealed(counted)
            if is_free and self._is_usual(held.mark, counted):
                held.is_ambiguous = True
                return None
        return pulse

    def _give(self, held: _Held, pulse: Pulse) -> None:
        mark = held.mark
        is_first = self._is_coarse()
        held.number, held.is_ambiguous = pulse.number, False
        self._held.remove(held)
        self._given[pulse.number] = held
        if mark.count_bits:
            channel = self._channels[(mark.receiver, mark.channel)]
            channel.learn((mark.count - pulse.count) % (1 << mark.count_bits))
        self._teach(held, pulse)
        if is_first:
            return
        self._corroborated.add(pulse.number)
        self._corroborated |= {n for n in self._given if not self._sealed.get(n)}

    def _teach(self, held: _Held, pulse: Pulse) -> None:
        self._clock.mark_matched(
            held.mark.gps_ns,
            pulse.mono_ns + pulse.strobe_delay_ns,
            pulse.sigma_ns,
            accuracy_ns=held.mark.accuracy_ns,
            key=pulse.number,
        )

    def _near(self, held: _Held) -> list[Pulse]:
        """Pulses whose strobe this mark may be by time and arrival."""
        mark, found = held.mark, []
        reference = self._clock.gps_at(mark.mono_ns)
        if reference is None:
            return []
        for pulse in self._pulses.values():
            strobe_ns = pulse.mono_ns + pulse.strobe_delay_ns
            # A clock is never off by more than this: most pulses need no closer look.
            apart_ns = mark.mono_ns - strobe_ns
            rough_ns = mark.gps_ns - (reference.gps_ns - apart_ns)
            if abs(rough_ns) > COARSE_WINDOW_NS + SIGMAS * reference.sigma_ns + abs(
                round(apart_ns * RATE_LIMIT)
            ):
                continue
            if apart_ns < -BEFORE_NS - SIGMAS * pulse.sigma_ns:
                continue
            expected = self._clock.pulse_at(strobe_ns, pulse.sigma_ns)
            if expected is not None and abs(mark.gps_ns - expected.gps_ns) <= _window(expected):
                found.append(pulse)
        return found

    def _counted(self, mark: EventMark) -> Pulse | None:
        """The pulse a mark is of by its count; None where it has none, or that tells nothing."""
        channel = self._channels[(mark.receiver, mark.channel)]
        if not mark.count_bits or channel.offset is None:
            return None
        modulus = 1 << mark.count_bits
        wanted = (mark.count - channel.offset) % modulus
        found = [
            pulse
            for pulse in self._pulses.values()
            if pulse.count % modulus == wanted and _arrives(mark, pulse)
        ]
        return found[0] if len(found) == 1 else None

    def _late_for(self, held: _Held) -> int | None:
        """The sealed exposure a mark is late for, or a second mark of."""
        if self._is_coarse():
            return None
        near = self._near(held)
        sealed = [pulse for pulse in near if self._is_sealed(pulse)]
        return sealed[0].number if len(near) == len(sealed) == 1 else None

    def _belongs_to_a_marked(self, held: _Held) -> int | None:
        if self._is_coarse() or self._clock.is_doubtful:
            return None
        near = self._near(held)
        if len(near) == 1 and near[0].number in self._given and self._is_usual(held.mark, near[0]):
            return near[0].number
        return None

    def _is_coarse(self) -> bool:
        return self._clock.is_coarse

    def _is_sealed(self, pulse: Pulse) -> bool:
        return self._sealed.get(pulse.number, False)

    def _is_usual(self, mark: EventMark, pulse: Pulse) -> bool:
        return mark.mono_ns - pulse.mono_ns - pulse.strobe_delay_ns <= USUAL_NS

    def _everything(self) -> Iterable[_Held]:
        yield from self._held
        yield from self._given.values()

    # Several marks

    def _rethink(self) -> None:
        """Marks that fit nothing but fit pulses alike, all shifted by the same: then the clock is
        wrong, not they. Only where there is one such shift."""
        pairs = [
            (held, pulse)
            for held in self._held
            for pulse in self._pulses.values()
            if _arrives(held.mark, pulse)
            and self._is_usual(held.mark, pulse)
            and not self._is_sealed(pulse)
        ]
        if len(pairs) > PAIRS_TO_RETHINK:
            return  # so much noise explains anything
        best: list[list[tuple[_Held, Pulse]]] = []
        for first, second in combinations(pairs, 2):
            if first[0] is second[0] or first[1] is second[1] or not _agree(first, second):
                continue
            group = _group(first, [pair for pair in pairs if _agree(first, pair)])
            if not any({_key(p) for p in group} <= {_key(p) for p in other} for other in best):
                best.append(group)
        best.sort(key=len, reverse=True)
        if not best or len(best[0]) < MARKS_TO_RETHINK:
            return
        if len(best) > 1 and len(best[1]) >= len(best[0]) - 1:
            return  # another shift explains them as well
        group = best[0]
        if not all(self._count_allows(held.mark, pulse) for held, pulse in group):
            return
        if not self._clock.messages_allow(round(sum(map(_shift, group)) / len(group))):
            return
        against = sum(not self._sealed.get(number) for number in self._given)
        if len(group) <= against:
            return
        self._clock.restart()
        for number, given in list(self._given.items()):
            if not self._sealed.get(number):
                del self._given[number]
                self._corroborated.discard(number)
                given.number = None
                self._held.append(given)
        for held, pulse in group:
            self._give(held, pulse)

    def _count_allows(self, mark: EventMark, pulse: Pulse) -> bool:
        channel = self._channels[(mark.receiver, mark.channel)]
        if not mark.count_bits or channel.offset is None:
            return True
        return (mark.count - pulse.count - channel.offset) % (1 << mark.count_bits) == 0


def _window(expected: GpsEstimate) -> int:
    if expected.is_coarse:
        return COARSE_WINDOW_NS
    return WINDOW_NS + SIGMAS * expected.sigma_ns


def _arrives(mark: EventMark, pulse: Pulse) -> bool:
    """Whether the mark came after the strobe, as it must."""
    early_ns = pulse.mono_ns + pulse.strobe_delay_ns - mark.mono_ns
    return early_ns <= BEFORE_NS + SIGMAS * pulse.sigma_ns


def _is_same(a: EventMark, b: EventMark) -> bool:
    same_input = (a.receiver, a.channel) == (b.receiver, b.channel)
    return same_input and abs(a.gps_ns - b.gps_ns) <= SAME_NS


def _shift(pair: tuple[_Held, Pulse]) -> int:
    held, pulse = pair
    return held.mark.gps_ns - pulse.mono_ns - pulse.strobe_delay_ns


def _agree(a: tuple[_Held, Pulse], b: tuple[_Held, Pulse]) -> bool:
    apart_ns = abs(a[1].mono_ns - b[1].mono_ns)
    tolerance = AGREE_NS + SIGMAS * (a[1].sigma_ns + b[1].sigma_ns) + apart_ns * AGREE_RATE
    return abs(_shift(a) - _shift(b)) <= tolerance


def _group(
    first: tuple[_Held, Pulse], agreeing: list[tuple[_Held, Pulse]]
) -> list[tuple[_Held, Pulse]]:
    """The pairs that agree, less those whose mark or pulse occurs twice."""
    marks = Counter(id(held) for held, _ in agreeing)
    pulses = Counter(pulse.number for _, pulse in agreeing)
    return [
        p for p in agreeing if (marks[id(p[0])] == 1 and pulses[p[1].number] == 1) or p is first
    ]


def _key(pair: tuple[_Held, Pulse]) -> tuple[int, int]:
    return id(pair[0]), pair[1].number
