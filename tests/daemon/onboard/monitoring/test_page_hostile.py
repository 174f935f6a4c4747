"""Hostile input to the page: no figures, long names and tables, clocks that jump, the date line."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator
from typing import Any

import pytest

from daemon.onboard.monitoring.flight_state import FlightState
from processing.rig import shipped_rigs
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.cockpit import FAULTS, MEASURES, SIZES, Cockpit
from tests.daemon.onboard.monitoring.guidance_frames import guidance_frame
from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.support.browser import Browser, chromium

LONG = "Vermessungsflug-Sankt-Johann-im-Pongau-Ost-Wiederholung-nach-Wolken-2026-11-28"
DATE_LINE_DEG = 179.99
LINES = {
    f"{LONG}-{k}": [[179.99, 47.07 + 0.003 * k], [-179.97, 47.07 + 0.003 * k]] for k in range(3)
}


def plan() -> dict[str, Any]:
    features = [
        {
            "type": "Feature",
            "properties": {"id": name, "strip": "S"},
            "geometry": {"type": "LineString", "coordinates": ends},
        }
        for name, ends in LINES.items()
    ]
    return {"type": "FeatureCollection", "features": features}


def exposure(number: int, east_m: float) -> list[dict[str, Any]]:
    """Eastward across the date line, with figures that are none."""
    longitude_deg = DATE_LINE_DEG + east_m / 75_900
    here = {"longitude_deg": (longitude_deg + 180) % 360 - 180, "heading_rad": math.pi / 2}
    events = flight_events.exposure(number, line=next(iter(LINES)))
    for event in events:
        if event["event"] == "sealed":
            event["navigation"] |= here
        if event["event"] == "processed":
            event["report"]["figures"] = {"sigma0_px": math.nan, "saturated_fraction": math.inf}
    return events


@pytest.fixture(scope="module")
def cockpit(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cockpit]:
    chromium()
    folder = tmp_path_factory.mktemp("hostile")
    mission = folder / "mission"
    (mission / "L0").mkdir(parents=True)
    shutil.copy(shipped_rigs()["ultracam-x-mini"], mission / "rig.toml")
    (mission / "plan.geojson").write_text(json.dumps(plan()))
    (mission / "service.toml").write_text("[plan]\nground_height_m = 395.0\n")
    service = Service(folder)
    try:
        with Browser(folder / "profile", width=1280, height=800) as browser:
            cockpit = Cockpit(service, browser)
            cockpit.emit(flight_events.mission(str(mission)) | {"id": LONG, "rig": LONG})
            # No head at all.
            cockpit.emit({"event": "bound", "device": "gnss", "kind": "navigator", "found": {}})
            for number in range(1, 25):
                cockpit.emit(*exposure(number, 70.0 * number))
            state = flight_events.status("flying", 24, 0)
            place = {"latitude_deg": 47.07, "longitude_deg": -179.99, "height_m": -12.5}
            lines = dict(zip(("current", "next"), LINES, strict=False))
            further = {"clock_sigma_ns": math.nan, "temperatures_c": {"0": math.inf}}
            cockpit.emit(state | {"position": place, "lines": {"flown": [], **lines}} | further)
            browser.open(service.address)
            browser.wait_for("document.querySelector('#link')?.innerText === 'connected'", WITHIN_S)
            cockpit.until("document.querySelector('#triggers').innerText === '24'")
            yield cockpit
    finally:
        service.end()


def test_a_figure_that_is_none_is_absent_from_the_state() -> None:
    state = FlightState("syntopic test")
    for event in exposure(1, 0.0):
        state.apply(event)
    state.apply(flight_events.status() | {"clock_sigma_ns": math.nan})
    sent = json.dumps([state.brief(), state.exposures()], allow_nan=False)
    assert '"sigma0_px": null' in sent and '"clock_sigma_ns": null' in sent


def test_no_figure_that_is_none_stops_the_page(cockpit: Cockpit) -> None:
    shown = "document.querySelector('#expert').innerText"
    cockpit.until(f"{shown}.includes('σ0')")
    text = cockpit.browser.evaluate(shown)
    assert not any(word in text for word in ("NaN", "Infinity", "null", "undefined"))
    assert cockpit.browser.text("#lamp-heads .value") == "–"


def test_a_flight_across_the_date_line_is_one_piece_on_the_map(cockpit: Cockpit) -> None:
    cockpit.until("import('/map.js').then((map) => map.footprintCount() === 24)")
    west, east, track = cockpit.browser.evaluate(
        "import('/telemetry.js').then(({ flight }) => {"
        " const all = [...flight.exposures.values()].flatMap((one) => one.footprint)"
        ".map(([, longitude]) => longitude);"
        " return [Math.min(...all), Math.max(...all), flight.track.at(-1).at[1]]; })"
    )
    assert west < track < east < west + 0.05
    assert east - DATE_LINE_DEG - 24 * 70 / 75_900 == pytest.approx(-360, abs=0.01)
    cockpit.until("import('/map.js').then((map) => map.planShown().line.length > 0)")
    # The view holds the flight, not the world.
    cockpit.until(
        "Number.parseInt(document.querySelector('.leaflet-control-scale-line').innerText)"
        " > 0 && !document.querySelector('.leaflet-control-scale-line').innerText"
        ".includes('000 km')"
    )


def test_long_names_leave_the_lamps_and_values_their_room(cockpit: Cockpit) -> None:
    frame = guidance_frame({"A0": [[0, 0], [0, 1]], "A1": [[1, 0], [1, 1]]}, 0.4, east_deg=0.0)
    first, second = list(LINES)[:2]
    named = json.dumps(frame).replace('"A0"', f'"{first}"').replace('"A1"', f'"{second}"')
    cockpit.emit(json.loads(named))
    cockpit.until("document.querySelector('#guidance [data-key=line]') !== null")
    cockpit.browser.evaluate(MEASURES.read_text())
    for width, height in SIZES:
        cockpit.resize(width, height)
        found = cockpit.browser.evaluate("measures()")
        # A name is cut with an ellipsis, and its title holds it whole.
        cut = [one for one in found["clipped"] if LONG not in one]
        assert not any(found[fault] for fault in FAULTS if fault != "clipped"), (width, found)
        assert not found["scrolls"] and cut == [], (width, cut)
    assert cockpit.browser.evaluate("document.querySelector('#aircraft').title") == LONG
    assert LONG in cockpit.browser.evaluate(
        "document.querySelector('#guidance [data-key=line] .g-value').title"
    )
    cockpit.resize(1280, 800)


def test_a_long_table_holds_the_rows_that_are_seen(cockpit: Cockpit) -> None:
    cockpit.browser.click("#tab-lines")
    found = cockpit.browser.evaluate(
        """import('/visible_rows.js').then(async ({ VisibleRows }) => {
          const frame = () => new Promise(requestAnimationFrame);
          const frames = async () => { await frame(); await frame(); };
          const box = document.createElement('div');
          Object.assign(box, { className: 'scroll', tabIndex: 0 });
          const table = document.createElement('table');
          const head = document.createElement('thead');
          head.append(document.createElement('tr'));
          const body = document.createElement('tbody');
          table.append(head, body);
          box.append(table);
          document.querySelector('#reflights').append(box);
          const rows = new VisibleRows(body, (one) => one.text, (one) => {
            const [row, cell, button] = ['tr', 'td', 'button']
              .map((name) => document.createElement(name));
            button.textContent = one.text;
            cell.style.whiteSpace = 'pre';
            cell.append(button, one.number % 3 ? '' : '\\n\\n');
            row.append(cell);
            return row;
          });
          rows.set(Array.from({ length: 3000 }, (_, k) => ({ number: k, text: `row ${k}` })));
          const state = () => [body.children.length, body.firstChild.textContent.trim(),
            body.lastChild.textContent.trim(), body.firstChild.getAttribute('aria-rowindex')];
          const before = state();
          const heightPx = table.offsetHeight;
          body.querySelector('button').focus();
          box.scrollTop = 1e9;
          await frames();
          await frames();
          const after = state();
          const hasFocus = document.activeElement === box;
          // With the Tab key the focus comes to a row at the margin, which brings the next ones.
          body.children[4].querySelector('button').focus();
          await frames();
          const next = state();
          const isStill = document.activeElement.textContent;
          rows.set([]);
          const count = table.getAttribute('aria-rowcount');
          box.remove();
          return { before, heightPx, after, hasFocus, next, isStill, count };
        })"""
    )
    number, first, last, index = found["before"]
    assert number < 40 and (first, index) == ("row 0", "2")
    assert found["heightPx"] > 3000 * 48
    number, first, last, index = found["after"]
    assert number < 60 and last == "row 2999"
    assert int(index) == int(first.removeprefix("row ")) + 2
    assert found["hasFocus"]
    assert int(found["next"][3]) < int(index), "rows before the focused one are there"
    assert found["isStill"] == f"row {int(index) - 2 + 4}"
    assert found["count"] == "1"


def test_gaps_and_labels_cost_no_elements_and_do_not_cover_each_other(cockpit: Cockpit) -> None:
    found = cockpit.browser.evaluate(
        """import('/map.js').then((map) => {
          const at = (k) => [[47.07 + 1e-6 * k, -180], [47.07 + 1e-6 * k, -179.99]];
          const gap = (k) => ({ kind: 'hole', line: `L${k}`, at: at(k),
            holes: [{ rings: [[...at(k), [47.074, -180]]] }] });
          const counts = [];
          for (const length of [1, 3000]) {
            map.drawGaps(Array.from({ length }, (_, k) => gap(k)));
            const { areas, gap: labels } = map.planShown();
            counts.push([document.querySelectorAll('*').length, areas, labels.length]);
          }
          map.drawGaps([]);
          return counts;
        })"""
    )
    (elements, areas, labels), (elements_of_many, areas_of_many, labels_of_many) = found
    assert elements_of_many == elements
    assert (areas, labels, areas_of_many) == (1, 1, 3000)
    assert 1 <= labels_of_many < 60


def test_panels_share_one_request_of_the_advice(cockpit: Cockpit) -> None:
    found = cockpit.browser.evaluate(
        """Promise.all(['/advice.js', '/telemetry.js'].map((name) => import(name))).then(
          async ([{ fetchAdvice }, { flight }]) => {
          const real = window.fetch;
          const answers = [];
          window.fetch = (address, { signal }) => new Promise((resolve, reject) => {
            signal.addEventListener('abort', () => reject(signal.reason));
            answers.push((text) => resolve(new Response(text)));
          });
          const turn = () => new Promise((resolve) => setTimeout(resolve, 0));
          try {
            const asked = [fetchAdvice(), fetchAdvice(), fetchAdvice()];
            await turn();
            const atOnce = answers.length;
            answers.shift()('{"segments": [1]}');
            const first = await asked[0];
            await turn();
            answers.shift()('{"segments": [1]}');
            const [second, third] = [await asked[1], await asked[2]];
            const old = fetchAdvice();
            await turn();
            flight.brief.mission = { ...flight.brief.mission, id: 'another' };
            const other = fetchAdvice();
            const given = await old;
            await turn();
            answers.pop()('{"segments": [2]}');
            const isSame = first === second && second === third;
            return { atOnce, isSame, given, other: (await other).segments };
          } finally {
            window.fetch = real;
          }
        })"""
    )
    assert found == {"atOnce": 1, "isSame": True, "given": None, "other": [2]}


def test_what_is_read_once_is_asked_for_again_until_it_comes(cockpit: Cockpit) -> None:
    """A link that is lost for a moment must not cost the base maps or the plan of a flight."""
    found = cockpit.browser.evaluate(
        """import('/http.js').then(async ({ fetchPatiently }) => {
          const [realFetch, realTimeout] = [window.fetch, window.setTimeout];
          let asked = 0;
          window.fetch = async () => {
            asked += 1;
            if (asked === 1) throw new TypeError('no network');
            return new Response(asked === 2 ? '' : '[1]', { status: asked === 2 ? 429 : 200 });
          };
          window.setTimeout = (action) => realTimeout(action, 0);
          try {
            const came = [await fetchPatiently('/api/v1/maps'), asked];
            asked = 0;
            return [came, await fetchPatiently('/api/v1/maps', () => asked === 0), asked];
          } finally {
            [window.fetch, window.setTimeout] = [realFetch, realTimeout];
          }
        })"""
    )
    assert found == [[[1], 3], None, 1]


def test_an_unreadable_record_ends_the_connection_that_brought_it(cockpit: Cockpit) -> None:
    """Values would otherwise be frozen on a link that looks live."""
    cockpit.browser.call(
        "Page.addScriptToEvaluateOnNewDocument",
        source="""
        const Plain = window.WebSocket;
        window.opened = 0;
        window.WebSocket = class extends Plain {
          set onmessage(handler) {
            const isFirst = this.url.includes('/telemetry') && ++window.opened === 1;
            super.onmessage = (message) => handler(isFirst ? { data: '{"phase": NaN}' } : message);
          }
        };""",
    )
    cockpit.browser.open(cockpit.service.address)
    cockpit.until("window.opened === 2")
    cockpit.until("document.querySelector('#link')?.innerText === 'connected'")


def test_a_clock_that_is_set_back_holds_no_alarm_and_shows_the_time_of_the_receiver(
    cockpit: Cockpit,
) -> None:
    found = cockpit.browser.evaluate(
        """Promise.all(['/time_of_day.js', '/alarms.js', '/feed.js'].map((one) => import(one)))
          .then(([{ noteTime, timeOfDay }, { listAlarms }, { feed }]) => {
          const aheadS = Math.round(Date.now() / 1000) + 7 * 3600;
          noteTime(aheadS);
          const differsS = Math.abs(timeOfDay() / 1000 - aheadS);
          noteTime(null);
          const isKept = Math.abs(timeOfDay() / 1000 - aheadS) < 5;
          noteTime(Date.now() / 1000 + 1);
          const isOwn = Math.abs(timeOfDay() - Date.now()) < 5;
          feed.raiseAlarm({ code: 'page.link', severity: 'warning', params: { time: '' } });
          const shelve = document.querySelector('[data-fault="page page.link"] .shelve');
          shelve.click();
          const untilOf = () => listAlarms(feed)
            .find((one) => one.id === 'page page.link').untilMs !== null;
          const isShelved = untilOf();
          const real = Date.now;
          Date.now = () => real() - 7 * 3600e3;
          feed.drawAlarms();
          const isShelvedAfter = untilOf();
          Date.now = real;
          feed.clearAlarm('page.link');
          return { differsS, isKept, isOwn, isShelved, isShelvedAfter };
        })"""
    )
    assert found.pop("differsS") < 5
    assert found == {"isKept": True, "isOwn": True, "isShelved": True, "isShelvedAfter": False}


def test_a_gap_names_the_retakes_that_repeat_its_middle(cockpit: Cockpit) -> None:
    found = cockpit.browser.evaluate(
        """import('/plan.js').then(({ retakesOf }) => {
          const retake = (line, of, from, to) => ({ line, of, at: [[47, from], [47, to]] });
          const plan = { lines: [{ id: 'A', at: [[47, 0], [47, 10]] }], retakes: [
            retake('A R1', 'A', 3, 6), retake('A R2', 'A', 8, 4.9), retake('A R3', 'A', 5.1, 9),
            retake('B R1', 'B', 3, 6)] };
          const gap = (line) => ({ line, at: [[47, 4], [47, 6]] });
          return [retakesOf(gap('A'), plan), retakesOf(gap('B'), plan), retakesOf(gap('A'), null)];
        })"""
    )
    assert found == [["A R1", "A R2"], [], []]


def test_an_alarm_marks_the_title_of_the_tab_until_it_is_seen(cockpit: Cockpit) -> None:
    cockpit.emit(flight_events.lost("gnss"))
    cockpit.until("document.title.startsWith('✖ ')")
    cockpit.emit(flight_events.recovered("gnss"))
    cockpit.until("!/[✖▲]/.test(document.title)")


def test_footprints_of_a_long_flight_are_good_to_centimetres(cockpit: Cockpit) -> None:
    worst_deg, size, number = cockpit.browser.evaluate(
        """import('/older_exposures.js').then(({ OlderExposures }) => {
          const older = new OlderExposures();
          const at = (k, corner) => 3e-4 * k + 1e-3 * corner;
          const footprint = (k) => [0, 1, 2, 3].map((corner) =>
            [47.123456 + at(k, corner >> 1), 190.654321 + at(k, corner % 2)]);
          for (let k = 0; k < 5000; k += 1) older.add(k + 1, 'good', footprint(k));
          let worst = 0;
          for (let k = 0; k < 5000; k += 1) {
            for (const [corner, [y, x]] of footprint(k).entries()) {
              const [latitude, longitude] = older.cornerAt(k, corner);
              worst = Math.max(worst, Math.abs(latitude - y), Math.abs(longitude - x));
            }
          }
          const inside = footprint(4321)[0].map((one) => one + 1e-4);
          return [worst, older.size, older.numberAt(...inside)];
        })"""
    )
    assert worst_deg * 111_000 < 0.03
    assert (size, number) == (5000, 4322)


def test_longitudes_stay_next_to_the_first_one(cockpit: Cockpit) -> None:
    found = cockpit.browser.evaluate(
        "import('/longitudes.js?alone').then(({ near, nearPlaces }) => ["
        "near(null), near(15.43), near(16), near(-170), near(-100), "
        "nearPlaces([[47, 15.43 + 360]]), nearPlaces(null)])"
    )
    assert found == [None, 15.43, 16, 190, -100, [[47, pytest.approx(15.43)]], None]
