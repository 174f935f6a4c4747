"""Faults of emulated devices end in the quality report of the exposure they hit, and in no other.

On a fake clock (`benchmarks.fast_flight`): what the emulated devices say, through drivers, matching
and record to the report. The same over real wires: tests/system/test_faults_on_the_wire.py.
"""

from __future__ import annotations

from pathlib import Path

from benchmarks.fast_flight import FastFlight
from benchmarks.pairing import SMALL_RIG, shortcomings
from daemon.configuration.model import LimitsSection
from daemon.products.exposure_products import report_unprocessed
from processing.quality.report import Flag
from sim_hw.faults.plan import PlannedFault

EXPOSURES = 30
STORED_WITHIN_S, LATE_S = 2.0, 2.5
"""A frame that comes after its exposure was stored and before its record is sealed, which waits
3 s for a lost mark."""
NO_IMAGE = Flag.SIMULATED | Flag.NOT_PROCESSED


def hit(fault: str, device: str, pulse: int, amount: float = 0.0) -> PlannedFault:
    name, _, topic = device.partition("/")
    return PlannedFault(fault, name, None, pulse, None, amount, topic)


def lasting(
    fault: str, device: str, at_s: float, for_s: float, amount: float = 0.0
) -> PlannedFault:
    name, _, topic = device.partition("/")
    return PlannedFault(fault, name, at_s, None, for_s, amount, topic)


FAULTS = (
    hit("duplicate", "SU00", 4),
    hit("corrupt", "SU10", 6),
    hit("lost", "receiver/mark", 8),
    hit("late", "SU10", 8, LATE_S),
    hit("lost", "N", 10),
    # Positions are held up, so that the clock is doubted, while marks are counted again: pulse 12.
    lasting("late", "receiver/navigation", 26.0, 8.0, 2.0),
    lasting("counter-reset", "receiver", 27.0, 1.0),
    # Without its marks the clock coasts, from pulse 18 on; it is reported after ten seconds.
    lasting("lost", "receiver/mark", 44.0, 16.0),
)
FLAGGED = {
    4: Flag.FRAME_DUPLICATE,
    6: Flag.FRAME_CORRUPT | Flag.FRAME_MISSING,
    8: Flag.FRAME_LATE | Flag.FRAME_MISSING | Flag.MARK_MISSING,
    10: Flag.FRAME_MISSING,
    12: Flag.MARK_AMBIGUOUS | Flag.MARK_MISSING | Flag.GNSS,
    **dict.fromkeys((18, 19, 20, 21, 24), Flag.MARK_MISSING),
    **dict.fromkeys((22, 23), Flag.MARK_MISSING | Flag.TIME_HOLDOVER),
}


def test_a_damaged_frame_that_may_be_of_two_exposures_accuses_neither_alone(
    tmp_path: Path,
) -> None:
    faults = (hit("lost", "SU10", 5), hit("corrupt", "SU10", 6))
    flight = FastFlight(SMALL_RIG, faults, exposures=10, seed=1, mission=tmp_path)
    assert not shortcomings(flight.fly())
    flagged = {r.number: Flag(r.flags) & ~Flag.SIMULATED for r in flight.records if r.missing}
    both = Flag.FRAME_MISSING | Flag.FRAME_AMBIGUOUS
    assert flagged == {5: both, 6: both}


def test_each_exposure_is_flagged_with_what_hit_it_and_with_nothing_else(tmp_path: Path) -> None:
    flight = FastFlight(SMALL_RIG, FAULTS, exposures=EXPOSURES, seed=1, mission=tmp_path)
    flight.flight.limits = LimitsSection(frame_timeout_s=STORED_WITHIN_S)
    score = flight.fly()
    assert not shortcomings(score), score.examples
    reports = {
        record.number: report_unprocessed(flight.rig, record, Flag(0)) for record in flight.records
    }
    flags = {number: Flag(report["flag_bits"]) & ~NO_IMAGE for number, report in reports.items()}
    assert {number: found for number, found in flags.items() if found} == FLAGGED
    for report in reports.values():
        assert {finding["flag"] for finding in report["findings"]} == set(report["flags"])
        assert all(finding["sentence"].endswith(".") for finding in report["findings"])
