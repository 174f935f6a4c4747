"""Wrong and late data on the page: places far away, another mission, a computer that slept."""

from __future__ import annotations

import json
import math
import shutil
import time
from collections.abc import Iterator
from typing import Any

import pytest

from processing.rig import shipped_rigs
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.cockpit import LINES, MEASURES, Cockpit, lines, on_line
from tests.daemon.onboard.monitoring.guidance_frames import guidance_frame
from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.support.browser import Browser, chromium

FINDING = {"flag": "SIGMA0", "sentence": "Look.", "verdict": "refly"}
SCALE = "document.querySelector('.leaflet-control-scale-line').innerText"
MARK = "document.querySelector('.aircraft-mark svg')"


@pytest.fixture(scope="module")
def cockpit(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cockpit]:
    chromium()
    folder = tmp_path_factory.mktemp("wrong")
    for name in ("mission", "other"):
        (folder / name / "L0").mkdir(parents=True)
        shutil.copy(shipped_rigs()["ultracam-x-mini"], folder / name / "rig.toml")
        (folder / name / "service.toml").write_text("[plan]\nground_height_m = 395.0\n")
    (folder / "mission/plan.geojson").write_text(json.dumps(lines()))
    service = Service(folder)
    try:
        with Browser(folder / "profile", width=1280, height=800) as browser:
            cockpit = Cockpit(service, browser)
            cockpit.emit(flight_events.mission(str(folder / "mission")))
            cockpit.status("ready", missing=["no position (check the antenna of the receiver)"])
            browser.open(service.address)
            browser.wait_for("document.querySelector('#link')?.innerText === 'connected'", WITHIN_S)
            browser.evaluate(MEASURES.read_text())
            yield cockpit
    finally:
        service.end()


def exposure_at(number: int, **place: float) -> list[dict[str, Any]]:
    events = flight_events.exposure(number, line="A0", north_m=68.0 * number)
    for event in events:
        if event["event"] == "sealed":
            event["navigation"] = event["navigation"] | place
    return events


def test_what_keeps_a_flight_from_its_start_stands_first(cockpit: Cockpit) -> None:
    cockpit.until("document.querySelector('#missing').innerText.includes('no position')")
    cockpit.until("document.querySelector('#checklist li') !== null")
    top_px, checks_px = cockpit.browser.evaluate(
        "['#missing', '#checklist'].map((one) =>"
        " document.querySelector(one).getBoundingClientRect().top)"
    )
    assert top_px < checks_px


def test_exposures_at_wrong_places_leave_the_map_at_the_flight(cockpit: Cockpit) -> None:
    wrong: list[dict[str, float]] = [
        {"latitude_deg": math.nan},
        {"height_m": 1e300},
        {"latitude_deg": 0.0, "longitude_deg": 0.0},
        {"latitude_deg": 91.0, "longitude_deg": 1e9},
    ]
    cockpit.emit(*exposure_at(1))
    for number, place in enumerate(wrong, start=2):
        cockpit.emit(*exposure_at(number, **place))
    cockpit.emit(*exposure_at(6))
    cockpit.status("flying", triggers=6)
    cockpit.until("document.querySelector('#verdict .which').innerText.includes('6')")
    cockpit.until("import('/map.js').then((map) => map.footprintCount() === 3)")
    cockpit.until(f"/^\\d+ m$/.test({SCALE})")
    cockpit.until("document.querySelector('#link').innerText === 'connected'")


def test_the_newest_footprint_lies_below_the_tools_of_the_map(cockpit: Cockpit) -> None:
    bottom_px, top_px = cockpit.browser.evaluate(
        "[document.querySelector('#map-tools').getBoundingClientRect().bottom,"
        " Math.min(...[...document.querySelectorAll('#map path.leaflet-interactive')]"
        ".map((one) => one.getBoundingClientRect()).filter((one) => one.height > 1)"
        ".map((one) => one.top))]"
    )
    assert top_px > bottom_px


def test_the_map_is_fitted_again_when_guidance_takes_its_room(cockpit: Cockpit) -> None:
    cockpit.guide(on_line(0.00005))
    cockpit.until(
        "import('/map.js').then((map) => map.footprintLayers()"
        ".map((one) => one.getElement().getBoundingClientRect()).filter((one) => one.height > 1)"
        ".every((one) => one.bottom < document.querySelector('#map')"
        ".getBoundingClientRect().bottom - 15))"
    )


def test_the_mark_of_the_aircraft_shows_its_track_and_whether_it_is_old(cockpit: Cockpit) -> None:
    position = flight_events.status()["position"] | {"age_s": 0.1, "fix": "3d", "satellites": 9}
    # Guidance is newer than the status while it comes; then the service repeats its last frame.
    cockpit.until("document.querySelector('#guidance').classList.contains('stale')")
    time.sleep(1.6)
    for velocity, turned in (([0.0, 55.0, 0.0], "rotate(90)"), ([-40.0, 0.0, 1.0], "rotate(180)")):
        cockpit.status("flying", triggers=6, position=position | {"velocity_ned_mps": velocity})
        cockpit.until(f"{MARK}.querySelector('path').getAttribute('transform') === '{turned}'")
        assert cockpit.browser.evaluate(f"{MARK}.getAttribute('class')") == "present"
    cockpit.status("flying", triggers=6, position=position | {"age_s": 9.0})
    cockpit.until(f"{MARK}.getAttribute('class') === 'old'")
    # Without a velocity it has no direction.
    shown = f"getComputedStyle({MARK}.querySelector('path')).display"
    assert cockpit.browser.evaluate(shown) == "none"


