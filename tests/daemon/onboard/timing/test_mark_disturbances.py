"""Normal weather of event marks, from the bytes of every receiver to the pulse: weeks, leap
seconds, counts that wrap and restart, late, doubled and swallowed edges. None is paired wrongly."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import pytest

from daemon.onboard.timing.gps_clock import GpsClock
from daemon.onboard.timing.matching import Cause, FiredPulse, Matcher
from drivers.contract import EventMark
from drivers.receivers.message_decoder import MessageDecoder
from drivers.receivers.nmea.decoder import NmeaDecoder
from drivers.receivers.novatel.decoder import NovatelDecoder
from drivers.receivers.septentrio.decoder import SbfDecoder
from drivers.receivers.ublox.decoder import UbxDecoder
from sim_hw.receivers.emulated_receiver import ReceiverState
from sim_hw.receivers.nmea_sentences import ptnl_event, rmc
from sim_hw.receivers.novatel_messages import mark_time
from sim_hw.receivers.septentrio_messages import ext_event, receiver_time
from sim_hw.receivers.ublox_messages import tim_tm2

NS = 1_000_000_000
WEEK_NS = 604_800 * NS
ORDINARY_NS = 2400 * WEEK_NS + 300_000 * NS + 250_000_000
LEAP_2017_NS = 1_167_264_017 * NS
"""GPS time of 2017-01-01T00:00:00 UTC less the leap second before it."""
INTERVAL_NS = 2 * NS + 3_000_000
STROBE_NS = 3_000_000
CONES = {"SU00": "0"}
STATE = ReceiverState(48.0, 11.0, 3400.0, (60.0, 0.0, 0.0), 0.0, 0.0, 0.0)


def leap_at(gps_ns: int) -> int:
    return 18 if gps_ns >= LEAP_2017_NS + NS else 17


def ublox(gps_ns: int, count: int) -> bytes:
    return tim_tm2(
        rising_gps_ns=gps_ns,
        falling_gps_ns=gps_ns + 50_000,
        is_new_rising=True,
        is_new_falling=True,
        rising_count=count & 0xFFFF,
        accuracy_ns=25,
    )


def novatel(gps_ns: int, count: int) -> bytes:
    return mark_time(1, gps_ns, 120, leap_at(gps_ns))


def septentrio(gps_ns: int, count: int) -> bytes:
    in_count = receiver_time(gps_ns, leap_at(gps_ns))
    return in_count + ext_event(gps_ns + 300, 300, source=1, polarity=0)


def nmea(gps_ns: int, count: int) -> bytes:
    earlier = (gps_ns - 400_000_000, gps_ns - 200_000_000)
    return b"".join(rmc(at_ns, STATE, leap_at(at_ns)) for at_ns in earlier) + ptnl_event(
        gps_ns, count & 0xFFFF, leap_at(gps_ns)
    )


Encode = Callable[[int, int], bytes]
RECEIVERS: Mapping[str, tuple[type[MessageDecoder], Encode]] = {
    "ublox": (UbxDecoder, ublox),
    "novatel": (NovatelDecoder, novatel),
    "septentrio": (SbfDecoder, septentrio),
    "nmea": (NmeaDecoder, nmea),
}
COUNTING = ("ublox", "nmea")


class Bench:
    """Pulses from `start_ns` on, a clock held by PPS, and one receiver."""

    def __init__(self, receiver: str, start_ns: int, *, has_pps: bool = True) -> None:
        decoder, self._encode = RECEIVERS[receiver]
        self._decoder = decoder("gnss")
        self.start_ns = start_ns
        self.clock = GpsClock()
        second_ns = -(start_ns % NS)
        for k in range(4):
            if has_pps:
                self.clock.pps_edge(second_ns + (k - 4) * NS, 2_000)
            gps_ns = start_ns + second_ns + (k - 4) * NS + 200_000_000
            self.clock.message_arrived(gps_ns, gps_ns - start_ns + 60_000_000)
        self.matcher = Matcher(CONES, self.clock)
        self.number = 0

    def pulse(self, *, after_ns: int = INTERVAL_NS) -> int:
        """Give the next pulse; its number."""
        self.number += 1
        self._at = getattr(self, "_at", 0) + after_ns
        self.matcher.pulse(
            FiredPulse(self.number, self._at, 60_000, self.number, {"0": 0}, STROBE_NS)
        )
        self.strobes = {**getattr(self, "strobes", {}), self.number: self._at + STROBE_NS}
        return self.number

    def mark(self, number: int, count: int | None = None, late_ns: int = 150_000_000) -> Cause:
        """The receiver's word for a pulse, through its decoder."""
        at_ns = self.strobes[number]
        counted = number if count is None else count
        data = self._encode(self.start_ns + at_ns, counted)
        (mark,) = [m for m in self._decoder.feed(data, at_ns + late_ns) if isinstance(m, EventMark)]
        return self.matcher.mark(mark).cause

    def assert_right(self, *numbers: int) -> None:
        """Exactly these have a mark, and each its own."""
        for number in range(1, self.number + 1):
            mark = self.matcher.mark_of(number)
            assert (mark is not None) == (number in numbers), number
            if mark is not None:
                assert abs(mark.gps_ns - self.start_ns - self.strobes[number]) <= 1_000


