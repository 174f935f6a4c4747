"""What a probe read at an instant, and what a sensor that lags behind it had by then."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from daemon.onboard.flight.temperatures import TemperatureHistory
from drivers.contract import TemperatureSample
from processing.geometry.drift import lag_step, lagged_probe, lagged_sensors, sensor_dc
from processing.rig import Rig, find_rig

SECOND = 1_000_000_000
LAG_S = 120.0


@pytest.fixture(scope="module")
def rig() -> Rig:
    """SU00 follows probe 0 with a lag of two minutes."""
    rig = find_rig("ultracam-x-mini")
    cone = rig.cone("0")
    slow = replace(cone.sensors[0], drift=replace(cone.sensors[0].drift, lag_s=LAG_S))
    cone = replace(cone, sensors=(slow, *cone.sensors[1:]))
    return replace(rig, cones=(cone, *rig.cones[1:]))


def reading(probe: str, time_s: float, value_c: float | None) -> TemperatureSample:
    return TemperatureSample(probe=probe, mono_ns=round(time_s * SECOND), value_c=value_c)


def at(temperatures: TemperatureHistory, time_s: float) -> dict[str, float | None]:
    return {t.probe: t.value_c for t in temperatures.at(round(time_s * SECOND))}


def test_a_lagged_sensor_follows_a_step_exponentially(rig: Rig) -> None:
    slow = TemperatureHistory(lagged_sensors(rig))
    slow.add(reading("0", 0.0, 20.0))
    for k in range(1, 601):
        slow.add(reading("0", k, 30.0))
        slow.add(reading("1", k, 25.0))
    for time_s in (480.0, 540.0, 600.0):
        # The step takes the one second between two readings: half a second late on the whole.
        expected = 30.0 - 10.0 * math.exp(-(time_s - 0.5) / LAG_S)
        assert at(slow, time_s)["0/SU00"] == pytest.approx(expected, abs=1e-3)
    assert at(slow, 600.0) == {"0": 30.0, "1": 25.0, "0/SU00": at(slow, 600.0)["0/SU00"]}


def test_on_a_steady_climb_the_sensor_is_late_by_its_lag() -> None:
    lagged, rate_k_per_s = 20.0, 0.01
    for k in range(1200):
        lagged = lag_step(lagged, 20.0 + rate_k_per_s * k, 20.0 + rate_k_per_s * (k + 1), 1.0, 90.0)
    assert 20.0 + 12.0 - lagged == pytest.approx(rate_k_per_s * 90.0, rel=1e-4)


def test_the_step_length_does_not_matter_on_a_straight_line() -> None:
    fine = 20.0
    for k in range(100):
        fine = lag_step(fine, 20.0 + 0.1 * k, 20.1 + 0.1 * k, 1.0, 60.0)
    assert fine == pytest.approx(lag_step(20.0, 20.0, 30.0, 100.0, 60.0), abs=1e-9)
    assert lag_step(5.0, 6.0, 7.0, 1.0, 0.0) == 7.0
    assert lag_step(5.0, 6.0, 7.0, 0.0, 60.0) == 5.0


def test_an_open_probe_is_passed_over_and_an_old_reading_does_not_turn_the_lag_back(
    rig: Rig,
) -> None:
    slow, plain = (TemperatureHistory(lagged_sensors(rig)) for _ in range(2))
    for temperatures, open_at in ((slow, 5.0), (plain, None)):
        temperatures.add(reading("0", 0.0, 20.0))
        if open_at is not None:
            temperatures.add(reading("0", open_at, None))
        temperatures.add(reading("0", 10.0, 22.0))
        if open_at is not None:
            temperatures.add(reading("0", 3.0, 90.0))
    assert at(slow, 10.0)["0/SU00"] == at(plain, 10.0)["0/SU00"]


def test_the_lagged_temperature_places_the_sensor_and_no_other(rig: Rig) -> None:
    temperatures_c = {"0": 30.0, lagged_probe(rig.sensor("SU00")): 26.0}
    assert sensor_dc(rig.sensor("SU00"), temperatures_c) == 6.0
    assert sensor_dc(rig.sensor("SU01"), temperatures_c) == 10.0
    assert sensor_dc(rig.sensor("SU00"), {"0": 30.0}) == 10.0


def test_a_rig_without_lags_records_its_probes_only() -> None:
    assert lagged_sensors(find_rig("ultracam-x-mini")) == ()
    plain = TemperatureHistory()
    plain.add(reading("0", 0.0, 20.0))
    assert at(plain, 1.0) == {"0": 20.0}
