"""A disk that refuses a record: the exposure stays open and its record is sealed again."""

from __future__ import annotations

from daemon.onboard.flight.flight import SEAL_RETRY_NS
from daemon.onboard.service.messages import Recycle, Seal, Store, WriteFailed
from tests.daemon.onboard.flight.test_flight import (
    HEADS,
    NS,
    Flight,
    flight,
    fly_one,
    mark,
    nav,
    stored_frames,
)
from tests.daemon.onboard.service.sequence_bench import SequenceBench


def flown(new_flight: Flight) -> int:
    """Fly one stored exposure whose record is due; return that instant."""
    given = fly_one(new_flight, 1, 0.0)
    new_flight.stored(1, stored_frames(new_flight, 1, NS))
    new_flight.take(mark(given))
    new_flight.take(nav(1.0))
    return 4 * NS


def test_a_refused_record_is_rebuilt_identically() -> None:
    new_flight = flight()
    now_ns = flown(new_flight)
    first = new_flight.advance(now_ns).seal
    assert first is not None and first.mark_source == "event-mark"
    assert len(first.frames) == len(HEADS)
    assert new_flight.advance(now_ns + NS).seal is None, "one record is with the writer at a time"
    new_flight.seal_refused(now_ns)
    refused = new_flight.advance(now_ns + SEAL_RETRY_NS - 1)
    assert refused.seal is None and refused.next_ns == now_ns + SEAL_RETRY_NS + 1
    assert new_flight.advance(now_ns + SEAL_RETRY_NS).seal == first
    new_flight.sealed(1)
    assert new_flight.advance(now_ns + 2 * SEAL_RETRY_NS).seal is None
    assert new_flight.ledger.imbalances(has_landed=True) == []


def test_the_service_seals_again_after_a_second_and_closes_nothing() -> None:
    bench = SequenceBench()
    bench.now_ns = flown(bench.flight)
    bench.sequence.advance()
    (seal,) = bench.sent["writer"]
    assert isinstance(seal, Seal)
    bench.receive(WriteFailed(1, "the disk is full", is_transient=True))
    assert bench.flight.sealing is None and bench.flight.open_numbers == (1,)
    assert bench.decisions[-1].kind == "seal-refused"
    assert bench.sequence.advance() == bench.now_ns + SEAL_RETRY_NS + 1
    assert bench.sent["writer"] == [seal] and bench.events == [("not-written", 1)]
    # What cannot become right by waiting is closed, and left to recovery.
    bench.now_ns += SEAL_RETRY_NS
    bench.sequence.advance()
    assert bench.sent["writer"] == [seal, seal]
    bench.receive(WriteFailed(1, "sealed with other content"))
    assert bench.decisions[-1].kind == "not-sealed"
    assert bench.flight.sealing is None and bench.flight.open_numbers == ()


def test_frames_that_the_disk_refuses_go_back_to_their_heads_and_the_exposure_is_lost() -> None:
    bench = SequenceBench()
    fly_one(bench.flight, 1, 0.0)
    bench.sequence.advance()
    (store,) = bench.sent["writer"]
    assert isinstance(store, Store) and store.slots.keys() == set(HEADS)
    bench.receive(WriteFailed(1, "No space left on device"))
    assert bench.sent["capture"] == [Recycle(store.slots)]
    assert bench.events[-2:] == [("not-written", 1), ("lost", 1)]
    bench.sequence.advance()
    assert bench.sent["writer"][-1].exposure.state == "lost"
