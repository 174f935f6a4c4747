"""The map of the report shows the flown track, and the parts of images without data."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from daemon.mission.exposure import navigation_from_json
from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import FlightLog
from daemon.mission.log.log_records import message_of
from daemon.mission.store.store import Level0Writer
from daemon.planning.flown_track import flown_track
from daemon.postflight.mission_report import write_report
from drivers.contract import NavSample
from tests.daemon.onboard.flight.test_flight import nav
from tests.daemon.onboard.monitoring.flight_events import NAVIGATION
from tests.daemon.small_camera import final_record, new_mission, store_one
from tests.support.browser import Browser, chromium

Points = list[tuple[float, float]]
QUARTER = {"columns": 40, "rows": 26, "gaps": {"pan": [[30, 0, 40, 26]], "red": [[30, 0, 40, 26]]}}
"""The right quarter is without data, in both bands."""


def sample(second: float, receiver: str = "gnss", **further: object) -> NavSample:
    """The aircraft flies north at 55 m/s."""
    values: dict[str, Any] = {"receiver": receiver, "mono_ns": round(1e9 * (1000 + second))}
    values |= {"latitude_deg": 47.07 + 55.0 * second / 111_180, "longitude_deg": 15.43}
    return replace(nav(second), **(values | {"fix": "3d"} | further))


def flown(tmp_path: Path, samples: list[NavSample], area: dict[str, object]) -> Mission:
    """A mission of two exposures, the second with the valid area, and its log."""
    mission = new_mission(tmp_path)
    writer = Level0Writer(mission)
    for number in (1, 2):
        north = NAVIGATION | {"latitude_deg": 47.07 + 0.00005 * number}
        record = final_record(store_one(writer, number))
        writer.seal(replace(record, navigation=navigation_from_json(north)))
        folder = mission.path / f"L2/{number:06d}"
        folder.mkdir(parents=True, exist_ok=True)
        report = {"verdict": "good", "flags": [], "findings": [], "figures": {}}
        if number == 2:
            report["valid_area"] = area
        (folder / "quality.json").write_text(json.dumps(report))
    writer.close()
    log = FlightLog.create(mission.log_dir)
    for one in samples:
        log.write(message_of(one))
    log.close()
    return mission


def drawn(page: str, kind: str) -> list[Points]:
    drawing = page.split("<h2>Map</h2>")[1].split("</svg>")[0]
    found = re.findall(rf'class="{kind}" points="([^"]+)"', drawing)
    return [[(float(x), float(y)) for x, y in (p.split(",") for p in one.split())] for one in found]


def test_the_track_is_of_one_point_a_second_and_interrupted_without_a_position(
    tmp_path: Path,
) -> None:
    samples = [sample(0.1 * k) for k in range(100)]
    samples += [sample(10.0 + k, fix="none", latitude_deg=None) for k in range(10)]
    samples += [sample(20.0), sample(21.0, latitude_deg=147.0), sample(22.0)]
    samples += [sample(30.0, receiver="spare"), sample(31.0, receiver="spare")]
    mission = flown(tmp_path, samples, {})
    track = flown_track(mission)
    assert [len(part) for part in track] == [10, 2]
    north = [point.latitude_deg for part in track for point in part]
    expected = [*range(10), 20, 22]
    assert north == pytest.approx([47.07 + 55.0 * s / 111_180 for s in expected], abs=1e-9)


def test_the_report_draws_track_and_parts_without_data(tmp_path: Path) -> None:
    mission = flown(tmp_path, [sample(0.2 * k) for k in range(10)], dict(QUARTER))
    page = write_report(mission.path).path.read_text()
    assert len(drawn(page, "track")) == 1
    # North is up.
    ys = [y for _, y in drawn(page, "track")[0]]
    assert ys == sorted(ys, reverse=True) and ys[0] > ys[-1]
    # One ring, although the same part is without data in two bands:
    # it covers the right quarter of exposure 2.
    (ring,) = drawn(page, "no-data")
    left_rear, right_rear, right_front, left_front = drawn(page, "good")[1]

    def between(a: tuple[float, float], b: tuple[float, float]) -> tuple[float, float]:
        return a[0] + 0.75 * (b[0] - a[0]), a[1] + 0.75 * (b[1] - a[1])

    expected = [between(left_front, right_front), right_front, right_rear]
    expected.append(between(left_rear, right_rear))
    for found, place in zip(ring, expected, strict=True):
        assert found == pytest.approx(place, abs=0.11)
    assert "(none recorded)" not in page


def test_a_flight_without_navigation_and_gaps_has_neither(tmp_path: Path) -> None:
    page = write_report(flown(tmp_path, [], {}).path).path.read_text()
    assert drawn(page, "track") == drawn(page, "no-data") == []
    assert "flown track (none recorded)" in page


def test_the_hatch_is_painted_in_a_browser(tmp_path: Path) -> None:
    chromium()
    mission = flown(tmp_path, [sample(0.2 * k) for k in range(10)], dict(QUARTER))
    report = write_report(mission.path).path
    with Browser(tmp_path / "profile", width=1280, height=1000) as browser:
        browser.open(report.as_uri())
        browser.wait_for("document.querySelector('.flight-map .no-data') !== null", 30)
        fill, stroke, box = browser.evaluate(
            "(() => { const one = document.querySelector('.flight-map .no-data');"
            " const style = getComputedStyle(one); one.scrollIntoView({ block: 'center' });"
            " return [style.fill, getComputedStyle(document.querySelector('.track')).stroke,"
            " one.getBoundingClientRect().width]; })()"
        )
        assert "#no-data-hatch" in fill
        assert stroke == "rgb(119, 119, 119)"
        assert box > 20.0
        browser.picture(tmp_path / "report.png")
