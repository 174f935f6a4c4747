"""Exposures fall due by time or way, and every cone fires when it is over the same place."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from daemon.onboard.flight.trigger_policies import DistanceTrigger, IntervalTrigger, pulse_delays_ns
from daemon.orientation.geodesy import metres_per_degree
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
    blind = replace(nav(0.0, 0), latitude_deg=None, longitude_deg=None)
    trigger = DistanceTrigger(200.0, NS)
    assert trigger.due(7, None, blind) is None
    trigger.fired(0, None)
    trigger.fired(0, blind)
    # Nothing is known of where the last exposure was: the next one is due at once.
    assert trigger.due(7, 0, nav(0.0, 0)) == 7


def test_a_distance_falls_due_from_1_m_per_s_on() -> None:
    trigger = DistanceTrigger(200.0, NS)
    trigger.fired(0, nav(0.0, 0))
    assert trigger.due(9, None, nav(0.0, 0)) == 9
    assert trigger.due(1, 0, nav(0.0, 0, speed_mps=0.999)) is None
    assert trigger.due(1, 0, nav(0.0, 0, speed_mps=1.0)) == 200 * NS
    assert trigger.due(1, 0, replace(nav(0.0, 0), velocity_ned_mps=None)) is None


def test_the_way_to_the_east_counts_by_the_length_of_a_degree_there() -> None:
    """From an exposure 2 s after the last position to one 0.02 degrees further east."""
    velocity = (30.0, 40.0, -3.0)
    trigger = DistanceTrigger(1000.0, NS)
    trigger.fired(2 * NS, replace(nav(0.0, 0), velocity_ned_mps=velocity))
    _, metres_per_degree_east = metres_per_degree(48.0, 0.0)
    there = replace(
        nav(0.0, 10 * NS),
        latitude_deg=48.0 + 60.0 / metres_per_degree(48.0, 0.0)[0],
        longitude_deg=11.01,
        velocity_ned_mps=velocity,
    )
    east_m = 0.01 * metres_per_degree_east - 80.0
    expected_ns = 10 * NS + (1000.0 - east_m) / 50.0 * NS
    assert trigger.due(0, 2 * NS, there) == pytest.approx(expected_ns, abs=2e5)


def test_without_velocity_an_exposure_was_where_the_last_position_is() -> None:
    trigger = DistanceTrigger(100.0, NS)
    trigger.fired(5 * NS, replace(nav(0.0, 0), velocity_ned_mps=None))
    assert trigger.due(0, 5 * NS, nav(0.0, 6 * NS)) == 8 * NS


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


def test_a_synchronous_rig_exposes_at_one_instant_at_any_speed() -> None:
    rig = replace(find_rig("ultracam-x-mini"), timing="synchronous")
    exposure_ns = {cone.name: 4_000_001 if cone.role == "pan" else 6_000_000 for cone in rig.cones}
    for speed_mps in (0.0, 70.0):
        delays_ns = pulse_delays_ns(rig, speed_mps, exposure_ns)
        assert {delays_ns[c.name] + exposure_ns[c.name] // 2 for c in rig.cones} == {3_000_000}


def test_syntopic_exposure_without_motion_is_refused() -> None:
    rig = find_rig("ultracam-x")
    with pytest.raises(ValueError, match="motion"):
        pulse_delays_ns(rig, 0.0, {cone.name: 0 for cone in rig.cones})
