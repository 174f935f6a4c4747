"""Probes over a flight: faults are recognised and bridged, healthy ones are left alone."""

from __future__ import annotations

import math

import numpy as np
import pytest

from processing.quality.probe_health import (
    ProbeSample,
    ProbeState,
    bridge_by_others,
    calibration_temperatures,
    evaluate_probes,
)
from processing.quality.report import NO_FLAGS, Flag
from processing.rig import find_rig

CALIBRATION = dict.fromkeys(("0", "1", "2", "3"), 20.0)
OWN_OFFSET = {"0": 0.0, "1": 0.6, "2": -0.4, "3": 0.3}


def truth_c(probe: str, time_s: float) -> float:
    """A climb: 25 degC falling by 25 K with a time constant of twenty minutes."""
    return 25.0 * math.exp(-time_s / 1200.0) + OWN_OFFSET[probe]


def climb(until_s: float = 1800.0, seed: int = 1) -> dict[str, list[ProbeSample]]:
    """Readings every ten seconds, with noise of 0.05 K, in steps of 0.1 K."""
    rng = np.random.default_rng(seed)
    return {
        probe: [
            ProbeSample(t, round((truth_c(probe, t) + rng.normal(0, 0.05)) * 10.0) / 10.0)
            for t in np.arange(0.0, until_s + 1.0, 10.0)
        ]
        for probe in CALIBRATION
    }


def test_a_climb_raises_no_alarm() -> None:
    for seed in range(20):
        histories = climb(seed=seed)
        for at_s in (0.0, 300.0, 900.0, 1800.0):
            for probe, reading in evaluate_probes(histories, at_s, CALIBRATION).items():
                assert reading.state is ProbeState.GOOD and reading.flag == NO_FLAGS
                assert reading.value_c is not None
                assert abs(reading.value_c - truth_c(probe, at_s)) < 0.4


def test_a_camera_at_rest_has_no_stuck_probe() -> None:
    still = {p: [ProbeSample(float(t), 20.0) for t in range(0, 1800, 10)] for p in CALIBRATION}
    readings = evaluate_probes(still, 1790.0, CALIBRATION)
    assert {r.state for r in readings.values()} == {ProbeState.GOOD}


@pytest.mark.parametrize(
    ("state", "flag"),
    [
        (ProbeState.STUCK, Flag.TEMPERATURE_RANGE),
        (ProbeState.MISSING, Flag.TEMPERATURE_STALE),
        (ProbeState.OPEN, Flag.TEMPERATURE_MISSING),
        (ProbeState.JUMP, Flag.TEMPERATURE_RANGE),
        (ProbeState.OUT_OF_RANGE, Flag.TEMPERATURE_RANGE),
    ],
)
def test_a_fault_is_named_flagged_and_bridged_by_the_others(state: ProbeState, flag: Flag) -> None:
    histories = climb()
    began_s = 600.0
    before = [s for s in histories["1"] if s.time_s <= began_s]
    after = [s for s in histories["1"] if s.time_s > began_s]
    faulty = {
        ProbeState.STUCK: [ProbeSample(s.time_s, before[-1].value_c) for s in after],
        ProbeState.MISSING: [],
        ProbeState.OPEN: [ProbeSample(s.time_s, None) for s in after],
        ProbeState.JUMP: [ProbeSample(s.time_s, (s.value_c or 0.0) - 18.0) for s in after],
        ProbeState.OUT_OF_RANGE: [ProbeSample(s.time_s, 300.0) for s in after],
    }[state]
    histories["1"] = before + faulty
    for at_s in (1300.0, 1800.0):
        readings = evaluate_probes(histories, at_s, CALIBRATION)
        assert readings["1"].state is state and readings["1"].flag == flag
        assert readings["1"].sources == ("0", "2", "3")
        assert {readings[p].state for p in "023"} == {ProbeState.GOOD}
        value, sigma = readings["1"].value_c, readings["1"].sigma_k
        assert value is not None and sigma > readings["0"].sigma_k
        # The probe's own distance from the others is kept: 0.6 K would be missed without.
        assert abs(value - truth_c("1", at_s)) < min(0.4, 3.0 * sigma)


def test_a_probe_that_comes_back_is_believed_again() -> None:
    histories = climb()
    histories["2"] = [
        ProbeSample(s.time_s, 60.0 if 500.0 <= s.time_s < 560.0 else s.value_c)
        for s in histories["2"]
    ]
    assert evaluate_probes(histories, 520.0, CALIBRATION)["2"].state is ProbeState.JUMP
    assert evaluate_probes(histories, 600.0, CALIBRATION)["2"].state is ProbeState.GOOD


