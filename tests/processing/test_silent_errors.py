"""A sample of the random search for wrong inputs that pass as good (benchmarks.silent_errors)."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.silent_errors.__main__ import failures, wide_sigmas
from benchmarks.silent_errors.cases import Case, _result, draw, run
from benchmarks.silent_errors.clean import clean_row, clean_rows
from benchmarks.silent_errors.exposures import retoned
from benchmarks.silent_errors.faults import FAULTS
from benchmarks.silent_errors.limits import DMC, LIMITS, MIDAS, L, X, table
from benchmarks.silent_errors.truth import Found, _least_share, freedom_of, head_limit
from processing.quality.figures import QualityFigures
from processing.quality.report import NO_FLAGS, QualityReport, Verdict

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
@pytest.mark.timeout(300)
@pytest.mark.parametrize("rig", [X, L, DMC])
def test_a_rig_file_of_another_unit_is_found_and_stated_no_better_than_it_is(
    rig: str,
) -> None:
    case = next(c for c in draw(1000, 3, rigs=[rig], kinds=["wrong-unit"]) if c.share > 1.0)
    outcome = run(replace(case, exposure=0))
    assert outcome.description.startswith("rig file of another unit")
    # Frames that are found are placed: with the right rig file the raw frames are good.
    assert outcome.result == "found" and outcome.verdict != "good"
    assert outcome.error_px is not None and outcome.stated_px is not None
    assert outcome.stated_px > 0.5 * outcome.error_px > 0.1


@pytest.mark.trust
@pytest.mark.timeout(300)
def test_a_frame_that_green_alone_matches_is_sought_next_to_its_neighbours() -> None:
    """SU11 lay 8 px off, beyond the search in PAN; it rested on calibration, 1 px off."""
    cases = draw(150, 102, rigs=[X], kinds=["wrong-unit"])
    outcome = run(next(case for case in cases if case.number == 11))
    assert outcome.verdict != "good" and outcome.squares is not None
    assert outcome.squares < 3.0 * outcome.rank
    assert outcome.error_px is not None and outcome.stated_px is not None
    assert 0.3 * outcome.error_px < outcome.stated_px < 3.0 * outcome.error_px


@pytest.mark.trust
def test_a_tenth_of_a_colour_pixel_under_a_cloud_is_no_slip() -> None:
    for number in (792, 798):
        row = clean_row(number, seed=4)
        assert (row["rig"], row["scene"]) == (DMC, "cloud")
        assert not row["alarm"], row


@pytest.mark.trust
@pytest.mark.soak
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("number", "rig"),
    [
        pytest.param(186, L, id="rows of plants that colour heads show and PAN does not"),
        pytest.param(358, X, id="a few tie points at the edge of a cloud"),
        pytest.param(396, DMC, id="points of green that scatter under a cloud"),
        pytest.param(970, MIDAS, id="dark fields without noise"),
    ],
)
def test_a_healthy_exposure_that_once_raised_a_false_alarm_raises_none(
    number: int, rig: str
) -> None:
    row = clean_row(number, seed=33)
    assert row["rig"] == rig and not row["alarm"], row


@pytest.mark.trust
@pytest.mark.soak
@pytest.mark.timeout(300)
def test_drawn_signals_of_one_light_differ_and_raise_no_false_alarm() -> None:
    rows = [clean_row(number, seed=51, toned=True) for number in (150, 151, 152)]
    assert [(row["rig"], row["alarm"]) for row in rows] == [(L, "")] * 3
    first, again, other = (
        retoned(L, rows[0]["light"], seed).frames["N"] for seed in (51_000_150, 51_000_150, 5)
    )
    np.testing.assert_array_equal(first, again)
    assert abs(np.median(first) / np.median(other) - 1.0) > 0.01


@pytest.mark.trust
def test_tie_points_that_a_step_of_signal_draws_are_no_slip_of_the_neighbour() -> None:
    case = Case(117, "gain-step-colour", L, exposure=0, share=3.5121511000251453, seed=2100117)
    outcome = run(case)
    assert outcome.description.startswith("RGB: signal -28.1 % from column 271")
    assert outcome.result == "found" and outcome.named == {"step": "RGB"}


@pytest.mark.trust
def test_tie_points_that_an_edge_of_a_block_draws_are_no_slip_of_the_neighbour() -> None:
    """They lie at the end of the block, not at the edge that is named."""
    case = Case(52, "block-offset-colour", X, exposure=0, share=3.505049949549646, seed=10100052)
    outcome = run(case)
    assert outcome.description.startswith("G: 561 DN brighter in rows 211 to 418")
    assert outcome.result == "found" and outcome.named == {"block": "G"}


@pytest.mark.trust
def test_of_a_block_that_is_sent_twice_no_other_head_is_called_wrong() -> None:
    """Tie points of green in the block match nothing: P3 or P4 was called another exposure."""
    outcome = run(Case(0, "block-repeated", DMC, exposure=0, share=4.0, seed=5000))
    assert outcome.description == "G: 16 rows from 380 are those from 336"
    assert outcome.result == "found" and outcome.named["repeated"] == "G"
    assert all(names == "G" for names in outcome.named.values()), outcome.named


@pytest.mark.trust
def test_of_exchanged_bands_nothing_else_is_called_wrong() -> None:
    case = Case(7, "bands-swapped", X, exposure=0, share=1.0, seed=10200007)
    outcome = run(case)
    assert outcome.description == "frames of B and R swapped"
    assert outcome.result == "found" and outcome.named == {"exchanged": "B, R"}


@pytest.mark.trust
@pytest.mark.parametrize("kind", ["heads-swapped", "frame-copied"])
def test_frames_of_heads_that_share_no_ground_are_known_by_their_fixed_pattern(kind: str) -> None:
    outcome = run(Case(0, kind, MIDAS, exposure=0, share=1.0, seed=7))
    assert outcome.result == "found" and outcome.verdict == "refly"
    assert set(outcome.named["exchanged"].split(", ")) <= {"nadir", "5", "7", "8", "19"}


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


RIGHT = Found(
    error_px=0.05,
    stated_px=0.05,
    worst=1.0,
    worst_of="SU00",
    worst_limit=3.0,
    normalised=None,
    freedom=None,
    band_px=0.1,
    radiance=0.01,
    radiance_of="SU00",
    detail=0.9,
    blank=0.0,
    blank_of="",
)


@pytest.mark.parametrize(
    ("wrong", "result"),
    [
        (RIGHT, "right"),
        (replace(RIGHT, worst=3.1), "silent"),
        (replace(RIGHT, detail=0.0), "silent"),
        (replace(RIGHT, blank=0.03), "silent"),
        (replace(RIGHT, radiance=0.09), "silent"),
    ],
)
def test_an_image_is_judged_head_by_head(wrong: Found, result: str) -> None:
    case = Case(number=0, kind="slip", rig=X, exposure=0, share=2.0, seed=1)
    good = QualityReport(Verdict.GOOD, NO_FLAGS, (), QualityFigures(()))
    assert _result(case, good, wrong, 1.0, {}, frozenset()) == result


def test_the_limit_of_a_head_is_that_of_its_degrees_of_freedom() -> None:
    assert head_limit(np.eye(4), 1) == pytest.approx(2.149, abs=1e-3)
    # Errors that move a head as a whole have two, whatever the number of check points.
    moved = np.tile(np.eye(2), (25, 25))
    assert head_limit(moved, 1) == pytest.approx(head_limit(np.eye(2), 1))
    assert head_limit(moved, 1) == pytest.approx(np.sqrt(-np.log(1e-3)))
    assert head_limit(moved, 9) == pytest.approx(np.sqrt(-np.log(1e-3 / 9)))


def test_a_blank_head_has_no_detail() -> None:
    detail = np.full((2, 2, 2), 5.0)
    assert _least_share({"SU00": detail, "R": 0.0 * detail}, {"SU00": detail, "R": detail}) == 0.0
    assert _least_share({"SU00": 0.5 * detail, "R": detail}, {"SU00": detail}) == 0.5
    assert _least_share({"nadir": detail}, {}) == 1.0


def _row(flags: str, squares: float, *, stated_px: float = 0.1, **other: object) -> dict[str, Any]:
    row = {"result": "found", "flags": flags, "rank": 1000, "squares": squares, "error_px": 0.1}
    return {**row, "stated_px": stated_px, **other}


@pytest.mark.parametrize(
    ("rows", "failed"),
    [
        ([_row("", 1000.0), _row("BLUR", 1000.0)], ""),
        ([_row("", 1200.0)], "unflagged images: mean square of normalised errors 1.200"),
        ([_row("", 800.0)], "unflagged images: mean square of normalised errors 0.800"),
        ([_row("BLUR", 1200.0)], "flagged images: mean square of normalised errors 1.200"),
        ([_row("BLUR", 500.0)], ""),
        ([_row("BLUR", 1000.0, stated_px=0.31)], "flagged images state 0.310 px"),
        ([_row("BLUR", 1000.0, stated_px=math.inf)], "flagged images state inf px"),
    ],
)
def test_a_run_fails_where_errors_are_not_those_stated(
    rows: list[dict[str, Any]], failed: str
) -> None:
    sentences = failures(rows)
    assert [s[: len(failed)] for s in sentences] == ([failed] if failed else [])


def test_errors_that_are_small_by_chance_are_expected_by_their_degrees_of_freedom() -> None:
    honest = [_row("BLUR", 1000.0, stated_px=0.1, freedom=2.0) for _ in range(90)]
    wide = [_row("BLUR", 1000.0, stated_px=0.31, freedom=2.0) for _ in range(10)]
    assert wide_sigmas([*honest, *wide]) == (10, pytest.approx(100 * -np.expm1(-1.0 / 9.0)), 22)
    assert not failures([*honest, *wide])
    (sentence,) = failures([*honest, *(3 * wide)])
    assert sentence.startswith("30 flagged images state more than 3 times their error")
    moved = np.tile(np.eye(2), (25, 25))
    assert freedom_of(moved) == pytest.approx(2.0) and freedom_of(np.eye(7)) == pytest.approx(7.0)


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