@pytest.mark.parametrize("receiver", RECEIVERS)
@pytest.mark.parametrize(
    "start_ns",
    [
        ORDINARY_NS,
        2401 * WEEK_NS - 5 * NS,
        3072 * WEEK_NS - 5 * NS,
        2400 * WEEK_NS + 86_400 * NS + 18 * NS - 5 * NS,
        LEAP_2017_NS - 6 * NS,
    ],
    ids=["ordinary", "week rolls over", "10-bit week rolls over", "UTC midnight", "leap second"],
)
def test_every_mark_finds_its_pulse_whatever_the_calendar_does(
    receiver: str, start_ns: int
) -> None:
    bench = Bench(receiver, start_ns)
    for _ in range(6):
        number = bench.pulse()
        assert bench.mark(number) is Cause.USED
    bench.assert_right(*range(1, 7))


@pytest.mark.parametrize("receiver", RECEIVERS)
def test_a_lost_mark_leaves_its_own_exposure_without_and_no_other(receiver: str) -> None:
    bench = Bench(receiver, ORDINARY_NS, has_pps=False)
    for _ in range(8):
        number = bench.pulse()
        if number not in (4, 5):
            bench.mark(number)
    bench.assert_right(1, 2, 3, 6, 7, 8)


@pytest.mark.parametrize("receiver", COUNTING)
@pytest.mark.parametrize("has_pps", [True, False])
def test_a_count_that_wraps_and_one_that_restarts_shift_nothing(
    receiver: str, *, has_pps: bool
) -> None:
    bench = Bench(receiver, ORDINARY_NS, has_pps=has_pps)
    counts = [65_533, 65_534, 65_535, 0, 1, 2, 0, 1, 2, 3]
    for count in counts:
        assert bench.mark(bench.pulse(), count) is Cause.USED
    bench.assert_right(*range(1, len(counts) + 1))


@pytest.mark.parametrize("receiver", COUNTING)
def test_an_edge_the_receiver_never_saw_and_one_that_was_noise_shift_nothing(receiver: str) -> None:
    bench = Bench(receiver, ORDINARY_NS)
    for number, count in zip(range(1, 9), [1, 2, 3, None, 4, 5, 7, 8], strict=True):
        bench.pulse()
        if count is not None:
            assert bench.mark(number, count) is Cause.USED
    bench.assert_right(1, 2, 3, 5, 6, 7, 8)


@pytest.mark.parametrize("receiver", RECEIVERS)
def test_a_late_mark_still_finds_its_pulse_and_a_second_copy_is_a_duplicate(receiver: str) -> None:
    bench = Bench(receiver, ORDINARY_NS)
    for _ in range(5):
        bench.pulse()
    for number in (1, 2, 4, 5):
        bench.mark(number)
    assert bench.mark(3, late_ns=5 * NS) is Cause.USED
    bench.assert_right(1, 2, 3, 4, 5)
    bench.matcher.marks.seal(2)
    again = EventMark("gnss", 0, ORDINARY_NS + bench.strobes[5], 25, 5, 0, True, 60 * NS)
    first, second = bench.matcher.mark(again).cause, bench.matcher.mark(again).cause
    assert (first, second) in ((Cause.DUPLICATE, Cause.DUPLICATE), (Cause.PENDING, Cause.DUPLICATE))
    bench.assert_right(1, 2, 3, 4, 5)


