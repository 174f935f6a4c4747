"""The verdict: figures in, findings with sentences out."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import pytest

from processing.quality.evaluation import evaluate
from processing.quality.figures import QualityFigures
from processing.quality.figures.circumstances import SmearFigures
from processing.quality.report import NO_FLAGS, Flag, QualityReport, Thresholds, Verdict, as_json

GOOD = {
    "sigma0_px": 0.05,
    "tie_points_pp": 2000,
    "tie_points_pc": 3000,
    "tie_points_min_overlap": 100,
    "time_sigma_ns": 60.0,
    "valid_fraction": 0.996,
    "saturated_fraction": 1e-4,
    "bright_fraction": 0.5,
    "smear_along_px": 0.4,
    "smear_across_px": 0.1,
    "sharpness": 0.45,
    "tilt_deg": 1.0,
    "crab_deg": 2.0,
    "temperature_age_s": 1.0,
}


def evaluated(figures: Mapping[str, Any], **known: Any) -> QualityReport:
    """The verdict on figures by their documented names."""
    return evaluate(QualityFigures.from_json(figures), **known)


def test_good_figures_make_a_good_exposure() -> None:
    report = evaluated(GOOD)
    assert report.verdict is Verdict.GOOD
    assert report.flags == NO_FLAGS and report.findings == ()


def test_what_is_not_known_is_not_evaluated() -> None:
    assert evaluated({}).verdict is Verdict.GOOD
    assert evaluated(dict.fromkeys(GOOD)).verdict is Verdict.GOOD
    assert evaluated(dict.fromkeys(GOOD, math.nan)).verdict is Verdict.GOOD


@pytest.mark.parametrize(
    ("name", "value", "flag", "verdict"),
    [
        ("time_sigma_ns", 2e5, Flag.TIME_SIGMA, Verdict.USABLE),
        ("time_sigma_ns", 1e8, Flag.TIME_SIGMA, Verdict.REFLY),
        ("time_error_px", 0.11, Flag.TIME_SIGMA, Verdict.USABLE),
        ("time_error_px", 11.0, Flag.TIME_SIGMA, Verdict.REFLY),
        ("temperature_age_s", 31.0, Flag.TEMPERATURE_STALE, Verdict.USABLE),
        ("tie_points_min_overlap", 11, Flag.TIE_POINTS, Verdict.USABLE),
        ("sigma0_px", 0.31, Flag.SIGMA0, Verdict.USABLE),
        ("sigma0_px", 1.1, Flag.SIGMA0, Verdict.REFLY),
        ("bright_fraction", 0.05, Flag.UNDEREXPOSED, Verdict.USABLE),
        ("bright_fraction", 0.005, Flag.UNDEREXPOSED, Verdict.REFLY),
        ("saturated_fraction", 0.01, Flag.OVEREXPOSED, Verdict.USABLE),
        ("saturated_fraction", 0.1, Flag.OVEREXPOSED, Verdict.REFLY),
        ("smear_along_px", 0.9, Flag.BLUR, Verdict.USABLE),
        ("smear_across_px", 2.5, Flag.BLUR, Verdict.REFLY),
        ("sharpness", 0.251, Flag.BLUR, Verdict.USABLE),
        ("tilt_deg", 6.0, Flag.TILT, Verdict.USABLE),
        ("crab_deg", 6.0, Flag.DRIFT, Verdict.USABLE),
        ("valid_fraction", 0.5, Flag.FRAME_MISSING, Verdict.REFLY),
    ],
)
def test_each_figure_beyond_its_threshold_raises_its_flag(
    name: str, value: float, flag: Flag, verdict: Verdict
) -> None:
    report = evaluated(GOOD | {name: value})
    assert report.flags == flag
    assert report.verdict is verdict
    (finding,) = report.findings
    assert finding.value == value and finding.threshold is not None
    assert len(finding.sentence) > 20 and finding.sentence.endswith(".")


@pytest.mark.trust
@pytest.mark.parametrize(
    ("snr", "verdict"),
    [(39.9, Verdict.USABLE), (40.0, Verdict.GOOD), (None, Verdict.USABLE)],
)
def test_a_dark_image_is_judged_by_its_noise(snr: float | None, verdict: Verdict) -> None:
    report = evaluated(GOOD | {"bright_fraction": 0.05, "bright_snr": snr})
    assert report.flags == Flag.UNDEREXPOSED and report.verdict is verdict
    assert ("40 times their noise" in report.findings[0].sentence) is (snr is not None)


def test_a_black_image_is_flown_again_whatever_its_noise() -> None:
    report = evaluated(GOOD | {"bright_fraction": 0.009, "bright_snr": 50.0})
    assert report.verdict is Verdict.REFLY


def test_an_exposure_without_tie_points_is_flown_again() -> None:
    report = evaluated(GOOD | {"tie_points_pp": 3, "tie_points_min_overlap": 0})
    assert report.verdict is Verdict.REFLY


def test_a_missing_frame_makes_the_exposure_usable_at_most() -> None:
    report = evaluated(GOOD, missing_sensors=["SU10"])
    assert report.verdict is Verdict.USABLE and report.flags == Flag.FRAME_MISSING
    assert "SU10" in report.findings[0].sentence


def test_a_displaced_sensor_that_was_handled_is_no_reason_to_fly_again() -> None:
    report = evaluated(
        GOOD | {"displaced_sensor": "SU01", "displacement_x_px": 0.6, "displacement_y_px": -0.8}
    )
    assert report.verdict is Verdict.USABLE and report.flags == Flag.DISPLACED_SENSOR
    assert "Sensor SU01 sits 1.00 px off" in report.findings[0].sentence


def test_probes_are_named_and_their_flags_distinguished() -> None:
    report = evaluated(GOOD, missing_probes=["1", "G"], probes_out_of_range=["2"])
    assert report.flags == Flag.TEMPERATURE_MISSING | Flag.TEMPERATURE_RANGE
    assert "probe 1, G" in report.findings[0].sentence


def test_every_flag_capture_may_raise_states_what_to_do() -> None:
    figures_only = (
        Flag.TIME_SIGMA
        | Flag.TEMPERATURE_MISSING
        | Flag.TEMPERATURE_STALE
        | Flag.TEMPERATURE_RANGE
        | Flag.TIE_POINTS
        | Flag.SIGMA0
        | Flag.DISPLACED_SENSOR
        | Flag.UNDEREXPOSED
        | Flag.OVEREXPOSED
        | Flag.BLUR
        | Flag.TILT
        | Flag.DRIFT
    )
    for flag in Flag:
        if flag & figures_only:
            continue
        report = evaluated(GOOD, capture_flags=flag)
        assert report.flags == flag
        assert [finding.flag for finding in report.findings] == [flag]


def test_a_capture_flag_without_figures_is_retained() -> None:
    assert evaluated(GOOD, capture_flags=Flag.TIME_SIGMA).flags == Flag.TIME_SIGMA


def test_simulation_is_reported_and_does_not_spoil_the_verdict() -> None:
    report = evaluated(GOOD, capture_flags=Flag.SIMULATED)
    assert report.verdict is Verdict.GOOD and report.flags == Flag.SIMULATED


def test_thresholds_are_the_configurations_to_change() -> None:
    assert evaluated(GOOD, thresholds=Thresholds(sigma0_px=0.01)).flags == Flag.SIGMA0


def test_json_has_no_nan_and_names_its_flags() -> None:
    report = evaluated(
        GOOD | {"sigma0_px": math.nan, "sharpness": math.inf, "sigma0_um": -math.inf},
        capture_flags=Flag.MARK_MISSING,
        missing_sensors=["G"],
    )
    text = json.dumps(as_json(report), allow_nan=False)
    found = json.loads(text)
    assert found["verdict"] == "usable"
    assert found["flags"] == ["FRAME_MISSING", "MARK_MISSING"]
    assert found["flag_bits"] == 0b10001
    assert found["figures"]["sigma0_px"] is None and found["figures"]["tie_points_pp"] == 2000
    assert {f["flag"] for f in found["findings"]} == set(found["flags"])


def test_bits_keep_their_places_for_ever() -> None:
    names = [
        *("FRAME_MISSING", "FRAME_LATE", "FRAME_DUPLICATE", "FRAME_CORRUPT", "MARK_MISSING"),
        *("MARK_AMBIGUOUS", "TIME_SIGMA", "TEMPERATURE_MISSING", "TEMPERATURE_STALE"),
        *("TEMPERATURE_RANGE", "DC_DISAGREEMENT", "TIE_POINTS", "SIGMA0", "DISPLACED_SENSOR"),
        *("CALIBRATION_EXPIRED", "UNDEREXPOSED", "OVEREXPOSED", "BLUR", "TILT", "DRIFT"),
        *("OVERLAP", "GNSS", "DISK_LOW", "PROCESSING_BEHIND", "SIMULATED", "NOT_PROCESSED"),
        *("TIME_HOLDOVER", "SUN", "GSD", "FRAME_AMBIGUOUS", "NOT_MIRRORED", "UNCALIBRATED"),
        "PTP_FAULT",
    ]
    assert {name: int(Flag[name]) for name in names} == {
        name: 1 << bit for bit, name in enumerate(names)
    }


def test_two_displaced_sensors_are_reported_as_ambiguous() -> None:
    moved = {"displaced_sensor": "SU01", "displacement_x_px": 0.6, "displacement_y_px": -0.8}
    report = evaluated(GOOD | moved | {"displaced_several": 1})
    assert report.flags == Flag.DISPLACED_SENSOR
    assert "More than one sensor" in report.findings[0].sentence
    assert "cannot be determined" in report.findings[0].sentence
    unsure = evaluated(GOOD | moved | {"displaced_alternatives": "SU00, SU03"})
    assert "unless it is SU00, SU03" in unsure.findings[0].sentence


def test_a_probe_that_explains_it_is_named_instead_of_a_sensor_or_in_addition_to_it() -> None:
    misread = {"misread_probe": "0", "misread_k": 3.96, "misread_sigma_k": 0.2}
    report = evaluated(GOOD | misread | {"dc_disagreement": "0"})
    assert report.flags == Flag.DC_DISAGREEMENT and report.verdict is Verdict.USABLE
    (finding,) = report.findings
    assert "probe 0 reads 4.0 K too high" in finding.sentence
    moved = {"displaced_sensor": "SU01", "displacement_x_px": 0.6, "displacement_y_px": -0.8}
    report = evaluated(GOOD | misread | moved | {"misread_k": -2.0})
    assert report.flags == Flag.DC_DISAGREEMENT | Flag.DISPLACED_SENSOR
    for finding in report.findings:
        assert "probe 0 reads 2.0 K too low" in finding.sentence and "SU01" in finding.sentence
    assert "the stitching cannot separate them" in report.findings[1].sentence


def test_an_overlap_without_tie_points_because_it_is_saturated_reports_it() -> None:
    few = {"tie_points_min_overlap": 3, "tie_points_min_overlap_name": "SU03-SU11"}
    saturated_report = evaluated(
        GOOD | few | {"tie_points_min_overlap_burnt": 0.83, "saturated_fraction": 0.06}
    )
    assert saturated_report.flags == Flag.TIE_POINTS | Flag.OVEREXPOSED
    sentence_of_overlap = next(
        f.sentence for f in saturated_report.findings if f.flag == Flag.TIE_POINTS
    )
    assert (
        "SU03-SU11 because it is saturated: 83%" in sentence_of_overlap
        and "water" not in sentence_of_overlap
    )
    lake = evaluated(GOOD | few | {"tie_points_min_overlap_burnt": 0.1, "saturated_fraction": 0.06})
    sentence_of_overlap = next(f.sentence for f in lake.findings if f.flag == Flag.TIE_POINTS)
    assert "water" in sentence_of_overlap


def test_sensors_that_rest_on_calibration_are_reported() -> None:
    report = evaluated(GOOD | {"resting_on_calibration": "SU00, SU10"})
    assert report.flags == Flag.TIE_POINTS and report.verdict is Verdict.USABLE
    assert "Too little detail to place SU00, SU10" in report.findings[0].sentence


@pytest.mark.parametrize(
    ("shifts", "named"), [(0, True), (None, False), (2, False)], ids=["none", "not known", "two"]
)
def test_motion_without_tdi_shifts_in_the_record_names_the_setting(
    shifts: int | None, named: bool
) -> None:
    smear = SmearFigures(smear_along_px=1.5, smear_across_px=1.2, tdi_shifts_max=shifts)
    along, across = evaluate(QualityFigures(smear)).findings
    assert along.flag == across.flag == Flag.BLUR
    assert ("settings.TdiShifts" in along.sentence) == named
    assert across.sentence.startswith("Motion blur across track; shorten")
