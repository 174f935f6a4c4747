"""A sample of the random search for wrong inputs that pass as good (benchmarks.silent_errors)."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.silent_errors.cases import Case, draw, run
from benchmarks.silent_errors.clean import clean_row, clean_rows
from benchmarks.silent_errors.faults import FAULTS
from benchmarks.silent_errors.limits import DMC, LIMITS, L, X, table

DOCUMENT = Path(__file__).parents[2] / "docs/explanation/validity.md"
SAMPLE = {
    X: ("slip", "principal-distance", "sensor-displaced", "probes-all", "gain-step"),
    L: ("cone-turned", "half-frame", "words"),
}


def _sample(rig: str) -> list[Case]:
    """The first drawn case of each kind, all on one exposure, which is rendered once."""
    drawn = draw(1000, 3, rigs=[rig])
    first = {case.kind: case for case in reversed(drawn)}
    return [replace(first[kind], exposure=0) for kind in SAMPLE[rig]]


@pytest.mark.trust
@pytest.mark.timeout(300)
@pytest.mark.parametrize("rig", SAMPLE)
def test_a_sample_of_wrong_inputs_does_not_pass_as_good(rig: str) -> None:
    outcomes = [run(case) for case in _sample(rig)]
    wrong = [o for o in outcomes if o.result in ("silent", "misled")]
    assert not wrong, wrong


@pytest.mark.trust
def test_a_tenth_of_a_colour_pixel_under_a_cloud_is_no_slip() -> None:
    for number in (792, 798):
        row = clean_row(number, seed=4)
        assert (row["rig"], row["scene"]) == (DMC, "cloud")
        assert not row["alarm"], row


def test_the_published_detection_limits_are_those_of_the_search() -> None:
    assert table() in DOCUMENT.read_text(encoding="utf-8")
    assert FAULTS.keys() == LIMITS.keys()


def test_sizes_are_drawn_by_seed_from_half_to_four_times_the_limit() -> None:
    cases = draw(500, 1)
    shares = np.array([case.share for case in cases])
    assert cases == draw(500, 1) and cases != draw(500, 2)
    assert 0.5 <= shares.min() < 0.6 and 3.5 < shares.max() <= 4.0
    assert {(c.kind, c.rig) for c in cases} == {
        (kind, rig) for kind, limit in LIMITS.items() for rig in limit.by_rig
    }
    assert all(case.size == case.share * LIMITS[case.kind].by_rig[case.rig] for case in cases)


@pytest.mark.soak
def test_no_wrong_input_passes_as_good() -> None:
    count = int(os.environ.get("SYNTOPIC_SILENT_COUNT", "150"))
    wrong = [o for c in draw(count, 1) if (o := run(c)).result in ("silent", "misled")]
    assert not wrong, wrong


@pytest.mark.soak
def test_clean_exposures_raise_no_false_alarm() -> None:
    count = int(os.environ.get("SYNTOPIC_CLEAN_COUNT", "1000"))
    alarms = [row for row in clean_rows(count, 1, None) if row["alarm"]]
    assert not alarms, alarms