def test_stitching_bridges_where_no_other_probe_is_left() -> None:
    readings = evaluate_probes({}, 100.0, CALIBRATION, estimates={"0": (8.0, 0.3)})
    assert readings["0"].value_c == 8.0 and readings["0"].sigma_k == pytest.approx(0.3)
    assert readings["0"].sources == ("stitching",)
    assert readings["1"].value_c is None and math.isinf(readings["1"].sigma_k)


def test_stitching_and_the_others_are_weighed_with_each_other() -> None:
    histories = climb()
    histories["1"] = []
    own_reading = evaluate_probes(histories, 900.0, CALIBRATION)["1"]
    true_c = truth_c("1", 900.0)
    both = evaluate_probes(histories, 900.0, CALIBRATION, estimates={"1": (true_c, 0.3)})["1"]
    assert own_reading.value_c is not None and both.value_c is not None
    assert own_reading.sigma_k == 2.0 and both.sigma_k < 0.3
    assert abs(both.value_c - true_c) < abs(own_reading.value_c - true_c)
    assert both.sources == ("0", "2", "3", "stitching")


def test_one_exposure_is_bridged_by_the_median_of_the_other_probes() -> None:
    rig = find_rig("ultracam-x-mini")
    reference = calibration_temperatures(rig)
    usable = {p: c + 11.0 for p, c in reference.items() if p not in ("1", "N")}
    usable["R"] += 30.0
    assert bridge_by_others(rig, usable) == {"1": reference["1"] + 11.0, "N": reference["N"] + 11.0}
    assert bridge_by_others(rig, {}) == {}


def steady(level_c: float, until_s: int = 700, every_s: int = 10) -> list[ProbeSample]:
    return [ProbeSample(float(t), level_c) for t in range(0, until_s + 1, every_s)]


def warming(rate_k: float, until_s: int = 700) -> list[ProbeSample]:
    """Rises by `rate_k` over the last 600 s, in a straight line."""
    return [
        ProbeSample(float(t), 20.0 + rate_k * (t - until_s) / 600.0)
        for t in range(0, until_s + 1, 10)
    ]


@pytest.mark.parametrize(("age_s", "state"), [(30.0, "good"), (30.5, "missing")])
def test_a_reading_older_than_half_a_minute_is_missing(age_s: float, state: str) -> None:
    found = evaluate_probes({"0": [ProbeSample(5.0, 20.0)]}, 5.0 + age_s, {"0": 20.0})
    assert found["0"].state.value == state


@pytest.mark.parametrize(
    ("value_c", "state"),
    [
        (-40.0, ProbeState.GOOD),
        (-40.1, ProbeState.OUT_OF_RANGE),
        (70.0, ProbeState.GOOD),
        (70.1, ProbeState.OUT_OF_RANGE),
        (math.nan, ProbeState.OPEN),
    ],
)
def test_a_camera_is_between_minus_40_and_70_degrees(value_c: float, state: ProbeState) -> None:
    assert evaluate_probes({"0": [ProbeSample(0.0, value_c)]}, 0.0, {"0": 20.0})["0"].state is state


@pytest.mark.parametrize(
    ("step_k", "after_s", "state"),
    [
        (2.0, 1.0, ProbeState.GOOD),
        (2.05, 1.0, ProbeState.JUMP),
        (-2.05, 1.0, ProbeState.JUMP),
        (5.0, 50.0, ProbeState.GOOD),
        (5.1, 50.0, ProbeState.JUMP),
    ],
)
def test_a_step_is_possible_by_2_k_or_a_tenth_of_a_kelvin_a_second(
    step_k: float, after_s: float, state: ProbeState
) -> None:
    history = [ProbeSample(0.0, 20.0), ProbeSample(after_s, 20.0 + step_k)]
    assert evaluate_probes({"0": history}, after_s, {"0": 20.0})["0"].state is state


def test_what_is_possible_counts_from_the_last_reading_not_the_last_believed_one() -> None:
    history = [ProbeSample(0.0, 20.0)] + [ProbeSample(float(t), 25.0) for t in range(10, 101, 10)]
    assert evaluate_probes({"0": history}, 100.0, {"0": 20.0})["0"].state is ProbeState.JUMP
    open_between = [ProbeSample(0.0, 20.0), ProbeSample(40.0, None), ProbeSample(60.0, 25.9)]
    assert evaluate_probes({"0": open_between}, 60.0, {"0": 20.0})["0"].state is ProbeState.GOOD


