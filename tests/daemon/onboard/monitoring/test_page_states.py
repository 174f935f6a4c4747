"""What the page shows of absent, lost and earlier values, and how it sounds, in a real browser."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from daemon.onboard.monitoring.web.page_files import PAGE
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.guidance_frames import guidance_frame
from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.support.browser import Browser, chromium

LINES = {"A1": [[15.43, 47.07], [15.43, 47.08]], "A2": [[15.434, 47.08], [15.434, 47.07]]}
SOUNDING = "document.body.dataset.sounding"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    chromium()
    folder = tmp_path_factory.mktemp("states")
    (folder / "mission/L0").mkdir(parents=True)
    feature = {
        "type": "Feature",
        "properties": {"id": "A1", "strip": "S"},
        "geometry": {"type": "LineString", "coordinates": LINES["A1"]},
    }
    plan = {"type": "FeatureCollection", "features": [feature]}
    (folder / "mission/plan.geojson").write_text(json.dumps(plan))
    (folder / "mission/service.toml").write_text("[plan]\nground_height_m = 395.0\n")
    from processing.rig import shipped_rigs

    rig = shipped_rigs()["ultracam-x-mini"].read_bytes()
    for name in ("mission", "other"):
        (folder / name / "L0").mkdir(parents=True, exist_ok=True)
        (folder / name / "rig.toml").write_bytes(rig)
    return folder


@pytest.fixture(scope="module")
def service(folder: Path) -> Iterator[Service]:
    service = Service(folder)
    service.emit(flight_events.mission(str(folder / "mission")))
    yield service
    service.end()


@pytest.fixture(scope="module")
def browser(folder: Path, service: Service) -> Iterator[Browser]:
    with Browser(folder / "profile") as browser:
        browser.open(service.address)
        browser.wait_for("document.querySelector('#link')?.innerText === 'connected'", WITHIN_S)
        yield browser


def device(name: str, what: str, *, fault: bool) -> dict[str, Any]:
    return flight_events.device_event(name, what, f"{name}: {what}.", fault=fault)


def test_an_absent_value_has_no_state_of_a_good_one(service: Service, browser: Browser) -> None:
    for event in flight_events.exposure(1, "good"):
        service.emit(event)
    service.emit(flight_events.status(triggers=1))
    rows = "[...document.querySelectorAll('#expert > div')]"
    browser.wait_for(f"{rows}.some((one) => one.innerText.includes('0.010 px'))", WITHIN_S)
    # Each value that is judged has its limit next to it.
    browser.wait_for(
        f"{rows}.some((one) => one.innerText.includes('Limit: at most 0.30 px.'))", WITHIN_S
    )
    assert browser.evaluate(f"{rows}.filter((one) => one.innerText.includes('Limit:')).length") >= 7
    dashes = f"{rows}.filter((one) => one.querySelector('dt').innerText.endsWith('–'))"
    # Neither saturation, tilt, overlap nor others are in the report of this exposure.
    assert browser.evaluate(f"{dashes}.length") >= 6
    assert browser.evaluate(f"{dashes}.every((one) => one.className === 'absent')")
    assert browser.evaluate(f"{rows}.some((one) => one.className === 'good')")


def test_a_silenced_alarm_stays_silent_until_its_cause_comes_back(
    service: Service, browser: Browser
) -> None:
    service.emit(device("SU01", "lost", fault=True))
    browser.wait_for(f"{SOUNDING} === 'warning'", WITHIN_S)
    browser.click("#silence")
    browser.wait_for(f"{SOUNDING} === ''", WITHIN_S)
    service.emit(device("SU01", "lost", fault=True))
    item = "document.querySelector('[data-fault=\"device SU01\"]')"
    browser.wait_for(f"{item}.innerText.includes('2 times')", WITHIN_S)
    assert browser.evaluate(SOUNDING) == ""
    service.emit(device("SU01", "recovered", fault=False))
    browser.wait_for(f"{item}.innerText.includes('cause is gone')", WITHIN_S)
    service.emit(device("SU01", "lost", fault=True))
    browser.wait_for(f"{SOUNDING} === 'warning'", WITHIN_S)
    service.emit(device("SU01", "recovered", fault=False))
    browser.wait_for(f"{SOUNDING} === ''", WITHIN_S)


def test_the_loss_of_the_link_sounds_and_clears_by_itself(
    service: Service, browser: Browser
) -> None:
    assert service.child.process.pid is not None
    os.kill(service.child.process.pid, signal.SIGSTOP)
    try:
        browser.wait_for(f"{SOUNDING} === 'warning'", WITHIN_S)
        assert "Connection lost" in browser.text("#alarm-bar .what")
        assert "Values are frozen" in browser.text("[data-fault='page page.link']")
    finally:
        os.kill(service.child.process.pid, signal.SIGCONT)
    browser.wait_for(f"{SOUNDING} === ''", WITHIN_S)
    browser.wait_for("document.querySelector('[data-fault=\"page page.link\"]') === null", WITHIN_S)


def test_a_measured_rate_excludes_the_work_of_the_service(browser: Browser) -> None:
    found = browser.evaluate(
        """(async () => {
          const real = window.fetch;
          const sleep = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
          let waitMs = 1;
          let bodyMs = 0;
          window.fetch = async () => {
            await sleep(waitMs);
            return new Response(new ReadableStream({async start(stream) {
              stream.enqueue(new Uint8Array(5000));
              await sleep(bodyMs);
              stream.enqueue(new Uint8Array(5000));
              stream.close();
            }}));
          };
          const { isSlow, thumbnailOf } = await import('/thumbnails.js');
          await thumbnailOf(1001);
          waitMs = 150;
          for (let k = 2; k < 18; k += 1) await thumbnailOf(1000 + k);
          const busy = isSlow();
          [waitMs, bodyMs] = [1, 500];
          for (let k = 18; k < 22; k += 1) await thumbnailOf(1000 + k);
          window.fetch = real;
          return [busy, isSlow()];
        })()"""
    )
    assert found == [False, True]


def test_thumbnails_are_fetched_a_few_at_a_time_the_newest_first_and_none_in_vain(
    browser: Browser,
) -> None:
    found = browser.evaluate(
        """(async () => {
          const real = window.fetch;
          const asked = [];
          const open = new Map();
          window.fetch = (address) => new Promise((resolve) => {
            const number = Number(/exposures\\/(\\d+)/.exec(address)[1]);
            asked.push(number);
            open.set(number, () => { open.delete(number); resolve(new Response('x')); });
          });
          const turn = async () => { for (let k = 0; k < 20; k += 1) await Promise.resolve();
            await new Promise((resolve) => setTimeout(resolve, 0)); };
          const { clearThumbnails, thumbnailOf } = await import('/thumbnails.js');
          clearThumbnails();
          const results = new Map();
          for (let k = 1; k <= 100; k += 1) thumbnailOf(k).then((one) => results.set(k, one));
          await turn();
          const atOnce = [...open.keys()];
          // Of 100 the newest 80 are kept; those before them are given up at once.
          const given = [...results].filter(([, one]) => one === null).map(([k]) => k);
          open.get(1)();
          await turn();
          const second = asked.at(-1);
          thumbnailOf(101);
          open.get(2)();
          await turn();
          const third = asked.at(-1);
          clearThumbnails();
          for (const done of [...open.values()]) done();
          await turn();
          window.fetch = real;
          return [atOnce, given, second, third, asked.length];
        })()"""
    )
    at_once, given, second, third, asked = found
    assert at_once == [1, 2, 3]
    assert given == list(range(4, 21))
    assert (second, third) == (100, 101)
    assert asked <= 6, "cleared ones are not asked for"


def test_the_suggested_exposure_of_pan_ignores_a_saturated_colour(browser: Browser) -> None:
    half, full = [0] * 31 + [900] + [0] * 32, [0] * 63 + [500]
    script = (
        "import('/checklist.js').then(({countsOfGroups, suggestedFactor}) => Object.fromEntries("
        f"Object.entries(countsOfGroups(['pan', 'R'], {json.dumps({'SU00': half, 'R': full})}))"
        ".map(([group, counts]) => [group, suggestedFactor(counts)])))"
    )
    assert browser.evaluate(script) == {"pan": pytest.approx(1.5), "R": 0.5}


def test_after_the_last_line_the_large_button_lands(service: Service, browser: Browser) -> None:
    button = "document.querySelector('#phase-button').innerText === '{}'"
    lines = {"flown": ["A1"], "current": None, "next": None}
    armed = flight_events.status("armed", triggers=1)
    service.emit(armed | {"lines": lines})
    browser.wait_for(button.format("Land"), WITHIN_S)
    assert browser.text("#phase-second") == "Start line"
    # Also where the lines of the plan were flown without a stop.
    flying = flight_events.status("flying", triggers=1)
    service.emit(flying | {"lines": lines | {"flown": [], "current": "A1"}})
    browser.wait_for(button.format("Stop line"), WITHIN_S)
    service.emit(flying | {"lines": lines})
    browser.wait_for(button.format("Land"), WITHIN_S)
    assert browser.text("#phase-second") == "Stop line"
    # Without a position nothing is next, although the line is left.
    service.emit(armed | {"lines": lines | {"flown": []}})
    browser.wait_for(button.format("Start line"), WITHIN_S)
    assert browser.text("#phase-second") == "Land"
    service.emit(armed | {"lines": lines})
    browser.wait_for(button.format("Land"), WITHIN_S)
    service.emit({"event": "retake", "line": "A1 R1", "of": "A1", "at": LINES["A1"], "number": 1})
    browser.wait_for(button.format("Start line"), WITHIN_S)


def test_the_age_of_the_verdict_is_that_of_its_record(service: Service, browser: Browser) -> None:
    """Also for a page that was opened later."""
    exposed = flight_events.exposure(2, "good")
    for event in exposed:
        service.emit(event | {"mono_ns": "5000000000"})
    service.emit(flight_events.status(triggers=2) | {"mono_ns": "45000000000"})
    age = "parseInt(document.querySelector('#verdict .since').innerText)"
    browser.wait_for(f"{age} >= 40", WITHIN_S)
    seen = browser.evaluate(age)
    browser.wait_for(f"{age} > {seen}", WITHIN_S)
    # Of a time before that of the verdict, as after another start of the computer, there is none.
    service.emit(flight_events.status(triggers=2))
    browser.wait_for("document.querySelector('#verdict .since').innerText === ''", WITHIN_S)


def test_a_new_mission_has_nothing_of_the_one_before(
    folder: Path, service: Service, browser: Browser
) -> None:
    service.emit(flight_events.status(triggers=1) | {"temperatures_c": {"0": -40.0}})
    service.emit({"event": "phase", "phase": "landed"})
    browser.wait_for("document.querySelectorAll('[data-file]').length === 4", WITHIN_S)
    assert browser.evaluate("document.querySelector('[data-summary=covered]') !== null")
    temperatures = "document.querySelector('[data-summary=temperatures]').innerText"
    assert "-40" in browser.evaluate(temperatures)
    service.emit(flight_events.mission(str(folder / "other")) | {"id": "20261122T080000Z-other"})
    service.emit(flight_events.status("idle", triggers=0))
    browser.wait_for("document.querySelector('#landing').hidden", WITHIN_S)
    service.emit({"event": "phase", "phase": "landed"})
    browser.wait_for("!document.querySelector('#landing').hidden", WITHIN_S)
    browser.wait_for("document.querySelector('#landing').innerText.includes('no plan')", WITHIN_S)
    assert browser.evaluate("document.querySelectorAll('[data-file]').length") == 0
    assert browser.evaluate("document.querySelector('[data-summary=covered]')") is None
    assert "-40" not in browser.evaluate(temperatures)


def test_in_a_fault_the_large_button_leads_to_the_alarms(
    service: Service, browser: Browser
) -> None:
    service.emit({"event": "fault", "mono_ns": "9", "sentence": "The writer ended."})
    browser.wait_for(
        "document.querySelector('#phase-button').innerText === 'Fault: see alarms'", WITHIN_S
    )
    browser.click("#phase-button")
    assert browser.evaluate("!document.querySelector('#page-alarms').hidden")
    assert "The writer ended." in browser.text("#faults")


def test_a_pilot_signs_in_where_reading_requires_a_token(browser: Browser, tmp_path: Path) -> None:
    closed = Service(tmp_path, anonymous_read=False)
    try:
        closed.emit(flight_events.mission())
        browser.open(f"{closed.address}pilot")
        browser.wait_for("document.querySelector('#ask-token')?.open", WITHIN_S)
        browser.evaluate(f"document.querySelector('#token').value = {json.dumps(closed.token)}")
        browser.click("#ask-token button[value=use]")
        browser.wait_for("document.querySelector('#pilot-link').innerText === 'linked'", WITHIN_S)
        closed.emit(guidance_frame(LINES, 0.3, east_deg=0.0005))
        browser.wait_for(
            "document.querySelector('#pilot-cells [data-key=line]') !== null", WITHIN_S
        )
        browser.wait_for(
            "document.querySelector('#pilot-alarm').innerText.includes('Steer left')", WITHIN_S
        )
        assert browser.evaluate(SOUNDING) == "warning"
        # After 5 s without guidance its instruction is no longer shown.
        browser.wait_for("document.querySelector('#pilot').classList.contains('lost')", WITHIN_S)
        browser.wait_for(
            "document.querySelector('#pilot-alarm').innerText.includes('No guidance')", WITHIN_S
        )
        assert "Steer" not in browser.text("#pilot-alarm")
        assert browser.evaluate(SOUNDING) == "caution"
    finally:
        closed.end()


WORKER = """
(async () => {
  const sleep = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
  const kept = new Map([['/', 'old page'], ['/page.js', 'old script']]);
  const pathOf = (request) => new URL(request.url).pathname;
  const store = {put: async (request, answer) => kept.set(pathOf(request), await answer.text())};
  const caches = {open: async () => store,
    match: async (request) => kept.has(pathOf(request)) ? new Response(kept.get(pathOf(request)))
      : undefined};
  const link = {stepMs: 0, isUp: true};
  const fetch = async (request, {signal}) => {
    if (!link.isUp) throw new TypeError('no network');
    return new Response(new ReadableStream({async start(stream) {
      signal.addEventListener('abort', () => stream.error(signal.reason));
      for (const part of ['new', ' ', 'file', '!']) {
        await sleep(link.stepMs);
        if (signal.aborted) return;
        stream.enqueue(new TextEncoder().encode(part));
      }
      stream.close();
    }}));
  };
  const handlers = {};
  const self = {location: {host: 'camera'},
    addEventListener: (kind, handler) => { handlers[kind] = handler; }};
  const location = {origin: 'http://camera', host: 'camera'};
  new Function('self', 'caches', 'fetch', 'location', SOURCE)(self, caches, fetch, location);
  const get = async (path, mode, client) => {
    let answer;
    handlers.fetch({request: {url: `http://camera${path}`, method: 'GET', mode}, clientId: client,
      resultingClientId: client, respondWith: (promise) => { answer = promise; }});
    return (await answer).text();
  };
  const found = {};
  // Each part comes in time, all of them together take longer than any limit.
  await get('/', 'navigate', 'a');
  link.stepMs = 120;
  found.slow = await get('/page.js', 'no-cors', 'a');
  // A page from the store has its files from there, although the network is back.
  kept.set('/page.js', 'old script');
  [link.stepMs, link.isUp] = [0, false];
  await get('/', 'navigate', 'b');
  link.isUp = true;
  found.stored = await get('/page.js', 'no-cors', 'b');
  found.fresh = await get('/page.js', 'no-cors', 'a');
  // Without a network and a stored page, one opens that tries again.
  kept.clear();
  link.isUp = false;
  found.waiting = (await get('/pilot', 'navigate', 'c')).includes('http-equiv="refresh"');
  return found;
})()
"""


def test_the_files_of_a_page_are_of_one_version_over_a_slow_link(
    browser: Browser, tmp_path: Path
) -> None:
    source = (PAGE / "worker.js").read_text("utf-8")
    for limit in ("4000", "15000"):
        assert f"_MS = {limit};" in source
        source = source.replace(f"_MS = {limit};", "_MS = 300;")
    browser.open("about:blank")
    browser.wait_for("location.href === 'about:blank'", WITHIN_S)
    found = browser.evaluate(WORKER.replace("SOURCE", json.dumps(source)))
    assert found == {
        "slow": "new file!",
        "stored": "old script",
        "fresh": "new file!",
        "waiting": True,
    }
