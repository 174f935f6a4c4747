"""The page of a long flight: old exposures stay on the map at little memory."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest

from daemon.onboard.monitoring import flight_state
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.telemetry import PAST_BYTES
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.cockpit import picture_of
from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.support.browser import Browser, chromium

OLDER = """(async () => {{
  const {{ OlderExposures }} = await import('/older_exposures.js');
  const older = new OlderExposures();
  const step = 2 ** -12;
  const square = (k) => [[k * step, 0], [k * step, 1], [(k + 1) * step, 1], [(k + 1) * step, 0]];
  for (let k = 0; k < 9000; k += 1) older.add(k + 1, k % 2 ? 'good' : 'refly', square(k));
  older.add(7, 'lost', square(6));
  older.add(90000, 'good', null);
  return {};
}})()"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Service, Browser]]:
    chromium()
    folder = tmp_path_factory.mktemp("long")
    mission = folder / "mission"
    (mission / "L0").mkdir(parents=True)
    from processing.rig import shipped_rigs

    (mission / "rig.toml").write_bytes(shipped_rigs()["ultracam-x-mini"].read_bytes())
    (mission / "service.toml").write_text("[plan]\nground_height_m = 395.0\n")
    service = Service(folder)
    service.emit(flight_events.mission(str(mission)))
    with Browser(folder / "profile") as browser:
        browser.open(service.address)
        browser.wait_for("document.querySelector('#link')?.innerText === 'connected'", WITHIN_S)
        yield service, browser
    service.end()


def emit_patiently(service: Service, event: dict[str, object]) -> None:
    from daemon.onboard.service.messages import ServiceEvent

    service.until(lambda: service.child.try_send(ServiceEvent(event)))


def test_older_exposures_are_drawn_and_found_and_the_rest_is_dropped(
    page: tuple[Service, Browser],
) -> None:
    service, browser = page
    for number in range(1, 341):
        for event in flight_events.exposure(number, "good", north_m=60.0 * number):
            emit_patiently(service, event)
    emit_patiently(service, flight_events.status(triggers=340))
    shown = "import('/map.js').then((map) => map.footprintCount())"
    browser.wait_for(f"{shown}.then((count) => count === 340)", WITHIN_S)
    whole = browser.evaluate("import('/telemetry.js').then(({ flight }) => flight.exposures.size)")
    assert whole == 300
    assert (
        browser.evaluate("document.querySelectorAll('#map path.leaflet-interactive').length") < 310
    )
    # The page gives a request up after some seconds; a busy machine may need longer.
    browser.wait_for("import('/telemetry.js').then(({ restore }) => restore(5))", WITHIN_S)
    found = browser.evaluate(
        "import('/telemetry.js').then(async ({ flight, restore }) => [flight.older.verdictAt(0),"
        " flight.exposures.get(5).number, await restore(4711)])"
    )
    assert found == ["good", 5, False]


def test_footprints_do_not_keep_what_was_removed_alive(page: tuple[Service, Browser]) -> None:
    """A group of layers, even one that is never shown, is kept by each of its layers."""
    _, browser = page
    parents = browser.evaluate(
        "import('/map.js').then((map) => Math.max(...map.footprintLayers()"
        ".map((one) => Object.keys(one._eventParents || {}).length)))"
    )
    assert parents == 0


def test_an_answer_that_is_not_read_is_released(page: tuple[Service, Browser]) -> None:
    """Chromium keeps the request of each body that is neither read nor cancelled."""
    _, browser = page
    found = browser.evaluate(
        """(async () => {
          const { fetchOk, isRefused } = await import('/http.js');
          const real = window.fetch;
          const answers = [];
          window.fetch = async (...given) => {
            answers.push(await real(...given));
            return answers.at(-1);
          };
          try {
            await fetchOk('/api/v1/images/4711');
            await isRefused();
          } finally {
            window.fetch = real;
          }
          // The page itself asks meanwhile, for other things.
          const of = (part) => answers.filter(({ url }) => url.includes(part));
          const own = [...of('images/4711'), ...of('brief').slice(-1)];
          return own.map((one) => [one.status, one.bodyUsed]);
        })()"""
    )
    # A page that asked for many thumbnails is refused for a while (429).
    assert len(found) == 2 and all(is_released for _, is_released in found)