def test_a_flight_without_a_position_has_a_warning(cockpit: Cockpit) -> None:
    place = {"latitude_deg": math.nan, "longitude_deg": math.nan, "age_s": 0.1, "fix": "3d"}
    cockpit.status("flying", triggers=6, position=place)
    cockpit.until("document.querySelector('#lamp-position').classList.contains('warning')")
    assert cockpit.browser.evaluate(f"{MARK}.getAttribute('class')") == "old"
    cockpit.status("ready", triggers=6, position=place)
    cockpit.until("document.querySelector('#lamp-position').classList.contains('off')")


def test_findings_that_come_later_are_shown_and_a_phone_shows_the_gravest(
    cockpit: Cockpit,
) -> None:
    report = {"verdict": "refly", "flags": [], "findings": [FINDING], "figures": {}}
    cockpit.emit({"event": "judged", "number": 6, "report": report})
    cockpit.until("document.querySelectorAll('#findings li').length === 1")
    later = [{"flag": "TILT", "sentence": "It leans.", "verdict": "usable"}, FINDING]
    cockpit.emit({"event": "judged", "number": 6, "report": report | {"findings": later}})
    cockpit.until("document.querySelectorAll('#findings li').length === 2")
    cockpit.resize(390, 844)
    seen = "[...document.querySelectorAll('#findings li')].filter((one) => one.checkVisibility())"
    texts = cockpit.browser.evaluate(f"{seen}.map((one) => one.innerText)")
    assert len(texts) == 1 and texts[0].endswith("Look.")
    cockpit.emit(*exposure_at(7))
    cockpit.until("document.querySelector('#verdict .which').innerText.includes('7')")
    assert cockpit.browser.evaluate(f"{seen}.length") == 0
    cockpit.resize(1280, 800)


def test_a_phone_has_the_verdict_in_view_on_every_page(cockpit: Cockpit) -> None:
    cockpit.resize(390, 844)
    chip = "document.querySelector('#verdict-chip')"
    for tab, is_seen in (("flight", True), ("alarms", True), ("map", False)):
        cockpit.browser.click(f"#tab-{tab}")
        assert cockpit.browser.evaluate(f"{chip}.checkVisibility()") is is_seen, tab
    assert cockpit.browser.evaluate(f"{chip}.textContent") == "● 7 good"
    assert "good" in cockpit.browser.evaluate(f"{chip}.className")
    found = cockpit.browser.evaluate("measures()")
    assert found["outside"] == [] and found["overlapping"] == []
    cockpit.resize(1280, 800)


def test_the_alarm_bar_counts_what_is_active_and_what_is_only_unseen(cockpit: Cockpit) -> None:
    cockpit.emit(*(flight_events.lost(f"SU{k:02d}") for k in range(5)))
    cockpit.emit(*(flight_events.recovered(f"SU{k:02d}") for k in range(2)))
    cockpit.until(
        "document.querySelector('#alarm-bar .further')?.innerText === '+2 more · 2 cleared'"
    )
    assert cockpit.browser.text("#tab-alarms .badge") == "3"


def test_what_was_shown_before_a_sleep_is_not_fresh_after_it(cockpit: Cockpit) -> None:
    cockpit.status("flying", triggers=7)
    cockpit.guide(on_line(0.00005))
    found = cockpit.browser.evaluate(
        """Promise.all(['/wake.js', '/time_of_day.js'].map((one) => import(one)))
          .then(async ([{ checkSleep }, { timeOfDay }]) => {
          const [real, Plain] = [Date.now, window.WebSocket];
          const isLost = () => document.body.classList.contains('connection-lost');
          // No connection opens until all of it was read.
          window.WebSocket = class { close() {} send() {} };
          checkSleep();
          const wasLost = isLost();
          Date.now = () => real() + 3723e3;
          checkSleep();
          Date.now = real;
          checkSleep();
          const sinceS = ['#connection-lost', '[data-fault="page page.link"]'].map((one) => {
            const [h, m, s] = /\\d+:\\d\\d:\\d\\d/.exec(document.querySelector(one).textContent)[0]
              .split(':').map(Number);
            return (timeOfDay() / 1000 - (3600 * h + 60 * m + s)) % 86400;
          });
          // Guidance shows its age four times a second.
          await new Promise((resolve) => setTimeout(resolve, 700));
          const guidance = document.querySelector('#guidance');
          const found = [sinceS, document.querySelector('.aircraft-mark svg').getAttribute('class'),
            wasLost, isLost(), document.title, guidance.querySelector('.age').innerText,
            guidance.classList.contains('lost')];
          window.WebSocket = Plain;
          return found;
        })"""
    )
    since_s, mark, was_lost, is_lost, title, age, is_guidance_lost = found
    assert mark == "old"
    # What was shown is of the last record, not of the wake-up.
    assert since_s[0] == since_s[1] and -1 <= since_s[0] < 10
    assert (was_lost, is_lost, is_guidance_lost) == (False, True, True)
    assert "CONNECTION LOST" in title and age == "1 h 02 old"
    cockpit.until("!document.body.classList.contains('connection-lost')")
    cockpit.until("!document.title.includes('CONNECTION LOST')")
    # Guidance connects again too, although its second connection never opened.
    cockpit.guide(on_line(0.00005))


