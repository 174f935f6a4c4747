"""PTP clocks of heads: used while they agree with the receiver, refused by name when they do
not."""

from __future__ import annotations

import random

import pytest

from daemon.onboard.timing.gps_clock import GpsEstimate
from daemon.onboard.timing.ptp_time import (
    OFFSET_LIMIT_NS,
    PtpInstant,
    PtpTime,
    combined,
    gps_ns_of_tai,
)
from drivers.contract import PtpReading

NS = 1_000_000_000
GPS_NS = 1_400_000_000 * NS
TAI_NS = GPS_NS + 315_964_819 * NS
MASTER, OTHER = "001122fffe334455", "66778899aabbccdd"


def reading(
    second: float, *, status: str = "Slave", offset_ns: int | None = 800, master: str = MASTER
) -> PtpReading:
    return PtpReading("SU00", round(second * NS), status, offset_ns, master)


def latched(
    ptp: PtpTime, second: float, *, error_ns: int = 0, is_coarse: bool = False, sigma_ns: int = 300
) -> None:
    mono_ns = round(second * NS)
    estimate = GpsEstimate(GPS_NS + mono_ns, sigma_ns, is_coarse)
    ptp.compare_latch("SU00", TAI_NS + mono_ns + error_ns, estimate, 40_000, mono_ns=mono_ns)


def synchronised(seconds: int = 6, *, error_ns: int = 0, is_coarse: bool = False) -> PtpTime:
    ptp = PtpTime()
    for second in range(seconds):
        ptp.read(reading(second))
        latched(ptp, second, error_ns=error_ns, is_coarse=is_coarse)
    return ptp


def instant(ptp: PtpTime, second: float) -> PtpInstant | None:
    mono_ns = round(second * NS)
    return ptp.at("SU00", TAI_NS + mono_ns, mono_ns)


def faults(ptp: PtpTime, second: float) -> list[str]:
    return [event.name for event in ptp.events(round(second * NS)) if event.is_fault]


def test_tai_is_19_seconds_ahead_of_gps_and_37_of_utc() -> None:
    # 2020-01-01T00:00:00 UTC: POSIX 1577836800, GPS 1261872018, TAI 1577836837.
    assert gps_ns_of_tai(1_577_836_837 * NS) == 1_261_872_018 * NS


def test_a_synchronised_head_gives_gps_time_with_a_sigma() -> None:
    found = instant(synchronised(), 6)
    assert found is not None
    assert found.gps_ns == GPS_NS + 6 * NS
    assert 1_000 <= found.sigma_ns < 40_000


def test_the_sigma_covers_the_scatter_of_offsets_and_a_common_error() -> None:
    rng = random.Random(5)
    within = 0
    for _ in range(300):
        common_ns = rng.gauss(0, 20_000)
        ptp = PtpTime()
        for second in range(30):
            offset_ns = round(rng.gauss(0, 5_000))
            ptp.read(reading(second, offset_ns=offset_ns))
            seen_ns = round(common_ns + offset_ns + rng.gauss(0, 10_000))
            latched(ptp, second, error_ns=seen_ns, sigma_ns=10_000)
        mono_ns = 30 * NS
        shown_ns = TAI_NS + mono_ns + round(common_ns + rng.gauss(0, 5_000))
        found = ptp.at("SU00", shown_ns, mono_ns)
        assert found is not None
        within += abs(found.gps_ns - GPS_NS - mono_ns) <= 2 * found.sigma_ns
    assert within >= 285, "two sigmas cover 95 of a hundred"


@pytest.mark.parametrize(
    ("error_ns", "name"),
    [
        (-37 * NS, "ptp-utc"),
        (-19 * NS, "ptp-gps"),
        (-1 * NS, "ptp-disagrees"),
        (1 * NS, "ptp-disagrees"),
        (3_000_000, "ptp-disagrees"),
        (-(1_700_000_000 * NS), "ptp-arbitrary-epoch"),
        (37 * NS, "ptp-disagrees"),
    ],
)
def test_a_master_that_serves_another_timescale_is_refused_by_name(
    error_ns: int, name: str
) -> None:
    ptp = synchronised(error_ns=error_ns)
    assert instant(ptp, 6) is None
    events = ptp.events(6 * NS)
    assert [event.name for event in events if event.is_fault] == [name]
    assert ptp.counts[name] == 1
    assert "Check" in events[-1].sentence or "Set" in events[-1].sentence


@pytest.mark.parametrize("seconds", [-37, -19, -1, 1])
def test_navigation_messages_alone_show_a_wrong_second(seconds: int) -> None:
    assert faults(synchronised(error_ns=seconds * NS, is_coarse=True), 6) != []


def test_navigation_messages_alone_do_not_prove_a_clock() -> None:
    ptp = synchronised(is_coarse=True)
    assert instant(ptp, 6) is None
    assert faults(ptp, 6) == []


def test_without_a_receiver_nothing_is_used() -> None:
    ptp = PtpTime()
    for second in range(10):
        ptp.read(reading(second))
    assert instant(ptp, 10) is None


