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
    judge_probes,
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
            for probe, reading in judge_probes(histories, at_s, CALIBRATION).items():
                assert reading.state is ProbeState.GOOD and reading.flag == NO_FLAGS
                assert reading.value_c is not None
                assert abs(reading.value_c - truth_c(probe, at_s)) < 0.4


def test_a_camera_at_rest_has_no_stuck_probe() -> None:
    still = {p: [ProbeSample(float(t), 20.0) for t in range(0, 1800, 10)] for p in CALIBRATION}
    readings = judge_probes(still, 1790.0, CALIBRATION)
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
        readings = judge_probes(histories, at_s, CALIBRATION)
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
    assert judge_probes(histories, 520.0, CALIBRATION)["2"].state is ProbeState.JUMP
    assert judge_probes(histories, 600.0, CALIBRATION)["2"].state is ProbeState.GOOD


def test_stitching_bridges_where_no_other_probe_is_left() -> None:
    readings = judge_probes({}, 100.0, CALIBRATION, estimates={"0": (8.0, 0.3)})
    assert readings["0"].value_c == 8.0 and readings["0"].sigma_k == pytest.approx(0.3)
    assert readings["0"].sources == ("stitching",)
    assert readings["1"].value_c is None and math.isinf(readings["1"].sigma_k)


def test_stitching_and_the_others_are_weighed_with_each_other() -> None:
    histories = climb()
    histories["1"] = []
    alone = judge_probes(histories, 900.0, CALIBRATION)["1"]
    true_c = truth_c("1", 900.0)
    both = judge_probes(histories, 900.0, CALIBRATION, estimates={"1": (true_c, 0.3)})["1"]
    assert alone.value_c is not None and both.value_c is not None
    assert alone.sigma_k == 2.0 and both.sigma_k < 0.3
    assert abs(both.value_c - true_c) < abs(alone.value_c - true_c)
    assert both.sources == ("0", "2", "3", "stitching")


def test_one_exposure_is_bridged_by_the_median_of_the_other_probes() -> None:
    rig = find_rig("ultracam-x-mini")
    reference = calibration_temperatures(rig)
    usable = {p: c + 11.0 for p, c in reference.items() if p not in ("1", "N")}
    usable["R"] += 30.0
    assert bridge_by_others(rig, usable) == {"1": reference["1"] + 11.0, "N": reference["N"] + 11.0}
    assert bridge_by_others(rig, {}) == {}
