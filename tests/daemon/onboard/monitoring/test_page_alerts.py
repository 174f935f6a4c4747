"""Vibration, shelving over its time, the lock of the screen, and units, on the operator's page."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from processing.rig import shipped_rigs
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.cockpit import LINES, MEASURES, Cockpit, lines
from tests.daemon.onboard.monitoring.guidance_frames import guidance_frame
from tests.daemon.onboard.monitoring.page_service import Service
from tests.support.browser import Browser, chromium

STUBS = """
// Vibrations are noted, the screen lock is counted, and the clocks can be set ahead together.
window.vibrated = [];
navigator.vibrate = (pattern) => { window.vibrated.push([].concat(pattern).join()); return true; };
window.locks = { requested: 0, released: 0, present: null };
Object.defineProperty(navigator, 'wakeLock', { configurable: true, value: {
  request: async (kind) => {
    const lock = new EventTarget();
    lock.release = async () => {
      window.locks.released += 1;
      lock.dispatchEvent(new Event("release"));
    };
    window.locks.requested += 1;
    window.locks.kind = kind;
    window.locks.present = lock;
    return lock;
  } } });
window.aheadMs = 0;
const [wall, monotonic] = [Date.now.bind(Date), performance.now.bind(performance)];
Date.now = () => wall() + window.aheadMs;
performance.now = () => monotonic() + window.aheadMs;
"""
REFRESH = "import('/feed.js').then(({ feed }) => { feed.refresh(); return true; })"
CAUTION, WARNING = "200,150,200", "300,100,300,100,300"


@pytest.fixture
def cockpit(tmp_path: Path) -> Iterator[Cockpit]:
    chromium()
    mission = tmp_path / "mission"
    (mission / "L0").mkdir(parents=True)
    (mission / "rig.toml").write_bytes(shipped_rigs()["ultracam-x-mini"].read_bytes())
    (mission / "plan.geojson").write_text(json.dumps(lines()))
    (mission / "service.toml").write_text("[plan]\nground_height_m = 395.0\n")
    service = Service(tmp_path, hosts=("camera.test",))
    flags = ("--host-resolver-rules=MAP camera.test 127.0.0.1",)
    try:
        with Browser(tmp_path / "profile", width=1280, height=800, flags=flags) as browser:
            cockpit = Cockpit(service, browser)
            cockpit.emit(flight_events.mission(str(mission)))
            cockpit.status("ready")
            browser.call("Page.addScriptToEvaluateOnNewDocument", source=STUBS)
            open_page(cockpit, service.address)
            yield cockpit
    finally:
        service.end()


def open_page(cockpit: Cockpit, address: str) -> None:
    cockpit.browser.open(address)
    cockpit.until("document.querySelector('#link')?.innerText === 'connected'")
    cockpit.browser.evaluate(MEASURES.read_text())
    cockpit.browser.evaluate(
        f"sessionStorage.setItem('token', {json.dumps(cockpit.service.token)})"
    )


def vibrations(cockpit: Cockpit) -> list[str]:
    return list(cockpit.browser.evaluate(f"{REFRESH}.then(() => window.vibrated)"))


def clock_fault(name: str) -> dict[str, Any]:
    """A fault of the clock, which stands until it is withdrawn."""
    return flight_events.device_event("clock", name, "Look.", fault=True)


def test_a_phone_vibrates_for_the_two_upper_severities_only(cockpit: Cockpit) -> None:
    cockpit.emit(clock_fault("ptp-silent"))
    cockpit.until("document.body.dataset.sounding === 'caution'")
    assert vibrations(cockpit) == [], "a browser vibrates after the first touch only"
    cockpit.touch("#tab-alarms")
    # By its clock: the pattern of a caution repeats every 15 s.
    cockpit.browser.evaluate("window.aheadMs += 15000")
    assert vibrations(cockpit) == [CAUTION]
    assert vibrations(cockpit) == [CAUTION], "not with each record"
    cockpit.emit(flight_events.lost("SU03"))
    cockpit.until("document.body.dataset.sounding === 'warning'")
    assert vibrations(cockpit) == [CAUTION, WARNING], "at once: it became more severe"
    cockpit.browser.evaluate("window.aheadMs += 4000")
    assert vibrations(cockpit) == [CAUTION, WARNING, WARNING]


def test_an_info_neither_sounds_nor_vibrates(cockpit: Cockpit) -> None:
    cockpit.touch("#tab-alarms")
    cockpit.emit(clock_fault("searching"))
    cockpit.until("document.querySelector('#faults li.active.info') !== null")
    for _ in range(3):
        cockpit.browser.evaluate("window.aheadMs += 20000")
        assert vibrations(cockpit) == []
    assert cockpit.browser.evaluate("document.body.dataset.sounding") == ""


def test_an_alarm_returns_when_the_time_of_shelving_has_passed(cockpit: Cockpit) -> None:
    browser = cockpit.browser
    cockpit.touch("#tab-alarms")
    cockpit.emit(flight_events.lost("SU03"))
    cockpit.until("document.body.dataset.sounding === 'warning'")
    cockpit.touch("#faults .shelve")
    cockpit.until("document.querySelector('#alarm-bar').hidden")
    assert browser.evaluate("document.body.dataset.sounding") == ""
    before = len(vibrations(cockpit))
    browser.evaluate("window.aheadMs += 290000")
    assert len(vibrations(cockpit)) == before, "shelved for five minutes"
    assert browser.evaluate("document.querySelector('#alarm-bar').hidden")
    assert "shelved until" in browser.text("#faults")
    browser.evaluate("window.aheadMs += 11000")
    assert vibrations(cockpit)[before:] == [WARNING]
    assert not browser.evaluate("document.querySelector('#alarm-bar').hidden")
    assert browser.evaluate("document.body.dataset.sounding") == "warning"
    assert "shelved until" not in browser.text("#faults")
    assert browser.evaluate("sessionStorage.getItem('shelved')") == "[]"


def test_the_screen_stays_on_while_armed_or_flying(cockpit: Cockpit) -> None:
    browser = cockpit.browser
    cockpit.until("document.querySelector('#wake').textContent.includes('while armed or flying')")
    assert browser.evaluate("window.locks.requested") == 0
    cockpit.status("armed")
    cockpit.until("document.querySelector('#wake').textContent === 'The screen stays on.'")
    assert browser.evaluate("[window.locks.requested, window.locks.kind]") == [1, "screen"]
    cockpit.status("flying")
    cockpit.until("document.querySelector('#phase').innerText === 'flying'")
    assert browser.evaluate("window.locks.requested") == 1, "one lock is enough"
    # A browser takes the lock of a page that is not seen; it is requested again.
    browser.evaluate("window.locks.present.dispatchEvent(new Event('release'))")
    cockpit.status("flying", triggers=1)
    cockpit.until("window.locks.requested === 2")
    assert browser.evaluate("window.locks.released") == 0
    cockpit.emit({"event": "phase", "phase": "landed"})
    cockpit.status("landed", triggers=1)
    cockpit.until("window.locks.released === 1")
    cockpit.until("document.querySelector('#wake').textContent.includes('while armed or flying')")
    assert browser.evaluate("window.locks.requested") == 2


def test_without_tls_the_page_states_that_the_screen_may_turn_off(cockpit: Cockpit) -> None:
    """By a name that is not localhost: there a browser gives no lock without TLS."""
    port = cockpit.service.address.rstrip("/").rpartition(":")[2]
    open_page(cockpit, f"http://camera.test:{port}/")
    assert not cockpit.browser.evaluate("isSecureContext")
    cockpit.status("armed")
    cockpit.until("document.querySelector('#phase').innerText === 'armed'")
    assert "needs TLS" in cockpit.browser.evaluate("document.querySelector('#wake').textContent")
    assert cockpit.browser.evaluate("window.locks.requested") == 0


def test_each_unit_can_be_chosen_and_is_kept(cockpit: Cockpit) -> None:
    browser = cockpit.browser
    cockpit.status("flying", triggers=1)
    cockpit.until("document.querySelector('#speed').textContent === '107 kn'")
    cockpit.until("document.querySelector('#left-lines dd').innerText.includes('km')")
    # 38 m to the right of the line and 55 m below the planned height.
    cockpit.service.emit(guidance_frame(LINES, 0.4, east_deg=0.0005, height_m=1340.0))
    cockpit.until("document.querySelector('#guidance [data-key=height]') !== null")
    left_km = number_of(cockpit, "#left-lines small")
    assert guidance(cockpit) == {"across": "38 m", "height": "−55 m", "speed": "107 kn"}
    for kind, unit in (("height", "ft"), ("speed", "m/s"), ("distance", "NM")):
        chosen = browser.evaluate(
            "(() => { for (const one of document.querySelectorAll('#settings select'))"
            f" if ([...one.options].some((option) => option.value === '{unit}')) {{"
            f" one.value = '{unit}'; one.dispatchEvent(new Event('change')); return one.value; }}"
            " return null; })()"
        )
        assert chosen == unit, kind
    cockpit.service.emit(guidance_frame(LINES, 0.4, east_deg=0.0005, height_m=1340.0))
    cockpit.until("document.querySelector('#guidance [data-key=height]').innerText.includes('ft')")
    assert guidance(cockpit) == {"across": "125 ft", "height": "−180 ft", "speed": "55.0 m/s"}
    assert browser.text("#speed") == "55.0 m/s"
    assert browser.text("#left-lines small").endswith(" NM")
    assert number_of(cockpit, "#left-lines small") == pytest.approx(left_km / 1.852, abs=0.06)
    browser.evaluate(
        "import('/format.js').then((format) => format.setUnit('speed', 'km/h'))"
        ".then(() => import('/feed.js')).then(({ feed }) => feed.refresh())"
    )
    cockpit.until("document.querySelector('#speed').textContent === '198 km/h'")
    open_page(cockpit, cockpit.service.address)
    cockpit.until("document.querySelector('#speed').textContent === '198 km/h'")
    cockpit.until("document.querySelector('#left-lines small').innerText.endsWith(' NM')")


def number_of(cockpit: Cockpit, selector: str) -> float:
    return float(cockpit.browser.text(selector).split()[0])


def guidance(cockpit: Cockpit) -> dict[str, str]:
    """Values of guidance without the arrow of the side."""
    found = {}
    for key in ("across", "height", "speed"):
        shown = cockpit.browser.text(f"#guidance [data-key={key}] .g-value")
        found[key] = shown.removesuffix(" ▶")
    return found
