"""An exposure between pulse and seal: what is waited for, what is given up, what is recorded."""

from __future__ import annotations

from dataclasses import replace

import pytest

from daemon.configuration.model import LimitsSection
from daemon.mission.exposure import Exposure, FrameRecord
from daemon.mission.log.log_records import LoggedTrigger, message_of, record_of
from daemon.onboard.flight.flight import Flight
from daemon.onboard.flight.flight_identity import FlightIdentity
from daemon.onboard.flight.ledger import Ledger
from daemon.onboard.flight.recovery_match import seal_from_log
from daemon.onboard.timing.matching import Cause, FiredPulse
from drivers.contract import (
    ClockReading,
    EventMark,
    Frame,
    FrameStatus,
    NavSample,
    PpsEdge,
    TemperatureSample,
    TriggerPulse,
)
from processing.quality.report import Flag
from processing.rig import find_rig

NS = 1_000_000_000
GPS_NS = 1_400_000_000 * NS
RIG = find_rig("ultracam-x-mini")
HEADS = ("SU00", "SU10", "G")
LIMITS = LimitsSection(frame_timeout_s=8.0, mark_timeout_s=3.0)
DELAYS_NS = {cone.name: 1_000_000 * index for index, cone in enumerate(RIG.cones)}
STROBE_NS = DELAYS_NS["0"] + 2_000_000
IDENTITY = FlightIdentity("boot", "1", "calibration", "", "", "syntopic test", simulated=True)


