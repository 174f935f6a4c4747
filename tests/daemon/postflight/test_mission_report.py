"""The report draws what the records say: time with its budget, and the sheet by head."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

from daemon.mission.exposure import navigation_from_json
from daemon.mission.layout import Mission
from daemon.mission.store.store import Level0Writer
from daemon.onboard.flight.ledger import Ledger
from daemon.postflight.mission_report import write_report
from tests.daemon.onboard.monitoring.flight_events import NAVIGATION
from tests.daemon.small_camera import SENSORS, final_record, new_mission, store_one


def test_the_report_shows_what_a_time_is_unsure_by_and_the_ledger_of_every_head(
    tmp_path: Path,
) -> None:
    mission = new_mission(tmp_path)
    writer = Level0Writer(mission)
    stored = store_one(writer, 1)
    record = final_record(stored)
    budget = {"clock": 900, "trigger": 24_000, "delay": 1_000, "head": 1_500}
    frames = tuple(replace(frame, time_sigma_ns=24_084) for frame in record.frames)
    record = replace(record, mark_gps_ns=(2445 * 604_800 + 345_600) * 10**9 + 250_000_000)
    record = replace(record, mark_source="pps", time_budget_ns=budget, frames=frames)
    writer.seal(record)
    writer.close()
    ledger = Ledger(SENSORS)
    ledger.trigger(1)
    ledger.frame(SENSORS[0], "duplicate")
    page = write_report(mission.path, ledger=ledger.sheet().as_json()).path.read_text()
    cells = re.findall(r"<td>(.*?)</td>", page.split("<h2>Time</h2>")[1].split("</table>")[0])
    assert cells == ["1", "pps", "24084", "–", "900", "24000", "1000", "1500", "–"]
    instant = re.search(r"<td>week 2445, 345600.250000000 s</td><td>([^<]*)</td>", page)
    assert instant is not None
    assert instant[1] == "2026-11-18 23:59:42.250"
    assert re.search(rf"<tr><td>{SENSORS[0]}</td><td>1</td><td>0</td><td>0</td><td>1</td>", page)


def test_the_report_advises_on_each_flag_of_the_flight(tmp_path: Path) -> None:
    mission = new_mission(tmp_path)
    writer = Level0Writer(mission)
    for number, flags in ((1, ["TILT"]), (2, ["TILT", "BLUR"])):
        writer.seal(final_record(store_one(writer, number)))
        folder = mission.path / f"L2/{number:06d}"
        folder.mkdir(parents=True, exist_ok=True)
        report = {"verdict": "usable", "flags": flags, "findings": [], "figures": {}}
        (folder / "quality.json").write_text(json.dumps(report))
    writer.close()
    page = write_report(mission.path).path.read_text()
    advice = page.split("<h2>What to do</h2>")[1].split("</table>")[0]
    rows = re.findall(r"<tr><td>(\w+)</td><td>(\d)</td>", advice)
    assert rows == [("TILT", "2"), ("BLUR", "1")]
    assert "Fly straight and level" in advice


def flown_and_placed(tmp_path: Path, verdicts: list[str]) -> Mission:
    """A mission of exposures to the north, 100 m apart."""
    mission = new_mission(tmp_path)
    writer = Level0Writer(mission)
    for number, verdict in enumerate(verdicts, start=1):
        north = NAVIGATION | {"latitude_deg": 47.07 + 0.0009 * number}
        record = final_record(store_one(writer, number))
        writer.seal(replace(record, navigation=navigation_from_json(north)))
        folder = mission.path / f"L2/{number:06d}"
        folder.mkdir(parents=True, exist_ok=True)
        report = {"verdict": verdict, "flags": [], "findings": [], "figures": {}}
        (folder / "quality.json").write_text(json.dumps(report))
    writer.close()
    return mission


def test_the_report_draws_footprints_with_verdicts_without_a_plan(tmp_path: Path) -> None:
    mission = flown_and_placed(tmp_path, ["good", "usable", "refly"])
    page = write_report(mission.path).path.read_text()
    drawing = page.split("<h2>Map</h2>")[1].split("</svg>")[0]
    found = re.findall(r'<polygon class="(\w+)" points="([^"]+)"><title>(\d): \w+</title>', drawing)
    assert [(verdict, number) for verdict, _, number in found] == [
        ("good", "1"),
        ("usable", "2"),
        ("refly", "3"),
    ]
    # North is up: the later exposures lie above the earlier ones.
    tops = [float(points.split()[0].split(",")[1]) for _, points, _ in found]
    assert tops == sorted(tops, reverse=True)
    assert "m, north is up" in drawing


def test_the_map_of_a_flight_without_gaps_is_drawn_with_its_lines(tmp_path: Path) -> None:
    mission = flown_and_placed(tmp_path, ["good", "good"])
    line = {"type": "LineString", "coordinates": [[15.43, 47.07], [15.43, 47.073]]}
    feature = {"type": "Feature", "properties": {"id": "A<1"}, "geometry": line}
    plan = {"type": "FeatureCollection", "features": [feature]}
    (mission.path / "plan.geojson").write_text(json.dumps(plan))
    page = write_report(mission.path).path.read_text()
    drawing = page.split("<h2>Map</h2>")[1].split("</svg>")[0]
    assert drawing.count('class="line"') == 1
    assert "A&lt;1" in drawing
    assert drawing.count("<title>") == 2
    # The images of the small camera see 5 m of the line: the rest is drawn as to be flown again.
    assert 'class="again"' in drawing and 'class="hole"' in drawing


def test_exposures_without_a_position_are_named_and_an_empty_map_is_not_drawn(
    tmp_path: Path,
) -> None:
    mission = new_mission(tmp_path)
    writer = Level0Writer(mission)
    writer.seal(replace(final_record(store_one(writer, 1)), navigation=None))
    writer.close()
    assert "<h2>Map</h2>" not in write_report(mission.path).path.read_text()
    line = {"type": "LineString", "coordinates": [[15.43, 47.07], [15.43, 47.073]]}
    feature = {"type": "Feature", "properties": {"id": "A1"}, "geometry": line}
    plan = {"type": "FeatureCollection", "features": [feature]}
    (mission.path / "plan.geojson").write_text(json.dumps(plan))
    assert "Without a footprint: 1." in write_report(mission.path).path.read_text()