@pytest.mark.parametrize(
    ("moved_k", "own_k", "state"),
    [
        (2.1, 0.0, ProbeState.STUCK),
        (-2.1, 0.0, ProbeState.STUCK),
        (1.9, 0.0, ProbeState.GOOD),
        (2.1, 0.045, ProbeState.STUCK),
        (2.1, 0.055, ProbeState.GOOD),
    ],
)
def test_a_probe_within_a_twentieth_of_a_kelvin_while_others_move_by_2_k_is_stuck(
    moved_k: float, own_k: float, state: ProbeState
) -> None:
    own = steady(20.0)
    own[-3] = ProbeSample(own[-3].time_s, 20.0 + own_k)
    histories = {"0": own, "1": warming(moved_k), "2": warming(moved_k)}
    found = evaluate_probes(histories, 700.0, dict.fromkeys("012", 20.0))
    assert found["0"].state is state
    assert found["1"].state is found["2"].state is ProbeState.GOOD


@pytest.mark.parametrize(("began_s", "state"), [(99, ProbeState.STUCK), (101, ProbeState.GOOD)])
def test_ten_minutes_of_history_are_needed_to_be_stuck(began_s: int, state: ProbeState) -> None:
    own = [s for s in steady(20.0, every_s=1) if s.time_s >= began_s]
    histories = {"0": own, "1": warming(3.0), "2": warming(3.0)}
    assert evaluate_probes(histories, 700.0, dict.fromkeys("012", 20.0))["0"].state is state


def test_one_other_probe_and_two_readings_are_too_few_to_be_stuck() -> None:
    calibration = dict.fromkeys("012", 20.0)
    one_other = {"0": steady(20.0), "1": warming(3.0)}
    assert evaluate_probes(one_other, 700.0, calibration)["0"].state is ProbeState.GOOD
    for count, state in ((2, ProbeState.GOOD), (3, ProbeState.STUCK)):
        own = [ProbeSample(0.0, 20.0), *[ProbeSample(700.0 - k, 20.0) for k in range(count)][::-1]]
        histories = {"0": own, "1": warming(3.0), "2": warming(3.0)}
        assert evaluate_probes(histories, 700.0, calibration)["0"].state is state


def test_a_bridge_keeps_the_distance_and_ages_by_a_twentieth_of_a_kelvin_a_minute() -> None:
    """The probe was 0.5 K and 0.7 K above the others in turn, then silent for two minutes."""
    calibration = {"0": 21.0, "1": 20.0, "2": 19.0}
    silent = [ProbeSample(float(t), 26.5 if t % 20 else 26.7) for t in range(10, 601, 10)]
    others = {"1": steady(25.0, 720), "2": steady(24.0, 720)}
    found = evaluate_probes({"0": silent} | others, 720.0, calibration)["0"]
    assert found.state is ProbeState.MISSING and found.sources == ("1", "2")
    # 5 K above calibration as the others, and its own 0.6 K.
    assert found.value_c == pytest.approx(21.0 + 5.0 + 0.6)
    # Twice a probe's 0.1 K, and the spread of the distances with two minutes of age.
    assert found.sigma_k == pytest.approx(math.hypot(0.2, 0.1 + 0.05 * 2.0))


def test_an_old_bridge_is_worth_no_less_than_one_without_history() -> None:
    calibration = dict.fromkeys("012", 20.0)
    others = {"1": steady(25.0, 6000), "2": steady(25.0, 6000)}
    found = evaluate_probes({"0": [ProbeSample(0.0, 23.0)]} | others, 6000.0, calibration)["0"]
    assert found.sigma_k == 2.0 and found.value_c == pytest.approx(23.0)
    without = evaluate_probes(others, 6000.0, calibration)["0"]
    assert without.sigma_k == 2.0 and without.value_c == pytest.approx(25.0)
    assert evaluate_probes(others, 6000.0, calibration)["1"].sigma_k == 0.1


def test_a_stuck_probe_is_bridged_by_its_distance_before_it_stood_still() -> None:
    calibration = dict.fromkeys("012", 20.0)
    moving = [ProbeSample(float(t), 20.0 + 0.005 * t) for t in range(0, 1401, 10)]
    own = [
        ProbeSample(s.time_s, s.value_c + 0.8 if s.time_s < 500.0 else 23.35)
        for s in moving
        if s.value_c is not None
    ]
    found = evaluate_probes({"0": own, "1": moving, "2": moving}, 1400.0, calibration)["0"]
    assert found.state is ProbeState.STUCK
    assert found.value_c == pytest.approx(27.0 + 0.8, abs=1e-6)


def test_estimates_are_weighted_by_their_variances() -> None:
    found = evaluate_probes(
        {"1": steady(24.0), "2": steady(24.0)},
        700.0,
        dict.fromkeys("012", 20.0),
        estimates={"0": (30.0, 1.0)},
    )["0"]
    # 24 degC with 2 K and 30 degC with 1 K.
    assert found.value_c == pytest.approx((24.0 / 4.0 + 30.0) / 1.25)
    assert found.sigma_k == pytest.approx(1.0 / math.sqrt(1.25))
