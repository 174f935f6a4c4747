"""Exposures fall due by time or way, and every cone fires when it is over the same place."""

from __future__ import annotations

import math

import pytest

from daemon.flight.triggering import DistanceTrigger, IntervalTrigger, pulse_delays_ns
from drivers.contract import NavSample
from processing.rig import find_rig

NS = 1_000_000_000


def nav(north_m: float, mono_ns: int, speed_mps: float = 50.0) -> NavSample:
    latitude = 48.0 + math.degrees(north_m / 6_371_000.0)
    velocity = (speed_mps, 0.0, 0.0)
    return NavSample(
        "gnss", 0, mono_ns, "3d", 9, latitude, 11.0, 500.0, 1, 1, velocity, 0.1,
        None, None, None, 18, True,
    )  # fmt: skip


def test_an_interval_counts_from_the_previous_exposure() -> None:
    trigger = IntervalTrigger(2 * NS)
    assert trigger.due(5, None, None) == 5
    assert trigger.due(6, 5, None) == 5 + 2 * NS


def test_a_distance_is_predicted_from_position_and_speed() -> None:
    trigger = DistanceTrigger(200.0, NS)
    trigger.fired(0, nav(0.0, 0))
    due_ns = trigger.due(NS, 0, nav(50.0, NS))
    assert due_ns == pytest.approx(4 * NS, rel=1e-3)


def test_a_distance_is_never_flown_faster_than_the_camera_can() -> None:
    trigger = DistanceTrigger(10.0, NS)
    trigger.fired(0, nav(0.0, 0))
    assert trigger.due(1, 0, nav(9.9, 1)) == NS


def test_without_a_position_no_distance_falls_due() -> None:
    assert DistanceTrigger(200.0, NS).due(0, None, None) is None


def test_the_foremost_cone_fires_first_and_all_are_over_one_place_in_mid_exposure() -> None:
    rig = find_rig("ultracam-x")
    exposure_ns = {cone.name: 4_000_000 if cone.role == "pan" else 6_000_000 for cone in rig.cones}
    delays_ns = pulse_delays_ns(rig, 70.0, exposure_ns)
    assert min(delays_ns.values()) == 0
    assert delays_ns["1"] < delays_ns["0"] < delays_ns["2"] < delays_ns["3"]
    places_m = {
        cone.name: cone.position_mm[0] * 1e-3
        + 70.0 * (delays_ns[cone.name] + exposure_ns[cone.name] / 2) / NS
        for cone in rig.cones
    }
    assert max(places_m.values()) - min(places_m.values()) < 1e-6


def test_syntopic_exposure_without_motion_is_refused() -> None:
    rig = find_rig("ultracam-x")
    with pytest.raises(ValueError, match="motion"):
        pulse_delays_ns(rig, 0.0, {cone.name: 0 for cone in rig.cones})
