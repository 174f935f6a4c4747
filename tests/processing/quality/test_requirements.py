"""What a project asks for is behind the verdict; what it does not ask for is not."""

from __future__ import annotations

import pytest

from processing.quality.figures import Figure
from processing.quality.report import Flag, Verdict
from processing.quality.requirements import QualityRequirements
from tests.processing.quality.test_report import GOOD, evaluated

REQUIREMENTS = QualityRequirements(
    forward_overlap=0.5,
    sidelap=0.2,
    gsd_m=0.1,
    tilt_deg=3.0,
    crab_deg=4.0,
    sun_deg=30.0,
    time_sigma_ns=10_000.0,
)
CONFORMING: dict[str, Figure] = {
    "forward_overlap": 0.5,
    "sidelap": 0.21,
    "gsd_m": 0.1,
    "tilt_deg": 2.9,
    "crab_deg": 4.0,
    "sun_deg": 30.0,
    "time_sigma_ns": 9_000.0,
}


def test_an_exposure_that_keeps_everything_is_good() -> None:
    assert evaluated(GOOD | CONFORMING, requirements=REQUIREMENTS).verdict is Verdict.GOOD


@pytest.mark.parametrize(
    ("name", "value", "flag", "phrase"),
    [
        ("forward_overlap", 0.42, Flag.OVERLAP, "Only 42% forward overlap, 50% asked for"),
        ("sidelap", 0.0, Flag.OVERLAP, "Only 0% sidelap"),
        ("gsd_m", 0.12, Flag.GSD, "0.120 m, 0.100 m asked for"),
        ("tilt_deg", 6.0, Flag.TILT, "6.0 deg, 3.0 deg allowed"),
        ("crab_deg", 4.1, Flag.DRIFT, "drift angle"),
        ("sun_deg", 12.0, Flag.SUN, "12.0 deg high"),
        ("time_sigma_ns", 20_000.0, Flag.TIME_SIGMA, "20000 ns"),
    ],
)
def test_what_breaks_it_is_flown_again_and_states_by_how_much(
    name: str, value: float, flag: Flag, phrase: str
) -> None:
    figures = GOOD | CONFORMING | {name: value}
    report = evaluated(figures, requirements=REQUIREMENTS)
    assert report.verdict is Verdict.REFLY
    assert report.flags == flag
    (finding,) = report.findings
    assert phrase in finding.sentence
    assert "again" in finding.sentence
    assert finding.value == value
    assert evaluated(figures).verdict is not Verdict.REFLY


def test_what_is_not_known_is_not_evaluated() -> None:
    unknown = dict.fromkeys(CONFORMING)
    assert evaluated({**GOOD, **unknown}, requirements=REQUIREMENTS).verdict is Verdict.GOOD
