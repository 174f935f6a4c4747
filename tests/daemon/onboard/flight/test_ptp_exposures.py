"""Exposures whose marks are lost, timed by heads that PTP synchronises."""

from __future__ import annotations

from dataclasses import replace

import pytest

from daemon.mission.exposure import Exposure
from daemon.onboard.timing.matching import Cause, FiredPulse
from drivers.contract import (
    Frame,
    PtpReading,
)
from processing.quality.report import Flag
from tests.daemon.onboard.flight.test_flight import (
    GPS_NS,
    HEADS,
    NS,
    STROBE_NS,
    flight,
    frame,
    mark,
    nav,
    pulse,
    seal,
)

TAI_OF_MONO_NS = GPS_NS + 315_964_819 * NS


MASTER = "001122fffe334455"


def ptp_frame(given: FiredPulse, *, error_ns: int = 0) -> Frame:
    """A frame of the head G whose clock shows TAI, latched with it."""
    plain, shift_ns = frame("G", given), TAI_OF_MONO_NS + error_ns
    assert plain.device_ns is not None
    return replace(
        plain,
        device_ns=plain.device_ns + shift_ns,
        device_clock_ns=plain.mono_ns + shift_ns,
        device_clock_mono_ns=plain.mono_ns,
    )


def fly_with_ptp(
    error_ns: int, *, last_status: str = "Slave", last_master: str = MASTER
) -> tuple[Exposure, list[str]]:
    """Four exposures with marks and one without; it is returned, with the faults."""
    flying, faults = flight(has_pps=False), list[str]()
    for number in range(1, 6):
        t_s = 2.0 * (number - 1)
        now_ns = round((t_s + 1) * NS)
        status, master = (last_status, last_master) if number == 5 else ("Slave", MASTER)
        flying.take(PtpReading("G", round(t_s * NS), status, 400, master))
        flying.order(round(t_s * NS))
        given = pulse(number, t_s)
        flying.fired(given)
        assert flying.take(ptp_frame(given, error_ns=error_ns)) is Cause.USED
        if number < 5:
            flying.take(mark(given))
        for behind_s in (0.2, 0.4):
            flying.take(nav(t_s + behind_s))
        flying.absent_heads = set(HEADS) - {"G"}
        actions = flying.advance(now_ns)
        faults += [event.name for event in actions.clock_events if event.is_fault]
        stored = tuple(
            replace(r, file="G.tif", sha256="0" * 64) for r in actions.store[0].capture.frames
        )
        flying.stored(number, stored)
    for _ in range(5):
        exposure = seal(flying, now_ns + 60 * NS)
    return exposure, faults


def test_a_lost_mark_is_timed_by_a_head_that_ptp_synchronises() -> None:
    exposure, faults = fly_with_ptp(error_ns=300)
    assert faults == []
    assert exposure.mark_source == "ptp"
    assert exposure.mark_gps_ns is not None and exposure.mark_sigma_ns is not None
    truth_ns = GPS_NS + 8 * NS + STROBE_NS
    assert abs(exposure.mark_gps_ns - truth_ns) <= 3 * exposure.mark_sigma_ns
    assert exposure.mark_sigma_ns < 10_000
    assert Flag(exposure.flags) & Flag.MARK_MISSING
    green = exposure.frame("G")
    assert green is not None and green.time_source == "ptp"
    assert "ptp" in exposure.time_budget_ns


@pytest.mark.parametrize(
    ("error_ns", "last", "is_flagged"),
    [
        (300, {}, False),
        (-37 * NS, {}, True),
        (300, {"last_status": "Listening"}, True),
        (300, {"last_master": "ffffffffffffffff"}, True),
    ],
    ids=["synchronised", "utc", "no-master", "other-master"],
)
def test_a_fault_of_ptp_is_a_flag_of_the_exposure(
    error_ns: int, last: dict[str, str], is_flagged: bool
) -> None:
    exposure, faults = fly_with_ptp(error_ns, **last)
    assert bool(Flag(exposure.flags) & Flag.PTP_FAULT) == is_flagged
    assert bool(faults) == is_flagged
    assert (exposure.mark_source == "ptp") != is_flagged


@pytest.mark.parametrize(("seconds", "name"), [(-37, "ptp-utc"), (-19, "ptp-gps")])
def test_a_master_that_serves_utc_or_gps_as_tai_does_not_time_an_exposure(
    seconds: int, name: str
) -> None:
    exposure, faults = fly_with_ptp(error_ns=seconds * NS)
    assert name in faults
    assert exposure.mark_source == "interpolated"
    assert exposure.mark_gps_ns is not None
    assert abs(exposure.mark_gps_ns - GPS_NS - 8 * NS - STROBE_NS) < 1_000_000