def flight(*, has_pps: bool = True) -> Flight:
    made = Flight(
        RIG, dict.fromkeys(HEADS, "serial"), IDENTITY, LIMITS, Ledger(heads=HEADS), first_number=1
    )
    for earlier in EARLIER:
        if isinstance(earlier, NavSample) or has_pps:
            made.take(earlier)
    for probe in RIG.probes:
        made.take(TemperatureSample(probe, 32.0, -NS // 2))
    return made


def nav(t_s: float) -> NavSample:
    return NavSample(
        receiver="gnss",
        gps_ns=GPS_NS + round(t_s * NS),
        mono_ns=round(t_s * NS) + 60_000_000,
        fix="3d",
        satellites=12,
        latitude_deg=48.0 + t_s * 55.0 / 111_200,
        longitude_deg=11.0,
        height_m=3395.0,
        horizontal_sigma_m=0.5,
        vertical_sigma_m=0.9,
        velocity_ned_mps=(55.0, 0.0, 0.0),
        speed_sigma_mps=0.05,
        roll_rad=0.0,
        pitch_rad=0.0,
        heading_rad=0.0,
        leap_seconds=18,
        time_valid=True,
    )


EARLIER = [
    PpsEdge("gnss", 1, -2 * NS, 1_000),
    *(nav(t_s) for t_s in (-1.4, -1.2, -1.0)),
    PpsEdge("gnss", 2, -NS, 1_000),
]


def pulse(number: int, t_s: float) -> FiredPulse:
    return FiredPulse(number, round(t_s * NS), 50_000, number, DELAYS_NS, STROBE_NS)


def frame(head: str, given: FiredPulse, slot: int = 0) -> Frame:
    start_ns = given.mono_ns + given.delays_ns[RIG.cone_of(head).name]
    return Frame(
        head=head,
        slot=slot,
        status=FrameStatus.COMPLETE,
        frame_id=given.number,
        counter=given.number,
        width_px=1248,
        height_px=832,
        pixel_format="Mono16",
        device_ns=start_ns,
        device_clock_ns=0,
        device_clock_mono_ns=0,
        latch_sigma_ns=1000,
        mono_ns=start_ns + NS // 2,
        exposure_time_us=4000.0,
        temperature_c=31.0,
    )


def mark(given: FiredPulse) -> EventMark:
    gps_ns = GPS_NS + given.mono_ns + given.strobe_delay_ns
    return EventMark("gnss", 0, gps_ns, 25, given.count, 16, True, given.mono_ns + NS // 4)


def stored_frames(flying: Flight, number: int, mono_ns: int) -> tuple[FrameRecord, ...]:
    (due,) = flying.advance(mono_ns).store
    assert due.capture.number == number
    return tuple(
        replace(record, file=f"{record.sensor}.tif", sha256="0" * 64)
        for record in due.capture.frames
    )


def fly_one(flying: Flight, number: int, t_s: float, heads: tuple[str, ...] = HEADS) -> FiredPulse:
    assert flying.order(round(t_s * NS)) == number
    given = pulse(number, t_s)
    flying.fired(given)
    for head in heads:
        assert flying.take(frame(head, given)) is Cause.USED
    return given


def seal(flying: Flight, mono_ns: int) -> Exposure:
    exposure = flying.sealing or flying.advance(mono_ns).seal
    assert exposure is not None
    flying.sealed(exposure.number)
    return exposure


def test_a_whole_exposure_is_stored_sealed_and_on_the_receivers_time() -> None:
    flying = flight()
    given = fly_one(flying, 1, 0.0)
    frames = stored_frames(flying, 1, NS)
    assert not flying.advance(NS).store, "an exposure is handed to the disk once"
    flying.stored(1, frames)
    assert flying.advance(NS).seal is None, "neither mark nor position are final"
    flying.take(mark(given))
    assert flying.advance(NS).seal is None, "the position beyond the mark is awaited"
    flying.take(nav(0.2))
    exposure = seal(flying, NS)
    assert exposure.state == "complete" and exposure.mark_source == "event-mark"
    assert exposure.mark_gps_ns == GPS_NS + STROBE_NS
    green = exposure.frame("G")
    assert green is not None
    assert green.mid_exposure_gps_ns == GPS_NS + DELAYS_NS["G"] + 2_000_000
    assert exposure.navigation is not None and exposure.navigation.method == "interpolated"
    assert {t.probe: t.age_ns for t in exposure.temperatures}["0"] == NS // 2
    assert not flying.open_numbers and not flying.ledger.imbalances()


def test_a_missing_frame_is_waited_for_and_then_the_exposure_is_degraded() -> None:
    flying = flight()
    given = fly_one(flying, 1, 0.0, HEADS[:2])
    assert not flying.advance(8 * NS).store
    flying.stored(1, stored_frames(flying, 1, 9 * NS))
    flying.take(mark(given))
    flying.take(nav(0.2))
    assert flying.take(frame("G", given, slot=2)) is Cause.LATE
    exposure = seal(flying, 9 * NS)
    assert exposure.state == "degraded"
    assert exposure.missing == (("G", "no frame came"),)
    assert Flag(exposure.flags) & Flag.FRAME_MISSING
    sheet = flying.ledger.sheet()
    assert (sheet.degraded, sheet.frames.late) == (1, 1) and sheet.is_balanced


def in_two_that_wait(flying: Flight, status: FrameStatus) -> tuple[FiredPulse, FiredPulse]:
    """Two exposures wait for G, of which a frame arrives without a time stamp."""
    first, second = (fly_one(flying, number, 1.35 * number, HEADS[:2]) for number in (1, 2))
    unknown = {"device_ns": None, "counter": None, "status": status}
    came = replace(frame("G", second, slot=5), **unknown)
    cause = Cause.SPURIOUS if status is FrameStatus.COMPLETE else Cause.CORRUPT
    assert flying.take(came) is cause
    return first, second


def missing_of(flying: Flight) -> dict[int, tuple[str, Flag]]:
    """What is stored when waiting is over: why G is missing, and the flags."""
    due = [one.capture for one in flying.advance(12 * NS).store]
    return {c.number: (dict(c.missing).get("G", ""), Flag(c.flags)) for c in due}


def test_a_corrupt_frame_that_may_belong_to_two_exposures_is_reported_at_both() -> None:
    flying = flight()
    in_two_that_wait(flying, FrameStatus.INCOMPLETE)
    sentence = "may be a corrupt frame that arrived; it may belong to another exposure"
    flags = Flag.FRAME_MISSING | Flag.FRAME_AMBIGUOUS
    assert missing_of(flying) == dict.fromkeys((1, 2), (sentence, flags))


def test_a_complete_frame_that_may_belong_to_two_exposures_is_reported_at_both() -> None:
    flying = flight()
    in_two_that_wait(flying, FrameStatus.COMPLETE)
    sentence = "may be a frame that arrived and could not be attributed"
    flags = Flag.FRAME_MISSING | Flag.FRAME_AMBIGUOUS
    assert missing_of(flying) == dict.fromkeys((1, 2), (sentence, flags))


def test_an_exposure_that_has_its_frame_is_not_accused_of_the_damaged_one() -> None:
    flying = flight()
    _, second = in_two_that_wait(flying, FrameStatus.CORRUPT)
    assert flying.take(frame("G", second)) is Cause.USED
    found = missing_of(flying)
    assert found[2] == ("", Flag(0))
    assert found[1][0].startswith("may be") and found[1][1] & Flag.FRAME_AMBIGUOUS


def test_a_corrupt_frame_that_arrives_when_two_are_stored_is_reported_in_both_records() -> None:
    flying = flight()
    first, second = (fly_one(flying, number, 1.35 * number, HEADS[:2]) for number in (1, 2))
    for due in flying.advance(12 * NS).store:
        flying.stored(due.capture.number, due.capture.frames)
    damaged = replace(frame("G", second), status=FrameStatus.INCOMPLETE)
    flying.take(replace(damaged, device_ns=None, counter=None, mono_ns=12 * NS))
    for given in (first, second):
        flying.take(mark(given))
        flying.take(nav(given.mono_ns / NS + 0.2))
    for _ in (first, second):
        flags = Flag(seal(flying, 13 * NS).flags)
        assert flags & Flag.FRAME_AMBIGUOUS and not flags & Flag.FRAME_CORRUPT


def test_a_head_that_is_known_to_be_lost_is_not_waited_for() -> None:
    flying = flight()
    flying.absent_heads.add("G")
    fly_one(flying, 1, 0.0, HEADS[:2])
    (due,) = flying.advance(NS).store
    assert due.capture.missing == (("G", "no frame came"),)


def test_a_silent_head_does_not_starve_the_others_of_memory() -> None:
    flying = flight()
    for number in (1, 2):
        fly_one(flying, number, 1.35 * number, HEADS[:2])
    assert not flying.advance(4 * NS).store, "two of three slots are taken: there is time"
    fly_one(flying, 3, 4.05, HEADS[:2])
    (due,) = flying.advance(5 * NS).store
    assert due.capture.number == 1


def test_a_lost_mark_is_interpolated_through_the_clock_and_flagged() -> None:
    flying = flight(has_pps=False)
    for number in (1, 2):
        given = fly_one(flying, number, 3.0 * number)
        flying.stored(number, stored_frames(flying, number, round(3.0 * number * NS) + NS))
        flying.take(mark(given))
        flying.take(nav(3.0 * number + 0.2))
    assert seal(flying, 7 * NS).mark_source == seal(flying, 7 * NS).mark_source == "event-mark"
    given = fly_one(flying, 3, 9.0)
    flying.stored(3, stored_frames(flying, 3, 10 * NS))
    flying.take(nav(9.2))
    assert flying.advance(11 * NS).seal is None
    exposure = seal(flying, 13 * NS)
    assert exposure.mark_source == "interpolated"
    assert exposure.mark_gps_ns is not None and exposure.mark_sigma_ns is not None
    true_ns = GPS_NS + given.mono_ns + STROBE_NS
    assert abs(exposure.mark_gps_ns - true_ns) < 3 * exposure.mark_sigma_ns
    assert Flag(exposure.flags) & Flag.MARK_MISSING


def test_with_a_pulse_per_second_a_lost_mark_is_timed_by_it_and_the_budget_names_the_source() -> (
    None
):
    flying = flight()
    given = fly_one(flying, 1, 0.0)
    flying.stored(1, stored_frames(flying, 1, NS))
    flying.take(nav(0.2))
    exposure = seal(flying, 4 * NS)
    assert exposure.mark_source == "pps"
    assert exposure.mark_gps_ns is not None and exposure.mark_sigma_ns is not None
    assert abs(exposure.mark_gps_ns - GPS_NS - given.strobe_delay_ns) < 2 * exposure.mark_sigma_ns
    assert exposure.time_budget_ns.keys() == {"clock", "trigger", "delay", "head"}
    worst_ns = max(frame.time_sigma_ns or 0 for frame in exposure.frames)
    total_ns = sum(part**2 for part in exposure.time_budget_ns.values()) ** 0.5
    assert worst_ns == pytest.approx(total_ns, abs=2)


def test_the_first_mark_is_believed_when_a_second_one_agrees_and_revised_when_two_disagree() -> (
    None
):
    flying = flight(has_pps=False)
    given = [fly_one(flying, number, 2.0 * (number - 1)) for number in (1, 2, 3)]
    noise = replace(mark(given[0]), gps_ns=mark(given[0]).gps_ns + 200_000_000, count=0)
    assert flying.take(noise) is Cause.USED, "nothing else is known yet"
    (due, *_) = flying.advance(NS).store
    flying.stored(1, due.capture.frames)
    assert flying.advance(2 * NS).seal is None, "one mark alone is not believed at once"
    assert flying.take(mark(given[1])) is Cause.PENDING
    flying.take(mark(given[2]))
    flying.take(nav(4.5))
    exposure = seal(flying, 5 * NS)
    assert exposure.mark_source == "interpolated", "what was taken for its mark was noise"
    true_ns = GPS_NS + given[0].strobe_delay_ns
    assert exposure.mark_gps_ns is not None and exposure.mark_sigma_ns is not None
    assert abs(exposure.mark_gps_ns - true_ns) < 4 * exposure.mark_sigma_ns
    flying.land()
    sheet = flying.ledger.sheet()
    assert sheet.is_balanced and sheet.marks.received == 3 and sheet.marks.spurious == 1


def test_a_pulse_that_was_not_given_is_a_lost_exposure_with_a_record() -> None:
    flying = flight()
    flying.order(0)
    flying.not_fired(1, "the unit does not answer")
    exposure = seal(flying, NS)
    assert exposure.state == "lost"
    assert dict(exposure.missing)["SU00"] == "the unit does not answer"
    assert flying.ledger.sheet().lost == 1 and not flying.ledger.imbalances()


def test_an_exposure_of_which_nothing_comes_is_given_up_once() -> None:
    flying = flight()
    fly_one(flying, 1, 0.0, ())
    assert flying.advance(8 * NS).lost == ()
    due = flying.advance(9 * NS)
    assert due.lost == ((1, "no head sent a frame"),)
    assert due.seal is not None and due.seal.state == "lost"
    assert flying.advance(9 * NS).lost == ()


def test_a_disk_that_refuses_the_frames_loses_the_exposure() -> None:
    flying = flight()
    fly_one(flying, 1, 0.0)
    stored_frames(flying, 1, NS)
    flying.not_stored(1, "No space left on device")
    assert seal(flying, NS).state == "lost"
    assert not flying.ledger.imbalances()


def test_records_are_sealed_in_order_even_if_a_later_one_is_ready_first() -> None:
    flying = flight()
    first = fly_one(flying, 1, 0.0, HEADS[:1])
    second = fly_one(flying, 2, 3.0)
    flying.stored(2, stored_frames(flying, 2, 4 * NS))
    flying.take(mark(second))
    flying.take(nav(3.2))
    assert flying.advance(4 * NS).seal is None
    flying.stored(1, stored_frames(flying, 1, 9 * NS))
    flying.take(mark(first))
    assert seal(flying, 9 * NS).number == 1
    assert seal(flying, 9 * NS).number == 2


@pytest.mark.parametrize("has_mark", [True, False])
def test_recovery_makes_the_same_record_from_the_log_as_the_flight_did(*, has_mark: bool) -> None:
    flying = flight()
    given = fly_one(flying, 1, 0.0)
    (due,) = flying.advance(NS).store
    frames = tuple(replace(r, file=f"{r.sensor}.tif", sha256="0" * 64) for r in due.capture.frames)
    flying.stored(1, frames)
    logged = [*EARLIER, *(TemperatureSample(p, 32.0, -NS // 2) for p in RIG.probes)]
    reported = TriggerPulse(1, given.mono_ns, given.sigma_ns, given.count)
    records = [*logged, LoggedTrigger(1, reported, DELAYS_NS, STROBE_NS)]
    if has_mark:
        flying.take(mark(given))
        records.append(mark(given))
    flying.take(nav(0.2))
    records.append(nav(0.2))
    read_back = [record_of(message_of(record)) for record in records]
    recovered = seal_from_log(RIG)(
        replace(due.capture, frames=frames), [r for r in read_back if r is not None]
    )
    assert recovered == seal(flying, 9 * NS)


def test_a_head_whose_clock_restarts_is_reported_once() -> None:
    flying = flight()
    given = [fly_one(flying, number, 2.0 * number) for number in range(1, 8)]
    flying.advance(14 * NS)
    again = replace(
        frame("G", given[-1]),
        device_ns=5,
        device_clock_ns=1,
        device_clock_mono_ns=given[-1].mono_ns,
    )
    for earlier in range(1, 8):
        mono_ns = 2 * NS * earlier
        flying.take(ClockReading("G", 900 * NS + mono_ns, mono_ns, 40_000))
    flying.take(again)
    (reported,) = flying.advance(15 * NS).clock_events
    assert (
        reported.name == "device-clock-stepped" and "G" in reported.sentence and reported.is_fault
    )
    assert flying.advance(16 * NS).clock_events == ()


def test_holdover_is_reported_with_cause_and_action_and_flagged_and_ends() -> None:
    flying = flight()
    given = fly_one(flying, 1, 20.0)
    due = flying.advance(21 * NS)
    (reported,) = due.clock_events
    assert reported.name == "pps-holdover" and reported.is_fault
    assert "check the PPS cable" in reported.sentence
    flying.stored(1, due.store[0].capture.frames)
    exposure = seal(flying, 24 * NS)
    assert exposure.mark_source == "pps" and Flag(exposure.flags) & Flag.TIME_HOLDOVER
    assert exposure.mark_gps_ns is not None and exposure.mark_sigma_ns is not None
    true_ns = GPS_NS + given.mono_ns + STROBE_NS
    assert abs(exposure.mark_gps_ns - true_ns) < 2 * exposure.mark_sigma_ns
    assert exposure.mark_sigma_ns > 10_000, "twenty seconds after the second of two edges"
    flying.take(PpsEdge("gnss", 30, 25 * NS, 1_000))
    (back,) = flying.advance(25 * NS).clock_events
    assert back.name == "pps-holdover" and not back.is_fault


def test_the_provisional_record_of_an_exposure_awaiting_a_second_mark_is_the_sealed_one() -> None:
    flying = flight(has_pps=False)
    first, second = fly_one(flying, 1, 0.0), fly_one(flying, 2, 2.0)
    flying.stored(1, flying.advance(NS).store[0].capture.frames)
    assert flying.advance(NS).provisional is None, "it has no mark yet"
    flying.take(mark(first))
    assert flying.advance(NS).provisional is None, "the position beyond the mark is awaited"
    flying.take(nav(0.2))
    provisional = flying.advance(NS).provisional
    assert provisional is not None and provisional.mark_source == "event-mark"
    assert flying.advance(NS).provisional is None, "it is returned once"
    assert flying.advance(NS).seal is None, "and not sealed yet"
    flying.take(TemperatureSample("cone", 44.0, NS))
    flying.take(mark(second))
    assert seal(flying, 3 * NS) is provisional, "what is learned later does not make it another"


def test_a_provisional_record_with_a_mark_that_was_noise_is_sealed_without_it() -> None:
    flying = flight(has_pps=False)
    given = [fly_one(flying, number, 2.0 * (number - 1)) for number in (1, 2, 3)]
    flying.stored(1, flying.advance(NS).store[0].capture.frames)
    flying.take(replace(mark(given[0]), gps_ns=mark(given[0]).gps_ns + 200_000_000, count=0))
    flying.take(nav(1.0))
    provisional = flying.advance(NS).provisional
    assert provisional is not None
    flying.take(mark(given[1]))
    flying.take(mark(given[2]))
    flying.take(nav(4.5))
    exposure = seal(flying, 5 * NS)
    assert exposure != provisional and exposure.mark_source == "interpolated"
