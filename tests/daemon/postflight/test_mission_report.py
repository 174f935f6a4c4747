"""The report draws what the records say: time with its budget, and the sheet by head."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

from daemon.mission.store.store import Level0Writer
from daemon.onboard.flight.ledger import Ledger
from daemon.postflight.mission_report import write_report
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