def test_a_lost_link_that_was_acknowledged_gives_its_bar_to_the_next_alarm(
    cockpit: Cockpit,
) -> None:
    found = cockpit.browser.evaluate(
        """import('/feed.js').then(({ feed }) => {
          const shown = () => document.querySelector('#alarm-bar .what').innerText;
          feed.raiseAlarm({ code: 'page.link', severity: 'warning', params: { time: '' } });
          const before = shown();
          document.querySelector('#alarm-bar .acknowledge').click();
          const after = shown();
          feed.clearAlarm('page.link');
          return [before, after];
        })"""
    )
    assert "Connection lost" in found[0]
    assert "Connection lost" not in found[1] and "SU0" in found[1]


def test_the_gap_between_two_missions_clears_what_belongs_to_the_first(cockpit: Cockpit) -> None:
    """A mission that begins again in flight, on the same connection."""
    cockpit.emit({"event": "bound", "device": "SU00", "kind": "head", "found": {}})
    path = cockpit.browser.evaluate(
        "import('/telemetry.js').then(({ flight }) => flight.brief.mission.path)"
    )
    other = path.replace("/mission", "/other")
    cockpit.emit(flight_events.mission(other) | {"id": "20261122T080000Z-other"})
    cockpit.until("document.querySelectorAll('#strip .thumb').length === 0")
    cockpit.until("document.querySelector('#verdict .word').innerText === 'WAITING'")
    cockpit.until("import('/map.js').then((map) => map.footprintCount() === 0)")
    kept = cockpit.browser.evaluate(
        "import('/telemetry.js').then(({ flight }) => [flight.track.length, flight.devices.size])"
    )
    assert kept[0] == 0 and kept[1] >= 1
    # Numbers begin again, and the exposures are those of the other mission.
    cockpit.emit(*exposure_at(1))
    cockpit.until("document.querySelectorAll('#strip .thumb').length === 1")
    cockpit.until("document.querySelector('#verdict .which').innerText.includes('1')")


def test_the_newest_of_older_footprints_is_found_in_whatever_order_they_came(
    cockpit: Cockpit,
) -> None:
    found = cockpit.browser.evaluate(
        """import('/older_exposures.js').then(({ OlderExposures }) => {
          const older = new OlderExposures();
          const square = (y) => [[y, 0], [y, 1], [y + 1, 1], [y + 1, 0]];
          for (const number of [301, 302, 5, 7, 6]) older.add(number, 'good', square(47));
          older.add(8, 'good', square(0));
          return [older.numberAt(47.5, 0.5), older.numberAt(40, 0.5), older.bounds];
        })"""
    )
    assert found == [302, None, [47, 0, 48, 1]]


def test_exposures_in_any_order_are_shown_by_their_number(cockpit: Cockpit) -> None:
    for number in (4, 2, 5, 3):
        cockpit.emit(*exposure_at(number))
    strip = "[...document.querySelectorAll('#strip .thumb .t-mark')].map((one) => one.textContent)"
    cockpit.until(f"{strip}.length === 5")
    assert cockpit.browser.evaluate(strip) == [f"● {number}" for number in (5, 4, 3, 2, 1)]
    assert cockpit.browser.text("#verdict .which") == "exposure 5"
    assert cockpit.browser.evaluate("document.querySelector('#image-which').textContent") == "5"


def test_a_pilot_sees_no_instruction_from_before_a_sleep(cockpit: Cockpit) -> None:
    browser = cockpit.browser
    browser.open(f"{cockpit.service.address}pilot")
    cockpit.until("document.querySelector('#pilot-link')?.innerText === 'linked'")
    cockpit.emit(guidance_frame(LINES, 0.4, east_deg=0.0005))
    cockpit.until("document.querySelector('#pilot-alarm').innerText.includes('Steer')")
    found = browser.evaluate(
        """import('/wake.js').then(async ({ checkSleep }) => {
          const [real, Plain] = [Date.now, window.WebSocket];
          window.WebSocket = class { close() {} send() {} };
          checkSleep();
          Date.now = () => real() + 600e3;
          checkSleep();
          Date.now = real;
          checkSleep();
          await new Promise((resolve) => setTimeout(resolve, 700));
          window.WebSocket = Plain;
          return document.querySelector('#pilot-alarm').innerText;
        })"""
    )
    assert "No guidance" in found and "Steer" not in found
