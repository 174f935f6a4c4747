"""A line is flown as planned, waits for what is missing, and stops for a full disk."""

from __future__ import annotations

import asyncio
import copy
import json
from pathlib import Path

import pytest

from daemon.onboard.flight.flight import Flight
from daemon.onboard.flight.ledger import Ledger
from daemon.onboard.preflight.service_file import from_mapping
from daemon.onboard.service.flight_line import FlightLine, Order
from tests.daemon.configuration.test_configuration import GOOD
from tests.daemon.onboard.flight.test_flight import IDENTITY, LIMITS, nav


def make_line(tmp_path: Path, *, count: int, flown: int = 0, reserve: int = 0) -> FlightLine:
    content = copy.deepcopy(GOOD)
    content["trigger"] |= {"count": count, "interval_s": 0.01}
    content["limits"] = {"disk_reserve_bytes": reserve}
    configuration, rig = from_mapping(content, tmp_path / "service.toml")
    flight = Flight(rig, {"SU00": ""}, IDENTITY, LIMITS, Ledger(heads=["SU00"]), flown + 1)
    flight.take(nav(0.0))
    plan = next(iter(tmp_path.glob("plan.*")), None)
    return FlightLine(configuration, rig, flight, tmp_path, flown, plan=plan)


def fly(line: FlightLine) -> tuple[list[Order], list[str]]:
    orders: list[Order] = []
    reported: list[str] = []

    def report(sentence: str) -> None:
        reported.append(sentence)
        raise TimeoutError

    async def run() -> None:
        async with asyncio.timeout(20):
            await line.fly(orders.append, report)

    try:
        asyncio.run(run())
    except TimeoutError:
        assert reported
    return orders, reported


def test_the_planned_number_is_flown_no_faster_than_the_camera_can(tmp_path: Path) -> None:
    orders, _ = fly(make_line(tmp_path, count=2))
    assert [order.number for order in orders] == [1, 2]
    assert orders[1].mono_ns - orders[0].mono_ns >= 1_350_000_000
    assert orders[0].delays_ns["1"] < orders[0].delays_ns["0"]


def test_a_resumed_line_flies_only_what_is_left(tmp_path: Path) -> None:
    orders, _ = fly(make_line(tmp_path, count=3, flown=2))
    assert [order.number for order in orders] == [3]


def test_a_full_disk_orders_nothing_and_states_the_action(tmp_path: Path) -> None:
    orders, reported = fly(make_line(tmp_path, count=2, reserve=1 << 60))
    assert not orders
    assert "free" in reported[0]


def test_exposures_carry_the_ids_of_the_planned_line_and_its_strip(tmp_path: Path) -> None:
    """The position of the test moves along 11 degrees east; the plan's line is there, or not."""
    here = {"type": "LineString", "coordinates": [[11.0, 47.9], [11.0, 48.1]]}
    elsewhere = {"type": "LineString", "coordinates": [[12.0, 47.9], [12.0, 48.1]]}
    for geometry, expected in ((here, ("A7", "S2")), (elsewhere, ("", ""))):
        mission = tmp_path / str(geometry is here)
        mission.mkdir()
        feature = {
            "type": "Feature",
            "properties": {"id": "A7", "strip": "S2"},
            "geometry": geometry,
        }
        plan = {"type": "FeatureCollection", "features": [feature]}
        (mission / "plan.geojson").write_text(json.dumps(plan))
        line = make_line(mission, count=1)
        line.order(nav(0.0).mono_ns)
        opened = line._flight._open[1]
        assert (opened.line_id, opened.strip_id) == expected


def test_a_position_counts_for_its_own_instant_once_the_clock_knows_it(tmp_path: Path) -> None:
    line = make_line(tmp_path, count=1)
    sample = nav(1.0)
    line._flight.take(sample)
    placed = line.position()
    assert placed is not None
    # Messages alone do not reveal their delay.
    assert placed.mono_ns == sample.mono_ns
    clock = line._flight.clock
    for second in range(-3, 1):
        clock.pps_edge(second * 1_000_000_000, 1_000)
    line._flight.take(nav(1.2))
    placed = line.position()
    assert placed is not None
    assert placed.mono_ns == pytest.approx(1_200_000_000, abs=100_000)
    assert line.position() is placed