def test_a_page_opened_late_shows_the_newest_first_and_all_footprints(
    page: tuple[Service, Browser],
) -> None:
    service, browser = page
    browser.call(
        "Page.addScriptToEvaluateOnNewDocument",
        source="""
        window.records = [];
        const Plain = window.WebSocket;
        window.WebSocket = class extends Plain {
          constructor(...given) {
            super(...given);
            if (!String(given[0]).includes('/telemetry')) return;
            this.addEventListener('message', ({data}) => window.records.push(data));
          }
        };""",
    )
    browser.open(service.address)
    # This page asked for many pictures that do not exist: its requests may be refused for a while.
    browser.wait_for("document.body?.dataset.ready !== undefined", WITHIN_S)
    shown = "import('/map.js').then((map) => map.footprintCount())"
    browser.wait_for(f"{shown}.then((count) => count === 340)", WITHIN_S)
    browser.wait_for(
        "import('/telemetry.js').then(({ flight }) => flight.exposures.size === 300)", WITHIN_S
    )
    first, largest, events = browser.evaluate(
        "[JSON.parse(records[0]).exposures.map((one) => one.number),"
        " Math.max(...records.map((one) => one.length)),"
        " records.some((one) => 'events' in JSON.parse(one))]"
    )
    assert first[0] == 340 and first == sorted(first, reverse=True) and len(first) < 300
    assert largest < 3 * PAST_BYTES
    assert not events
    history = (
        "import('/telemetry.js').then(({ flight }) => flight.history.map((one) => one.number))"
    )
    browser.wait_for(f"{history}.then((numbers) => numbers.at(-1) === 340)", WITHIN_S)
    track = browser.evaluate(history)
    assert track == sorted(track) and track[-1] == 340


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        ("older.size", 9000),
        ("older.verdictAt(6)", "lost"),
        (
            "[0.5, 8999.5].map((k) => older.numberAt(k * step, 0.5))"
            ".concat(older.numberAt(5 * step, 2))",
            [1, 9000, None],
        ),
        ("older.bounds", [0, 0, 9000 / 4096, 1]),
    ],
)
def test_numbers_of_older_exposures_are_packed(
    page: tuple[Service, Browser], expression: str, expected: object
) -> None:
    assert page[1].evaluate(OLDER.format(expression)) == expected


def test_rows_of_a_table_stay_where_nothing_changed(page: tuple[Service, Browser]) -> None:
    found = page[1].evaluate(
        """import('/dom.js').then(({ element, updateRows }) => {
          const body = document.createElement('tbody');
          let made = 0;
          const draw = (...items) => {
            made = 0;
            updateRows(body, items.map(([number, text]) => ({ number, text })), (one) => one.text,
              ({ number, text }) => {
                made += 1;
                return element('tr', { textContent: `${number}${text}` });
              });
            return [[...body.children].map((one) => one.textContent).join(' '), made];
          };
          return [draw([3, 'a'], [2, 'a'], [1, 'a']), draw([4, 'a'], [3, 'b'], [2, 'a']),
            draw([2, 'a'], [4, 'a'], [3, 'c'], [1, 'z']),
            draw([1, 'z'], [2, 'b'], [4, 'b'], [3, 'c']),
            draw([1, 'z'], [2, 'b'], [4, 'b'], [3, 'c']), draw([9, 'x']), draw()];
        })"""
    )
    assert found == [
        ["3a 2a 1a", 3],
        ["4a 3b 2a", 2],
        ["2a 4a 3c 1z", 2],
        ["1z 2b 4b 3c", 2],
        ["1z 2b 4b 3c", 0],
        ["9x", 1],
        ["", 0],
    ]


