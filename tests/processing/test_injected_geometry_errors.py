"""Wrong geometry that once went as `good`: each is rendered, and named with its size.

The stated sigma covers the error, and is at most three times as large.
"""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.processing.injected_errors import (
    InjectedExposure,
    Outcome,
    moved,
    rendered,
    slipped,
    with_f,
    with_platform_rotation,
)

pytestmark = [pytest.mark.trust, pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def error_free() -> InjectedExposure:
    return rendered("ultracam-x-mini")


def assert_covered(outcome: Outcome, *, times: float = 3.0) -> None:
    """The error lies within two stated sigmas, and these state no more than so many times it."""
    assert outcome.true_sigma_px < 2.0 * outcome.stated_sigma_px, outcome.stated_sigma_px
    assert outcome.stated_sigma_px < times * outcome.true_sigma_px, outcome.true_sigma_px


def test_an_error_free_exposure_raises_nothing(error_free: InjectedExposure) -> None:
    outcome = error_free.outcome()
    assert outcome.verdict == "good" and outcome.flags == set(), outcome.sentences
    assert_covered(outcome)
    assert outcome.figure("platform_test") < 0.5 and outcome.figure("slip_sensor") is None


def test_a_tdi_count_of_the_master_that_misfits_the_motion_widens_the_sigma(
    error_free: InjectedExposure,
) -> None:
    master = [s.name for s in error_free.rig.master_sensors]
    counts = {n: k - (n in master) for n, k in error_free.conditions.tdi_shifts.items()}
    wrong = replace(error_free, conditions=replace(error_free.conditions, tdi_shifts=counts))
    outcome = wrong.outcome()
    assert "BLUR" in outcome.flags and outcome.true_sigma_px > 0.2
    assert_covered(outcome)


@pytest.mark.parametrize(("rig", "seed"), [("ultracam-x-mini", 11), ("ultracam-l-mini", 12)])
def test_lost_tdi_counts_widen_the_sigma_and_name_the_setting(rig: str, seed: int) -> None:
    exposure = rendered(rig, seed=seed)
    for counts in ({}, {name: max(0, n - 2) for name, n in exposure.conditions.tdi_shifts.items()}):
        conditions = replace(exposure.conditions, tdi_shifts=counts)
        outcome = replace(exposure, conditions=conditions).outcome()
        assert "BLUR" in outcome.flags and outcome.true_sigma_px > 0.1
        assert_covered(outcome)
        # Partly exposed rows are no step that a supply or clock makes.
        assert outcome.figure("signal_step_sensor") is None, outcome.sentences
        is_zero = outcome.figure("tdi_shifts_max") == 0
        assert is_zero == ("enter settings.TdiShifts" in outcome.sentences)


@pytest.mark.parametrize("ppm", [1000.0, -300.0])
def test_the_masters_principal_distance_is_named_and_widens_the_sigma(
    error_free: InjectedExposure, ppm: float
) -> None:
    outcome = error_free.with_cone("0", with_f(1.0 + ppm * 1e-6)).outcome()
    assert "CALIBRATION_EXPIRED" in outcome.flags and outcome.verdict == "usable"
    assert (
        outcome.figure("platform_causes") == "0" and "not fit the master cone" in outcome.sentences
    )
    assert outcome.figure("common_scale_ppm") == pytest.approx(-ppm, abs=60.0)
    assert_covered(outcome)


def test_below_its_detection_limit_a_principal_distance_widens_the_sigma(
    error_free: InjectedExposure,
) -> None:
    outcome = error_free.with_cone("0", with_f(1.0001)).outcome()
    assert outcome.verdict == "good"
    assert outcome.true_sigma_px > 0.08
    assert_covered(outcome)


def test_the_principal_distance_of_another_cone_is_corrected_and_named(
    error_free: InjectedExposure,
) -> None:
    outcome = error_free.with_cone("2", with_f(1.001)).outcome()
    assert outcome.figure("platform_causes") == "2" and "corrected" in outcome.sentences
    assert_covered(outcome)
    assert outcome.inner_px < 0.02


@pytest.mark.parametrize(
    ("sensor", "axis", "first", "by", "length", "shift_px"),
    [
        ("SU11", "rows", 300, 4, 84, 4.0),
        ("SU21", "rows", 100, 2, 40, 2.0),
        ("SU00", "rows", 416, 1, None, 1.0),
        ("SU02", "columns", 900, 1, None, 1.0),
        ("SU30", "rows", 416, 1, None, 1.0),
        ("SU30", "columns", 600, 1, None, 1.0),
        ("G", "rows", 300, 1, None, 3.0),
        # Farther than tie points of colour are sought.
        ("G", "rows", 500, 3, 207, 9.0),
        ("G", "columns", 300, 4, 160, 12.0),
    ],
)
def test_a_read_out_slip_is_found_named_and_measured(
    error_free: InjectedExposure,
    sensor: str,
    axis: str,
    first: int,
    by: int,
    length: int | None,
    shift_px: float,
) -> None:
    outcome = error_free.with_frame(sensor, slipped(axis, first, by, length)).outcome()
    assert outcome.verdict == "refly" and "FRAME_CORRUPT" in outcome.flags
    assert outcome.figure("slip_sensor") == sensor and outcome.figure("slip_axis") == axis
    assert outcome.figure("slip_px") == pytest.approx(shift_px, rel=0.5)
    assert outcome.figure("slip_first") <= first + 25
    # Nobody else is accused, and what is not in the band is in its place.
    assert "DISPLACED_SENSOR" not in outcome.flags, outcome.sentences
    assert "CALIBRATION_EXPIRED" not in outcome.flags, outcome.sentences
    assert outcome.inner_px < 0.03
    if sensor != "G":
        share = (outcome.figure("slip_last") - outcome.figure("slip_first")) / 832
        assert outcome.figure("stitched_sigma_worst_px") > 0.4 * share * shift_px


@pytest.mark.parametrize(
    ("sensor", "axis", "first", "by", "length", "shift_px"),
    [
        ("R", "rows", 416, 3, None, 9.0),
        ("B", "rows", 300, 2, 160, 6.0),
        ("N", "columns", 624, 2, None, 6.0),
    ],
)
def test_a_read_out_slip_of_a_head_that_is_registered_to_green_is_found(
    error_free: InjectedExposure,
    sensor: str,
    axis: str,
    first: int,
    by: int,
    length: int | None,
    shift_px: float,
) -> None:
    outcome = error_free.with_frame(sensor, slipped(axis, first, by, length)).outcome()
    assert outcome.verdict == "refly", outcome.sentences
    assert outcome.figure("slip_sensors") == sensor and outcome.figure("slip_axis") == axis
    assert outcome.figure("slip_alternatives") is None
    assert outcome.figure("slip_px") == pytest.approx(shift_px, abs=0.3)
    assert outcome.figure("slip_first") == pytest.approx(first, abs=30)
    # The lines in place are registered without those that are not.
    assert outcome.figure(f"{_band_of(error_free, sensor)}_rms_px") < 0.3
    assert outcome.inner_px < 0.03


def slipped_frames(outcome: Outcome) -> set[str]:
    """All frames that are named for a slip."""
    names = [outcome.figure("slip_sensors") or "", outcome.figure("slip_alternatives") or ""]
    return {name for group in names for name in group.split(", ") if name}


def _band_of(exposure: InjectedExposure, sensor: str) -> str:
    return exposure.rig.cone_of(sensor).bands[0]


@pytest.mark.parametrize(
    ("sensor", "axis", "first", "by", "shift_px"),
    [
        ("SU03", "rows", 792, -3, 3.0),
        ("SU10", "rows", 0, 1, 1.0),
        ("SU20", "columns", 0, 2, 2.0),
    ],
)
def test_lines_that_slipped_at_the_end_of_a_frame_are_found(
    error_free: InjectedExposure, sensor: str, axis: str, first: int, by: int, shift_px: float
) -> None:
    outcome = error_free.with_frame(sensor, slipped(axis, first, by, 40)).outcome()
    assert outcome.verdict == "refly", outcome.sentences
    assert sensor in slipped_frames(outcome) and outcome.figure("slip_axis") == axis
    assert outcome.figure("slip_px") == pytest.approx(shift_px, rel=0.3)
    assert outcome.figure("stitched_sigma_worst_px") > 0.09 * shift_px


@pytest.mark.parametrize("off_k", [4.0, -28.0])
def test_all_probes_that_misread_alike_widen_the_sigma(
    error_free: InjectedExposure, off_k: float
) -> None:
    outcome = error_free.with_probes(off_k).outcome()
    assert "DC_DISAGREEMENT" in outcome.flags and "CALIBRATION_EXPIRED" not in outcome.flags
    assert_covered(outcome)


@pytest.mark.parametrize("moves", [((1.0, 0.5), (-0.4, 1.2)), ((0.3, 0.5), (-0.4, 0.2))])
def test_two_moved_master_sensors_name_no_single_one(
    error_free: InjectedExposure, moves: tuple[tuple[float, float], tuple[float, float]]
) -> None:
    first, second = moves
    planted = error_free.with_sensor("SU00", moved(*first)).with_sensor("SU01", moved(*second))
    outcome = planted.outcome()
    assert "DISPLACED_SENSOR" in outcome.flags
    assert (
        outcome.figure("displaced_sensor") is None and "More than one sensor" in outcome.sentences
    )
    assert_covered(outcome)


@pytest.mark.parametrize("angle", ["x_rad", "y_rad", "z_rad"])
def test_a_rotated_cone_is_corrected_and_named(error_free: InjectedExposure, angle: str) -> None:
    outcome = error_free.with_cone("2", with_platform_rotation(**{angle: 3e-4})).outcome()
    assert outcome.figure("platform_causes") == "2" and "CALIBRATION_EXPIRED" in outcome.flags
    assert_covered(outcome)


@pytest.fixture(scope="module")
def two_cones() -> InjectedExposure:
    return rendered("ultracam-l-mini", seed=21, dc_k=6.0)


@pytest.fixture(scope="module")
def converging() -> InjectedExposure:
    return rendered("dmc-mini", seed=21, dc_k=6.0)


def test_error_free_exposures_of_other_rigs_raise_nothing(
    two_cones: InjectedExposure, converging: InjectedExposure
) -> None:
    for planted in (two_cones, converging):
        outcome = planted.outcome()
        assert outcome.verdict == "good" and outcome.flags == set(), outcome.sentences
        assert_covered(outcome)


def test_a_master_of_one_sensor_with_a_wrong_principal_distance_is_named(
    two_cones: InjectedExposure,
) -> None:
    outcome = two_cones.with_cone("0", with_f(1.001)).outcome()
    assert outcome.figure("platform_causes") == "0"
    assert_covered(outcome)


def test_a_slip_that_two_frames_explain_alike_names_both(two_cones: InjectedExposure) -> None:
    outcome = two_cones.with_frame("SU10", slipped("columns", 400, 2, 80)).outcome()
    assert outcome.verdict == "refly"
    named = {outcome.figure("slip_sensor"), outcome.figure("slip_alternatives")}
    assert named == {"SU10", "RGB"} and " (or " in outcome.sentences


@pytest.mark.parametrize("head", ["1", "2"])
def test_a_converging_head_with_a_wrong_principal_distance_is_not_called_corrected(
    converging: InjectedExposure, head: str
) -> None:
    outcome = converging.with_cone(head, with_f(1.001)).outcome()
    assert outcome.verdict != "good" and "CALIBRATION_EXPIRED" in outcome.flags
    assert "not corrected" in outcome.sentences and outcome.figure("slip_sensor") is None
    assert_covered(outcome)


@pytest.mark.parametrize("slipped_head", ["P2", "P3"])
def test_a_slip_next_to_a_head_with_a_wrong_principal_distance_is_named(
    converging: InjectedExposure, slipped_head: str
) -> None:
    scaled = converging.with_cone("3", with_f(1.0005))
    outcome = scaled.with_frame(slipped_head, slipped("rows", 300, 3, 120)).outcome()
    assert outcome.verdict == "refly" and outcome.figure("slip_sensors") == slipped_head
    assert abs(outcome.figure("slip_first") - 300) < 40
    assert "CALIBRATION_EXPIRED" in outcome.flags and "not corrected" in outcome.sentences


def test_a_converging_head_that_rotated_widens_the_sigma_by_the_mean(
    converging: InjectedExposure,
) -> None:
    outcome = converging.with_cone("2", with_platform_rotation(x_rad=8e-4)).outcome()
    assert "CALIBRATION_EXPIRED" in outcome.flags and outcome.figure("platform_shift_head") == "2"
    assert outcome.inner_px < 0.02
    assert_covered(outcome)


@pytest.mark.parametrize(
    ("axis", "first", "by", "length"), [("rows", 300, 1, None), ("columns", 400, 2, 80)]
)
def test_slips_of_converging_heads_are_named(
    converging: InjectedExposure, axis: str, first: int, by: int, length: int | None
) -> None:
    outcome = converging.with_frame("P2", slipped(axis, first, by, length)).outcome()
    assert outcome.verdict == "refly" and outcome.figure("slip_sensor") == "P2"
    assert "CALIBRATION_EXPIRED" not in outcome.flags, outcome.sentences


@pytest.mark.parametrize("angle", ["x_rad", "y_rad", "z_rad"])
def test_a_converging_head_that_turned_about_any_axis_is_named(angle: str) -> None:
    turned = with_platform_rotation(**{angle: -2.4e-4})
    outcome = rendered("dmc-mini").with_cone("1", turned).outcome()
    assert "CALIBRATION_EXPIRED" in outcome.flags and outcome.figure("platform_shift_head") == "1"
    assert outcome.figure("platform_shift_px") > 0.1
    assert outcome.true_sigma_px < 2.0 * outcome.stated_sigma_px


def test_a_turn_below_its_detection_limit_widens_the_sigma_by_the_mean() -> None:
    healthy = rendered("dmc-mini")
    turned = healthy.with_cone("2", with_platform_rotation(x_rad=-1e-4)).outcome()
    assert turned.verdict == "good", turned.sentences
    assert_covered(turned)
    assert turned.stated_sigma_px > 1.3 * healthy.outcome().stated_sigma_px


def test_a_slip_of_the_second_colour_head_is_found_and_green_is_not_accused(
    two_cones: InjectedExposure,
) -> None:
    outcome = two_cones.with_frame("N", slipped("rows", 416, 3)).outcome()
    assert outcome.verdict == "refly"
    assert outcome.figure("slip_sensors") == "N" and outcome.figure("slip_alternatives") is None
    assert outcome.figure("slip_px") == pytest.approx(6.0, abs=0.3)


@pytest.mark.parametrize(("sensor", "first", "by"), [("SU10", 0, 2), ("SU00", 1624, -1)])
def test_of_two_pan_frames_the_one_with_slipped_lines_at_its_end_is_named(
    two_cones: InjectedExposure, sensor: str, first: int, by: int
) -> None:
    outcome = two_cones.with_frame(sensor, slipped("rows", first, by, 40)).outcome()
    assert outcome.verdict == "refly"
    assert slipped_frames(outcome) - {"RGB"} == {sensor}
    assert outcome.figure("slip_px") == pytest.approx(abs(by), abs=0.4)
