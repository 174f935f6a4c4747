"""Frames that arrive before the answer to their trigger, as software triggers answer last."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from daemon.onboard.service.exposure_sequence import EARLY_FRAME_LIMIT_NS
from daemon.onboard.service.flight_line import Order
from daemon.onboard.service.messages import Fired, Recycle
from drivers.contract import TriggerPulse
from tests.daemon.onboard.flight.test_flight import HEADS, NS, STROBE_NS, frame, pulse
from tests.daemon.onboard.service.sequence_bench import SequenceBench

pytestmark = pytest.mark.trust
INTERVAL_S = 1.35


class Flown(SequenceBench):
    """A flight's records in the order in which they come; what was reported of frames."""

    def order(self, number: int) -> None:
        given = pulse(number, INTERVAL_S * number)
        assert self.flight.order(given.mono_ns) == number
        self.sequence.fire(Order(number, given.mono_ns, given.delays_ns, STROBE_NS))

    def frame(self, number: int, head: str, *, is_timed: bool) -> None:
        """A frame of a head; one of a folder has no clock of its own."""
        given = pulse(number, INTERVAL_S * number)
        came = frame(head, given, slot=number % 3)
        if not is_timed:
            came = replace(came, device_clock_ns=None, device_clock_mono_ns=None)
        self.receive(came)

    def answer(self, number: int, *, fired: bool = True) -> None:
        given = pulse(number, INTERVAL_S * number)
        trigger_pulse = TriggerPulse(
            number, given.mono_ns, given.sigma_ns, given.count, given.spread_ns
        )
        self.receive(Fired(number, trigger_pulse if fired else None, "" if fired else "no unit"))

    @property
    def frames(self) -> dict[str, int]:
        sheet = self.flight.ledger.sheet().frames
        return {cause: getattr(sheet, cause) for cause in ("used", "spurious", "late")}


@pytest.fixture(params=[False, True], ids=["folder", "with a clock"])
def is_timed(request: pytest.FixtureRequest) -> Iterator[bool]:
    yield request.param


def test_a_frame_before_the_answer_to_its_trigger_is_used(is_timed: bool) -> None:
    flown = Flown()
    for number in range(1, 6):
        flown.order(number)
        flown.frame(number, HEADS[0], is_timed=is_timed)
        flown.frame(number, HEADS[1], is_timed=is_timed)
        flown.answer(number)
        flown.frame(number, HEADS[2], is_timed=is_timed)
    assert flown.frames == {"used": 15, "spurious": 0, "late": 0}
    assert flown.events == [("triggered", number) for number in range(1, 6)]
    # A replay of the log sees the trigger first.
    kinds = ["decision", "trigger", *(f"frame/{head}" for head in HEADS)]
    assert flown.logged == kinds * 5


def test_an_early_frame_is_not_given_to_an_exposure_whose_own_is_missing() -> None:
    flown = Flown()
    for number in (1, 2, 3):
        flown.order(number)
        flown.answer(number)
        for head in HEADS if number < 3 else HEADS[1:]:
            flown.frame(number, head, is_timed=False)
    flown.order(4)
    flown.frame(4, HEADS[0], is_timed=False)
    flown.answer(4)
    assert flown.frames["spurious"] == 0
    exposures = flown.flight._open
    assert HEADS[0] not in exposures[3].frames
    assert exposures[4].frames[HEADS[0]].counter == 4


def test_a_frame_of_an_earlier_exposure_does_not_wait_for_a_trigger() -> None:
    flown = Flown()
    flown.order(1)
    flown.answer(1)
    flown.order(2)
    flown.frame(1, HEADS[0], is_timed=True)
    assert flown.frames["used"] == 1


def test_an_early_frame_of_a_trigger_that_failed_is_spurious_and_its_slot_free() -> None:
    flown = Flown()
    flown.order(1)
    flown.frame(1, HEADS[0], is_timed=False)
    assert flown.frames == {"used": 0, "spurious": 0, "late": 0}
    flown.answer(1, fired=False)
    assert flown.frames["spurious"] == 1
    assert flown.sent["capture"][-1] == Recycle({HEADS[0]: 1})


def test_a_trigger_that_never_answers_keeps_no_slot_for_ever() -> None:
    flown = Flown()
    flown.order(1)
    flown.frame(1, HEADS[0], is_timed=False)
    given = pulse(1, INTERVAL_S)
    arrived_ns = frame(HEADS[0], given).mono_ns
    for now_ns in (arrived_ns + EARLY_FRAME_LIMIT_NS, arrived_ns + EARLY_FRAME_LIMIT_NS + NS):
        assert flown.frames["spurious"] == 0
        flown.now_ns = now_ns
        flown.sequence.advance()
    assert flown.sent["capture"][-1] == Recycle({HEADS[0]: 1})
    assert flown.frames["spurious"] == 1


def test_the_answer_to_a_trigger_that_was_given_up_ends_nothing() -> None:
    """It comes after up to ten seconds, its exposure is given up after eight and sealed as lost."""
    flown = Flown()
    flown.order(1)
    due = flown.flight.advance(pulse(1, INTERVAL_S).mono_ns + 9 * NS)
    assert due.lost == ((1, "no pulse was given"),) and due.seal is not None
    flown.flight.sealed(1)
    flown.answer(1)
    flown.frame(1, HEADS[0], is_timed=True)
    assert flown.frames["late"] == 1 and flown.sent["capture"][-1] == Recycle({HEADS[0]: 1})
    assert not flown.flight.ledger.imbalances()