def test_parts_without_data_lie_where_the_pixels_would(page: tuple[Service, Browser]) -> None:
    """Row 0 is the top of the image; corners are lower left, lower right and so on."""
    footprint = [[10.0, 0.0], [10.0, 8.0], [14.0, 8.0], [14.0, 0.0]]  # latitude, longitude
    area = {"columns": 8, "rows": 4, "gaps": {"pan": [[6, 0, 8, 1]], "red": [[0, 3, 1, 4]]}}
    rings = page[1].evaluate(
        "import('/map_no_data.js').then(({noDataRings}) => ["
        f"noDataRings({json.dumps(footprint)}, {json.dumps(area)}),"
        f"noDataRings({json.dumps(footprint)}, {{share: 0.9, rings: []}}),"
        f"noDataRings(null, {json.dumps(area)}), noDataRings({json.dumps(footprint)}, undefined)])"
    )
    top_right = [[14, 6], [14, 8], [13, 8], [13, 6]]
    lower_left = [[11, 0], [11, 1], [10, 1], [10, 0]]
    assert rings == [[top_right, lower_left], [], [], []]


def test_exposures_beyond_the_snapshot_keep_footprint_and_verdict(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(flight_state, "EXPOSURES_MAX", 3)
    monkeypatch.setattr(flight_state, "FOOTPRINTS_MAX", 4)
    state = FlightState("syntopic test", lambda _: [[47.0, 15.0]] * 4)
    for number in range(1, 9):
        for event in flight_events.exposure(number, "refly" if number == 4 else "good"):
            state.apply(event)
    assert [one["number"] for one in state.exposures()] == [6, 7, 8]
    dropped = state.older_footprints()
    assert [one["number"] for one in dropped] == [2, 3, 4, 5]
    assert dropped[2] == {"number": 4, "verdict": "refly", "footprint": [[47.0, 15.0]] * 4}
    assert [one["number"] for one in state.older_footprints(newest=1)] == [2, 3, 4, 5, 6, 7]
    found = state.exposure(4)
    assert found is not None and (found["step"], found["verdict"]) == ("processed", "refly")
    assert state.exposure(1) is None
    assert state.brief()["verdicts"] == {"good": 7, "usable": 0, "refly": 1}


def test_what_the_page_holds_does_not_grow_with_the_flight(tmp_path: Path) -> None:
    """From 400 to 1,200 exposures, replayed by the page to itself; eight of them are gaps."""
    chromium()
    picture = base64.b64encode(cv2.imencode(".jpg", picture_of(1))[1].tobytes()).decode()
    plan = {"lines": [{"id": "A0", "at": [[47.07, 15.43], [47.1, 15.43]], "places_m": [0.0]}]}
    replay = {"plan": plan, "thumbnail": picture, "quicklook": picture}
    script = Path(__file__).with_name("replayed_flight.js").read_text()
    service = Service(tmp_path)
    held = (
        "import('/map.js').then((map) => [map.footprintCount(), map.planShown().areas,"
        " document.querySelectorAll('#map *').length, document.querySelectorAll('#rows tr').length,"
        " document.querySelectorAll('#segments tr').length])"
    )
    try:
        with Browser(tmp_path / "profile") as browser:
            browser.call(
                "Page.addScriptToEvaluateOnNewDocument",
                source=f"window.replay = {json.dumps(replay)};\n{script}",
            )
            browser.open(service.address)
            browser.wait_for("document.body?.dataset.ready !== undefined", WITHIN_S)
            found = []
            for number, gaps in ((400, 4), (1200, 12)):
                assert browser.evaluate(f"replayTo({number}, 80)") == number
                shown = f"{held}.then(([, areas]) => areas === {gaps})"
                browser.wait_for(shown, WITHIN_S)
                browser.wait_for(
                    "document.querySelectorAll('#map .placed').length === 60", WITHIN_S
                )
                found.append(browser.evaluate(held))
    finally:
        service.end()
    assert [one[:2] for one in found] == [[400, 4], [1200, 12]]
    (elements, rows, segments), (elements_of_many, rows_of_many, segments_of_many) = (
        one[2:] for one in found
    )
    # Parts of tiles, tooltips and the like come and go.
    assert elements_of_many <= elements + 5
    assert (rows, rows_of_many) == (30, 30), "the table is not in view"
    assert (segments, segments_of_many) == (4, 12)
