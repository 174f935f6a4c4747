"""Figures of the circumstances, against numbers worked out by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from processing.geometry.conditions import (
    Conditions,
    condition_figures,
    parallax_px,
    tdi_misfit_px,
    usable_temperatures,
)
from processing.geometry.exposure_times import (
    exposure_scale_figures,
    exposure_scales,
    implausible_exposure_times,
    reference_exposure_times,
)
from processing.geometry.placement import nominal_placements
from processing.quality.figures import Figure, QualityFigures
from processing.quality.report import Flag, Thresholds
from processing.rig import Rig, find_rig


@pytest.fixture
def rig() -> Rig:
    return find_rig("ultracam-x-mini")


def figures(rig: Rig, conditions: Conditions) -> dict[str, Figure]:
    temperatures = usable_temperatures(rig, conditions, Thresholds())
    return QualityFigures(*condition_figures(rig, conditions, temperatures)).as_json()


def test_ground_sampling_distance_is_height_by_pitch_over_focal_length(rig: Rig) -> None:
    found = figures(rig, Conditions(height_above_ground_m=1000.0))["gsd_m"]
    assert found == pytest.approx(1000 * 7.2e-6 / 0.1005)


def test_tdi_takes_its_shifts_off_the_smear_along_track(rig: Rig) -> None:
    gsd = 1000 * 7.2e-6 / 0.1005
    conditions = Conditions(
        height_above_ground_m=1000.0,
        ground_speed_mps=70.0,
        exposure_time_s={sensor.name: 0.008 for sensor in rig.sensors},
        tdi_shifts={sensor.name: 8 for cone in rig.pan_cones for sensor in cone.sensors},
        crab_rad=math.radians(3.0),
    )
    found = figures(rig, conditions)
    moved = 70 * 0.008 / gsd
    assert found["smear_along_px"] == pytest.approx(abs(moved * math.cos(math.radians(3)) - 8))
    assert found["smear_across_px"] == pytest.approx(moved * math.sin(math.radians(3)))
    assert found["crab_deg"] == pytest.approx(3.0)


def test_a_tdi_count_that_leaves_too_much_motion_is_given_by_cone(rig: Rig) -> None:
    gsd = 1000 * 7.2e-6 / 0.1005
    counts = {s.name: 6 if cone.name == "1" else 8 for cone in rig.cones for s in cone.sensors}
    conditions = Conditions(
        height_above_ground_m=1000.0,
        ground_speed_mps=8.25 * gsd / 0.008,
        exposure_time_s={sensor.name: 0.008 for sensor in rig.sensors},
        tdi_shifts=counts,
        crab_rad=0.0,
    )
    assert tdi_misfit_px(rig, conditions, 0.8) == {"1": pytest.approx(2.25)}
    assert len(tdi_misfit_px(rig, conditions, 0.2)) == len(rig.pan_cones)
    unstated = replace(conditions, tdi_shifts={})
    for zero in (unstated, replace(conditions, tdi_shifts=dict.fromkeys(counts, 0))):
        every = dict.fromkeys((cone.name for cone in rig.pan_cones), pytest.approx(8.25))
        assert tdi_misfit_px(rig, zero, 0.8) == every
        assert figures(rig, zero)["tdi_shifts_max"] == 0
    still = replace(unstated, ground_speed_mps=0.0)
    assert tdi_misfit_px(rig, still, 0.8) == {}
    assert figures(rig, conditions)["tdi_shifts_max"] == 8


def test_angular_rates_smear_by_focal_length_over_pitch(rig: Rig) -> None:
    conditions = Conditions(
        exposure_time_s={sensor.name: 0.01 for sensor in rig.sensors},
        angular_rate_rad_per_s=(0.02, -0.01, 0.0),
    )
    found = figures(rig, conditions)
    assert found["smear_across_px"] == pytest.approx(0.02 * 0.01 * 100.5 / 0.0072)
    assert found["smear_along_px"] == pytest.approx(0.01 * 0.01 * 100.5 / 0.0072)


def test_unknown_motion_gives_no_figure_instead_of_a_good_one(rig: Rig) -> None:
    found = figures(rig, Conditions())
    assert found["smear_along_px"] is None and found["smear_across_px"] is None
    assert found["tilt_deg"] is None and found["dc_k"] is None


def test_parallax_of_the_green_cone_over_relief(rig: Rig) -> None:
    # 100 mm of base, 500 m of height, 50 m of relief: 0.28 px.
    conditions = Conditions(height_above_ground_m=500.0)
    assert parallax_px(rig, conditions, 0.1) == pytest.approx(0.28, abs=0.005)
    assert parallax_px(rig, Conditions(), 0.1) == 0.0


def test_temperatures_are_sorted_into_usable_missing_and_impossible(rig: Rig) -> None:
    readings = {"0": 31.0, "1": None, "2": math.nan, "3": 250.0, "R": 20.0, "G": 21.5}
    found = usable_temperatures(rig, Conditions(temperatures_c=readings), Thresholds())
    assert dict(found.usable_c) == {"0": 31.0, "R": 20.0, "G": 21.5}
    assert found.missing == ("1", "2", "B", "N") and found.out_of_range == ("3",)


def test_dc_is_reported_per_cone_and_as_the_mean_of_the_pan_cones(rig: Rig) -> None:
    readings = {"0": 32.0, "1": 31.0, "2": 33.0, "3": 32.0, "G": 50.0}
    found = figures(rig, Conditions(temperatures_c=readings, temperature_age_s={"0": 2, "G": 5}))
    assert found["dc_k_1"] == pytest.approx(11.0) and found["dc_k_R"] is None
    assert found["dc_k"] == pytest.approx(12.0)
    assert found["temperature_age_s"] == 5


def test_simulated_hardware_raises_its_flag() -> None:
    conditions = Conditions(capture_flags=Flag.MARK_MISSING, simulated=True)
    assert conditions.flags == Flag.MARK_MISSING | Flag.SIMULATED


def test_the_frames_of_a_cone_are_brought_to_its_median_exposure_time() -> None:
    rig = find_rig("ultracam-x-mini")
    times_s = {sensor.name: 0.004 for sensor in rig.sensors}
    assert set(exposure_scales(rig, times_s).values()) == {1.0}
    scales = exposure_scales(rig, times_s | {"SU01": 0.002, "R": 0.001})
    assert scales["SU01"] == 2.0
    # A quarter of the time of the others would leave the range of words: red keeps its own.
    assert {name for name, scale in scales.items() if scale != 1.0} == {"SU01"}
    assert "SU30" not in exposure_scales(rig, {"SU01": 0.002})
    assert exposure_scales(rig, {"SU00": 0.004, "SU01": 0.002})["SU00"] == 0.5


def test_of_two_frames_of_a_cone_the_usual_one_is_the_measure() -> None:
    rig = find_rig("ultracam-x-mini")
    usual_s = {sensor.name: 0.004 for sensor in rig.sensors}
    assert [s.name for s in rig.pan_cones[1].sensors] == ["SU10", "SU11"]
    for time_s in (0.0005, 0.032):
        for name in ("SU10", "SU11"):
            scales = exposure_scales(rig, usual_s | {name: time_s})
            assert {n: s for n, s in scales.items() if s != 1.0} == {name: 0.004 / time_s}


def test_exposure_times_that_cannot_be_are_named() -> None:
    rig = find_rig("ultracam-x-mini")
    usual_s = {sensor.name: 0.002 for sensor in rig.sensors}
    assert implausible_exposure_times(rig, {}) == ()
    assert implausible_exposure_times(rig, usual_s) == ()
    for time_s in (1e-8, 0.0, -0.002, math.nan, math.inf, 10.1, 0.002 / 16.1, 0.002 * 16.1):
        assert implausible_exposure_times(rig, usual_s | {"SU10": time_s}) == ("SU10",)
        assert implausible_exposure_times(rig, usual_s | {"G": time_s}) == ("G",)
    for time_s in (0.002 / 15.9, 0.002 * 15.9):
        assert implausible_exposure_times(rig, usual_s | {"SU10": time_s, "R": time_s}) == ()
    # PAN and colour differ as they like; of two frames neither is known to be wrong.
    colour_s = {name: 0.1 if name in "RGBN" else time_s for name, time_s in usual_s.items()}
    assert implausible_exposure_times(rig, colour_s) == ()
    assert implausible_exposure_times(rig, {"SU10": 0.002, "SU11": 0.1}) == ()
    assert implausible_exposure_times(rig, {"SU10": 0.002, "SU11": 1e-7}) == ("SU11",)


def test_cones_are_brought_to_the_exposure_time_of_their_kind() -> None:
    rig = find_rig("ultracam-x-mini")
    times_s = {sensor.name: 0.012 if sensor.name in "RGBN" else 0.004 for sensor in rig.sensors}
    scales = exposure_scales(rig, times_s | {"R": 0.006, "SU30": 0.008, "N": 0.0121})
    assert {name: s for name, s in scales.items() if s != 1.0} == {"R": 2.0, "SU30": 0.5}
    assert exposure_scale_figures(scales).exposure_scale in (2.0, 0.5)
    times_s |= {"R": 0.0058}
    assert reference_exposure_times(rig, times_s)["R"] == 0.0058
    assert reference_exposure_times(rig, times_s)["SU30"] == 0.004


def test_smear_is_that_of_the_frame_that_moved_most() -> None:
    rig = find_rig("ultracam-x-mini")
    conditions = Conditions(
        exposure_time_s={sensor.name: 0.008 for sensor in rig.sensors},
        tdi_shifts={sensor.name: 8 for cone in rig.pan_cones for sensor in cone.sensors},
        ground_speed_mps=64.0,
        height_above_ground_m=600.0,
    )
    usual = figures(rig, conditions)["smear_along_px"]
    shifts = {**conditions.tdi_shifts, "SU03": 2}
    worst = figures(rig, replace(conditions, tdi_shifts=shifts))["smear_along_px"]
    assert isinstance(usual, float) and isinstance(worst, float)
    assert abs(worst - usual) == pytest.approx(6.0)


def test_a_tdi_count_of_what_is_no_sensor_is_refused() -> None:
    rig = find_rig("ultracam-x-mini")
    with pytest.raises(ValueError, match="tdi_shifts names '0'; rig ultracam-x-mini has no such"):
        nominal_placements(rig, {}, {"0": 8})