@pytest.mark.parametrize("status", ["Master", "Listening", "Uncalibrated", "Faulty", "unreadable"])
def test_a_head_that_is_not_slave_is_not_used_until_it_has_proved_itself_again(status: str) -> None:
    ptp = synchronised()
    ptp.events(6 * NS)
    ptp.read(reading(6, status=status))
    assert instant(ptp, 6) is None
    (event,) = ptp.events(6 * NS)
    assert (event.name, event.is_fault) == ("ptp-not-slave", True)
    assert f"its status is {status}" in event.sentence
    ptp.read(reading(7))
    latched(ptp, 7)
    assert instant(ptp, 7) is None, "one reading proves nothing"
    assert [e.is_fault for e in ptp.events(7 * NS)] == [False]
    for second in (8, 9):
        ptp.read(reading(second))
        latched(ptp, second)
    assert instant(ptp, 9) is not None


def test_another_grandmaster_has_to_agree_with_the_receiver_first() -> None:
    ptp = synchronised()
    ptp.events(6 * NS)
    ptp.read(reading(6, master=OTHER))
    assert instant(ptp, 6) is None
    (event,) = ptp.events(6 * NS)
    assert event.name == "ptp-grandmaster-changed"
    assert OTHER in event.sentence
    assert MASTER in event.sentence
    assert ptp.is_suspect(["SU00"], 6 * NS) and not ptp.is_suspect(["other"], 6 * NS)
    for second in (7, 8, 9):
        ptp.read(reading(second, master=OTHER))
        latched(ptp, second, error_ns=-37 * NS)
    assert instant(ptp, 9) is None
    assert faults(ptp, 9) == ["ptp-utc"]
    for second in (10, 11):
        ptp.read(reading(second, master=OTHER))
        latched(ptp, second)
        assert ptp.is_suspect(["SU00"], second * NS)
    ptp.read(reading(12, master=OTHER))
    latched(ptp, 12)
    assert not ptp.is_suspect(["SU00"], 12 * NS)
    assert ptp.counts["ptp-grandmaster-changed"] == 1


def test_the_sentence_states_by_how_much_the_clock_is_off() -> None:
    for error_ns, expected in ((-37 * NS, "(-37.0 s from the receiver)"), (NS, "it is +1.0000 s")):
        ptp = synchronised(error_ns=error_ns)
        assert expected in ptp.events(6 * NS)[-1].sentence
    assert synchronised().events(6 * NS) == []


def test_what_was_stamped_before_the_master_changed_proves_nothing_of_the_new_one() -> None:
    ptp = synchronised()
    for second in (6, 7, 8):
        ptp.read(reading(second, master=OTHER))
    for earlier in (5.1, 5.3, 5.5, 5.999):
        latched(ptp, earlier)
    assert instant(ptp, 8) is None
    assert ptp.is_suspect(["SU00"], 8 * NS)
    for later in (6.0, 7.0, 8.0):
        latched(ptp, later)
    assert instant(ptp, 8) is not None
    assert not ptp.is_suspect(["SU00"], 8 * NS)


@pytest.mark.parametrize("offset_ns", [OFFSET_LIMIT_NS + 1, -OFFSET_LIMIT_NS - 1, None])
def test_a_large_or_missing_offset_is_refused(offset_ns: int | None) -> None:
    ptp = synchronised()
    ptp.events(6 * NS)
    ptp.read(reading(6, offset_ns=offset_ns))
    assert instant(ptp, 6) is None
    assert faults(ptp, 6) == ["ptp-offset"]


def test_a_head_that_reports_nothing_more_is_not_trusted() -> None:
    ptp = synchronised()
    assert instant(ptp, 14) is not None
    assert instant(ptp, 16) is None
    assert faults(ptp, 16) == ["ptp-silent"]


def test_a_clock_that_disagreed_once_has_to_agree_three_times_again() -> None:
    ptp = synchronised()
    latched(ptp, 6, error_ns=-37 * NS)
    latched(ptp, 7)
    ptp.read(reading(7))
    assert instant(ptp, 7) is None
    for second in (8, 9):
        ptp.read(reading(second))
        latched(ptp, second)
    assert instant(ptp, 9) is not None


def test_a_repeated_latch_is_one_witness() -> None:
    ptp = PtpTime()
    for second in range(6):
        ptp.read(reading(second))
        latched(ptp, 0.0)
    assert instant(ptp, 6) is None


def test_heads_that_contradict_each_other_give_no_time() -> None:
    one, two = PtpInstant(GPS_NS, 1_000), PtpInstant(GPS_NS + 2_000, 3_000)
    assert combined([one, two]) == PtpInstant(GPS_NS + 2_000, 3_000)
    assert combined([one, PtpInstant(GPS_NS + 100_000, 1_000)]) is None
    assert combined([]) is None


def test_a_head_that_was_never_asked_has_no_time() -> None:
    assert PtpTime().at("SU00", TAI_NS, 0) is None