def test_a_mark_for_a_sealed_exposure_is_late_and_changes_nothing() -> None:
    bench = Bench("ublox", ORDINARY_NS)
    for _ in range(3):
        bench.pulse()
    bench.mark(1)
    bench.matcher.marks.seal(2)
    assert bench.mark(2) is Cause.LATE
    assert bench.mark(3) is Cause.USED
    bench.assert_right(1, 3)


def test_of_two_edges_in_one_epoch_the_receiver_sends_the_last_and_the_first_stays_unmatched() -> (
    None
):
    bench = Bench("ublox", ORDINARY_NS)
    for number in range(1, 4):
        bench.pulse()
        bench.mark(number)
    swallowed = bench.pulse()
    in_count = bench.pulse(after_ns=90_000_000)
    assert bench.mark(in_count, count=5) is Cause.USED
    following = bench.pulse()
    assert bench.mark(following, count=6) is Cause.USED
    assert bench.matcher.mark_of(swallowed) is None
    bench.assert_right(1, 2, 3, in_count, following)


def test_before_anything_is_known_a_swallowed_edge_is_not_guessed() -> None:
    bench = Bench("ublox", ORDINARY_NS, has_pps=False)
    bench.pulse()
    in_count = bench.pulse(after_ns=90_000_000)
    assert bench.mark(in_count, count=2) is Cause.PENDING, "the one or the other, nobody knows"
    for count in (3, 4, 5):
        bench.mark(bench.pulse(), count)
    bench.assert_right(in_count, 3, 4, 5)


@pytest.mark.parametrize("late_ms", [1, 10, 120, 400, 690])
def test_the_second_of_an_edge_is_named_by_messages_however_late_they_are(late_ms: int) -> None:
    clock = GpsClock()
    for k in range(5):
        clock.pps_edge(k * NS, 2_000)
        gps_ns = ORDINARY_NS - 250_000_000 + k * NS + 200_000_000
        clock.message_arrived(gps_ns, k * NS + 200_000_000 + late_ms * 1_000_000)
    estimate = clock.gps_at(4 * NS)
    assert estimate is not None and estimate.source == "pps"
    assert abs(estimate.gps_ns - (ORDINARY_NS - 250_000_000 + 4 * NS)) < 10_000


def test_a_second_that_messages_cannot_resolve_stays_unresolved_until_a_mark() -> None:
    clock = GpsClock()
    epoch_ns = ORDINARY_NS - 250_000_000
    for k in range(5):
        clock.pps_edge(k * NS, 2_000)
        clock.message_arrived(epoch_ns + k * NS, k * NS + 850_000_000)
    estimate = clock.gps_at(4 * NS)
    assert estimate is not None and estimate.is_coarse
    clock.mark_matched(epoch_ns + 4 * NS + 300_000_000, 4 * NS + 300_020_000, 60_000)
    estimate = clock.gps_at(5 * NS)
    assert estimate is not None and estimate.source == "pps"
    assert abs(estimate.gps_ns - epoch_ns - 5 * NS) < 10_000


def test_a_strobe_line_full_of_noise_pairs_nothing_wrongly_and_every_edge_is_accounted_for() -> (
    None
):
    bench = Bench("novatel", ORDINARY_NS)
    sent = []
    for number in range(1, 9):
        bench.pulse()
        for k in range(60):
            gps_ns = ORDINARY_NS + bench.strobes[number] + (k + 1) * 7_123_457
            sent.append(EventMark("gnss", 1, gps_ns, 100, 0, 0, True, bench.strobes[number] + NS))
            assert bench.matcher.mark(sent[-1]).cause is Cause.PENDING
        bench.mark(number)
    bench.assert_right(*range(1, 9))
    given_up = bench.matcher.marks.give_up(10**15)
    assert sorted(m.gps_ns for m in given_up) == sorted(m.gps_ns for m in sent)


def test_a_count_that_is_not_there_is_never_believed() -> None:
    bench = Bench("novatel", ORDINARY_NS)
    for number in range(1, 5):
        bench.pulse()
        bench.mark(number)
    bench.pulse()
    wrong = ORDINARY_NS + bench.strobes[5] - 700_000_000
    mark = EventMark("gnss", 1, wrong, 100, 5, 0, True, bench.strobes[5] + 100_000_000)
    assert bench.matcher.mark(mark).cause is Cause.PENDING
    bench.assert_right(1, 2, 3, 4)
