"""The operator's page through a whole flight, at three sizes and in both themes.

One service and one browser for all states. With SYNTOPIC_PICTURES a folder, each state is
pictured there.
"""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from typing import Any

import cv2
import pytest

from daemon.onboard.monitoring.web.page_files import PAGE
from processing.rig import shipped_rigs
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.cockpit import (
    CONTRAST,
    FAULTS,
    MEASURES,
    SIZES,
    THEMES,
    Cockpit,
    axe,
    lines,
    picture_of,
    save_picture,
)
from tests.daemon.onboard.monitoring.guidance_frames import aerial_map, vector_map
from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.support.browser import Browser, chromium

EXPOSURES = ["good", "good", "usable", "good", "good", "refly", "good", "good", "good"]


@pytest.fixture(scope="module")
def cockpit(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cockpit]:
    chromium()
    folder = tmp_path_factory.mktemp("cockpit")
    mission = folder / "mission"
    (mission / "L0").mkdir(parents=True)
    (mission / "rig.toml").write_bytes(shipped_rigs()["ultracam-x-mini"].read_bytes())
    (mission / "plan.geojson").write_text(json.dumps(lines()))
    (mission / "service.toml").write_text("[plan]\nground_height_m = 395.0\n")
    for number in range(1, len(EXPOSURES) + 1):
        product = mission / f"L2/{number:06d}"
        product.mkdir(parents=True)
        cv2.imwrite(str(product / "quicklook.jpg"), picture_of(number))
        cv2.imwrite(str(product / "thumbnail.jpg"), cv2.resize(picture_of(number), (200, 133)))
        (product / "histogram.json").write_text(
            json.dumps({"SU00": [0] * 8 + [50] * 24 + [0] * 32, "R": [0] * 63 + [500]})
        )
    service = Service(folder, maps=(aerial_map(folder), vector_map(folder)))
    try:
        with Browser(folder / "profile", width=1280, height=800) as browser:
            cockpit = Cockpit(service, browser)
            cockpit.emit(flight_events.mission(str(mission)))
            for head in [f"SU{k:02d}" for k in range(13)]:
                cockpit.emit({"event": "bound", "device": head, "kind": "head", "found": {}})
            for device, kind in (
                ("gnss", "navigator"),
                ("trigger", "trigger"),
                ("probes", "thermometer"),
            ):
                cockpit.emit({"event": "bound", "device": device, "kind": kind, "found": {}})
            cockpit.status("idle")
            browser.open(service.address)
            browser.wait_for("document.querySelector('#link')?.innerText === 'connected'", WITHIN_S)
            browser.evaluate(f"sessionStorage.setItem('token', {json.dumps(service.token)})")
            yield cockpit
    finally:
        if service.child.process.is_alive():
            service.end()


def opened(*devices: str) -> list[dict[str, Any]]:
    return [{"event": "device", "device": one, "name": "opened"} for one in devices]


HEADS = [f"SU{k:02d}" for k in range(13)]


def check(cockpit: Cockpit, state: str, *, east_deg: float | None = None) -> None:
    """Measure the page at each size and in each theme, and picture it.

    `east_deg` is the place of the aircraft on the line, for states with guidance.
    """
    browser = cockpit.browser
    browser.evaluate(MEASURES.read_text())
    for width, height in SIZES:
        for theme in THEMES:
            cockpit.resize(width, height, theme)
            cockpit.guide(east_deg)
            found = browser.evaluate("measures()")
            where = f"{state} at {width}x{height} {theme or 'light'}"
            for fault in FAULTS:
                assert found[fault] == [], f"{where}: {fault} {found[fault]}"
            assert not found["scrolls"], where
            assert found["weakest"][1] >= CONTRAST, f"{where}: {found['weakest']}"
            findings = axe(browser)
            assert findings == [], f"{where}: {findings}"
        cockpit.resize(width, height, "dark" if state in ("between-lines", "link-lost") else "")
        cockpit.guide(east_deg)
        save_picture(browser, f"{state}-{width}")
    cockpit.resize(1280, 800)


def test_before_arming(cockpit: Cockpit) -> None:
    cockpit.emit(*opened(*HEADS, "probes"), {"event": "device", "device": "gnss", "name": "fixed"})
    one = {"exposure_time_us": 4000.0, "gain_db": 0.0, "tdi_shifts": 0}
    settings = {"pan": one, "R": one}
    cockpit.emit(
        {"event": "exposure-settings", "by": "service", "control": "manual", "settings": settings}
    )
    cockpit.status("ready", missing=["no position (check the antenna of the receiver)"])
    cockpit.until("document.querySelector('#phase').innerText === 'not ready'")
    cockpit.until("document.querySelector('[data-check=plan].good') !== null")
    for event in flight_events.exposure(1, "good"):
        cockpit.emit(event)
    cockpit.status("ready", triggers=1, missing=["no position (check the antenna of the receiver)"])
    # PAN ends at half of full scale and asks for half as much time again. Red is saturated.
    cockpit.until("document.querySelector('#exposure-suggestion').innerText.includes('6000 µs')")
    assert "R: 2000 µs" in cockpit.browser.text("#exposure-suggestion [data-group=R]")
    cockpit.until("document.querySelector('[data-check=test].good') !== null")
    assert cockpit.browser.text("#phase-button") == "Arm"
    check(cockpit, "before-arming")


def test_on_a_line(cockpit: Cockpit) -> None:
    for number, verdict in enumerate(EXPOSURES[1:6], start=2):
        for event in flight_events.exposure(number, verdict, line="A0", north_m=68.0 * number):
            cockpit.emit(event)
    cockpit.status("flying", triggers=6)
    cockpit.until("document.querySelector('#phase-button').innerText === 'Stop line'")
    cockpit.until("document.querySelector('#left-lines').innerText.includes('of 5')")
    cockpit.until("document.querySelector('#left-light').innerText.includes('until 16:')")
    cockpit.until("/^\\d/.test(document.querySelector('#left-end dd').innerText)")
    assert "GB" in cockpit.browser.text("#left-disk")
    assert "min" in cockpit.browser.text("#left-disk") or " h " in cockpit.browser.text(
        "#left-disk"
    )
    cockpit.until("document.querySelectorAll('#strip .thumb img[src]').length === 6")
    cockpit.until("document.querySelectorAll('#map canvas[data-map]').length > 0")
    cockpit.until("document.querySelectorAll('#map .placed').length === 6")
    check(cockpit, "on-a-line", east_deg=0.00005)


def test_between_lines(cockpit: Cockpit) -> None:
    for number, verdict in enumerate(EXPOSURES[6:], start=7):
        for event in flight_events.exposure(number, verdict, line="A0", north_m=68.0 * number):
            cockpit.emit(event)
    cockpit.status("armed", triggers=9)
    cockpit.until("document.querySelector('#phase-button').innerText === 'Start line'")
    assert cockpit.browser.text("#phase-second") == "Land"
    check(cockpit, "between-lines", east_deg=0.00005)


def test_degraded_with_many_faults(cockpit: Cockpit) -> None:
    cockpit.emit(flight_events.lost("SU03"), flight_events.lost("gnss"))
    for number in range(30):
        name = ("checksum", "frames-missing", "kernel-drops")[number % 3]
        sentence = (
            f"Head SU{number % 13:02d} reports a problem of its link. Check cable and network."
        )
        cockpit.emit(flight_events.device_event(f"SU{number % 13:02d}", name, sentence, fault=True))
    cockpit.emit({"event": "disk", "sentence": "The disk is low: room for 40 exposures, 1 min."})
    area = {"columns": 40, "rows": 26, "gaps": {"pan": [[30, 0, 40, 26]]}}
    report = {"verdict": "good", "flags": [], "findings": [], "figures": {}, "valid_area": area}
    cockpit.emit({"event": "judged", "number": 9, "report": report})
    cockpit.status("flying", triggers=9, left=40)
    cockpit.until("document.querySelectorAll('#faults > li').length > 20")
    for lamp, state in (
        ("heads", "warning"),
        ("disk", "warning"),
        ("position", "caution"),
        ("trigger", "good"),
    ):
        cockpit.until(f"document.querySelector('#lamp-{lamp}').classList.contains('{state}')")
    assert cockpit.browser.evaluate("document.body.dataset.sounding") == "warning"
    # The right quarter of exposure 9 has no data, and that is hatched where it is.
    cockpit.until("document.querySelectorAll('#map path.no-data').length === 1")
    hatched, image = cockpit.browser.evaluate(
        "[document.querySelector('#map path.no-data'),"
        " [...document.querySelectorAll('#map .placed')]"
        ".sort((a, b) => a.getBoundingClientRect().top - b.getBoundingClientRect().top)[0]]"
        ".map((one) => one.getBoundingClientRect()).map((one) => [one.left, one.top, one.right,"
        " one.bottom])"
    )
    width = image[2] - image[0]
    assert hatched[0] == pytest.approx(image[0] + 0.75 * width, abs=3.0)
    assert hatched[1:] == pytest.approx(image[1:], abs=3.0)
    assert "no-data-hatch" in cockpit.browser.evaluate(
        "getComputedStyle(document.querySelector('#map path.no-data')).fill"
    )
    # 38 m to the right of a line with a limit of 25 m.
    check(cockpit, "degraded", east_deg=0.0005)


def test_each_page_next_to_the_map_is_whole(cockpit: Cockpit) -> None:
    """What `check` measures, with every tab open; each size in one of the themes."""
    browser = cockpit.browser
    tabs = browser.evaluate("[...document.querySelectorAll('#tabs button')].map((one) => one.id)")
    assert len(tabs) == 9
    found = []
    for (width, height), theme in zip(SIZES, ("dark", "", "dark"), strict=True):
        cockpit.resize(width, height, theme)
        for tab in tabs:
            browser.click(f"#{tab}")
            where = f"{tab} at {width}x{height} {theme or 'light'}"
            faults = browser.evaluate("measures()")
            found += [(where, fault, faults[fault]) for fault in FAULTS if faults[fault]]
            if faults["scrolls"] or faults["weakest"][1] < CONTRAST:
                found.append((where, "scrolls or contrast", faults["weakest"]))
            if width < 2000:
                found += [(where, "axe", one) for one in axe(browser)]
    assert found == [], "\n".join(map(str, found))
    browser.click("#tab-flight")
    cockpit.resize(1280, 800)


def test_no_text_is_missing_from_the_catalogs_and_none_is_clipped(cockpit: Cockpit) -> None:
    """The pseudo-locale brackets every text of the catalogs and makes it a third longer."""
    browser = cockpit.browser
    browser.open(f"{cockpit.service.address}?lang=qps")
    cockpit.until("document.querySelector('#phase-button')?.innerText.startsWith('[')")
    cockpit.until("document.querySelectorAll('#faults > li').length > 20")
    browser.evaluate(MEASURES.read_text())
    for width, height in SIZES:
        cockpit.resize(width, height)
        found = browser.evaluate("measures()")
        assert found["outside"] == [], f"{width}: {found['outside']}"
        assert found["overlapping"] == [], f"{width}: {found['overlapping']}"
        assert not found["scrolls"]
    untranslated = browser.evaluate(
        "[...document.querySelectorAll('button, h2, dt, label, th, .note, .lamp .name, .label')]"
        ".filter((one) => !one.closest('.leaflet-container, #exposure-now'))"
        ".map((one) => one.textContent.trim()).filter((text) => /[a-z]{3}/i.test(text)"
        " && !text.includes('['))"
    )
    allowed = {"GeoJSON", "KML"}
    assert [text for text in untranslated if text not in allowed] == []


@pytest.mark.parametrize(
    ("language", "stop"),
    [
        ("de", "Linie stoppen"),
        ("fr", "Arrêter la ligne"),
        ("es", "Parar línea"),
        ("zh", "停止航线"),
    ],
)
def test_each_language_fits_the_page(cockpit: Cockpit, language: str, stop: str) -> None:
    browser = cockpit.browser
    browser.open(f"{cockpit.service.address}?lang={language}")
    cockpit.until(f"document.querySelector('#phase-button')?.innerText === '{stop}'")
    assert browser.evaluate("document.documentElement.lang") == language
    cockpit.until("document.querySelector('.faults .active')?.innerText.length > 20")
    item = "document.querySelector('[data-fault=\"device SU03\"]')"
    catalog = json.loads((PAGE / f"messages/{language}/alarm.json").read_text("utf-8"))
    for part in ("", ".cause", ".action"):
        assert browser.evaluate(f"{item}.innerText").count(catalog[f"alarm.device/lost{part}"])
    assert browser.text("[data-fault='device SU03'] code") == "device/lost"
    browser.evaluate(MEASURES.read_text())
    for width, height in (SIZES[0], SIZES[2]):
        cockpit.resize(width, height)
        found = browser.evaluate("measures()")
        for fault in ("outside", "overlapping", "clipped"):
            assert found[fault] == [], f"{language} {width}: {fault} {found[fault]}"


def test_the_page_is_worked_by_keys_and_units_are_chosen(cockpit: Cockpit) -> None:
    browser = cockpit.browser
    browser.open(cockpit.service.address)
    cockpit.until("document.querySelector('#phase-button')?.innerText === 'Stop line'")
    cockpit.resize(1280, 800)
    for key, page in (("a", "page-alarms"), ("x", "page-expert"), ("d", "page-devices")):
        browser.call("Input.dispatchKeyEvent", type="keyDown", key=key, text=key)
        assert browser.evaluate(f"!document.querySelector('#{page}').hidden"), key
        browser.call("Input.dispatchKeyEvent", type="keyUp", key=key)
    assert "Standard deviation" in browser.text("#expert")
    assert browser.text("#speed") == "107 kn"
    browser.evaluate(
        "import('/format.js').then((format) => format.setUnit('speed', 'km/h'))"
        ".then(() => import('/feed.js')).then(({feed}) => feed.refresh())"
    )
    cockpit.until("document.querySelector('#speed').textContent === '198 km/h'")


def test_the_page_can_be_installed_and_opens_without_the_service(cockpit: Cockpit) -> None:
    browser = cockpit.browser
    found = browser.call("Page.getAppManifest")
    assert found["errors"] == []
    manifest = json.loads(found["data"])
    assert (manifest["display"], manifest["start_url"]) == ("standalone", "./")
    cockpit.until("navigator.serviceWorker.controller !== null")
    kept = (
        "caches.open('syntopic-page').then((cache) => cache.keys())"
        ".then((all) => all.map((one) => new URL(one.url).pathname))"
    )
    assert not [path for path in browser.evaluate(kept) if path.startswith("/api/")]
    # Where the browser can do it, requests of a flight go past the worker, which keeps its objects.
    assert browser.evaluate(PAST_THE_WORKER) in ("network", "no routes")


PAST_THE_WORKER = """(async () => {
  if (!('workerMatchedSourceType' in PerformanceResourceTiming.prototype)) return 'no routes';
  performance.clearResourceTimings();
  await (await fetch('/api/v1/ledger?past')).text();
  for (let k = 0; k < 100; k += 1) {
    const [one] = performance.getEntriesByType('resource').filter((e) => e.name.endsWith('?past'));
    if (one) return one.workerMatchedSourceType;
    await new Promise((resolve) => setTimeout(resolve, 50));
  }
  return 'not seen';
})()"""

RETAKE = ["held #strip .thumb:nth-child(1)", "#strip .thumb:nth-child(3)", "#strip-retake"]


def test_the_tasks_of_an_operator_take_three_touches_at_most(cockpit: Cockpit) -> None:
    browser = cockpit.browser
    browser.evaluate(MEASURES.read_text())
    tasks: dict[str, tuple[dict[int, list[str]], str]] = {
        "see the minutes of disk": ({1280: [], 390: []}, "min"),
        "silence": ({1280: ["#silence"], 390: ["#silence"]}, "sounding"),
        "shelve an alarm": (
            {1280: ["#alarm-bar .what", ".shelve"], 390: ["#alarm-bar .what", ".shelve"]},
            "shelved",
        ),
        "find exposure 7": (
            {
                1280: ["#tab-exposures", "#rows tr:nth-child(3) button"],
                390: [
                    "#tab-more",
                    "#more-tabs button:nth-child(1)",
                    "#rows tr:nth-child(3) button",
                ],
            },
            "exposure 7",
        ),
        "see which head is lost": ({1280: ["#lamp-heads"], 390: ["#lamp-heads"]}, "SU03"),
        "find the gap of exposure 7": (
            {1280: ["#strip .thumb:nth-child(3)"], 390: ["#strip .thumb:nth-child(3)", "#tab-map"]},
            "gap of 7",
        ),
        # The first is held for half a second: it begins to mark.
        "retake two exposures": (dict.fromkeys((1280, 390), RETAKE), "retake"),
        "stop the line": ({1280: ["#phase-button"], 390: ["#phase-button"]}, "stop"),
    }
    done = {
        "min": "document.querySelector('#left-disk').innerText.includes('min')",
        "sounding": "document.body.dataset.sounding === ''",
        "shelved": "document.querySelector('#faults').innerText.includes('shelved until')",
        "exposure 7": "document.querySelector('#image-which').innerText === '7'",
        "SU03": "document.querySelector('#devices li.lost').checkVisibility()",
        "gap of 7": "[...document.querySelectorAll('.selection-label')].some((one) =>"
        " one.checkVisibility({checkVisibilityCSS: true})"
        " && one.textContent.includes('Exposure 7: gap on A0'))",
    }
    for width, height in (SIZES[0], SIZES[2]):
        cockpit.resize(width, height)
        for task, (touches, outcome) in tasks.items():
            assert len(touches[width]) <= 3, task
            browser.click("#tab-map" if width < 500 else "#tab-flight")
            before = len(cockpit.service.commands)
            for selector in touches[width]:
                cockpit.touch(selector.removeprefix("held "), 0.7 * selector.startswith("held "))
            if outcome in ("stop", "retake"):
                sent = 2 if outcome == "retake" else 1
                cockpit.service.until(lambda n=before + sent: len(cockpit.service.commands) >= n)
                found = cockpit.service.commands[before:]
                assert [one.name for one in found] == [outcome] * sent
                if outcome == "retake":
                    assert [one.arguments["number"] for one in found] == [7, 9]
            else:
                cockpit.until(done[outcome])
        # A new fault sounds again, although the others are silenced.
        cockpit.emit(flight_events.lost(f"SU{5 + width // 1000:02d}"))
        cockpit.until("document.body.dataset.sounding === 'warning'")
        browser.evaluate("sessionStorage.removeItem('shelved')")
        cockpit.touch("#tab-flight")
        browser.evaluate("document.activeElement.blur()")
    # A browser plays after the first touch: the tones were generated.
    assert int(browser.evaluate("document.body.dataset.sounded ?? '0'")) >= 1


def test_an_alarm_is_acknowledged_by_name_and_reports_the_end_of_its_cause(
    cockpit: Cockpit,
) -> None:
    item = "document.querySelector('[data-fault=\"device gnss\"]')"
    cockpit.until(f"{item} !== null")
    cockpit.browser.evaluate(f"{item}.querySelector('.acknowledge').click()")
    cockpit.service.until(lambda: cockpit.service.commands[-1].name == "acknowledge")
    cockpit.until(f"{item}.innerText.includes('acknowledged by operator (administrator)')")
    item = "document.querySelector('[data-fault=\"device SU03\"]')"
    cockpit.emit(flight_events.recovered("SU03"))
    cockpit.until(f"{item}.innerText.includes('cause is gone')")


def test_the_link_is_lost_and_comes_back_by_itself(cockpit: Cockpit) -> None:
    pid = cockpit.service.child.process.pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    try:
        cockpit.until("document.body.classList.contains('connection-lost')")
        assert "Connection lost" in cockpit.browser.text("#connection-lost")
        assert "warning" in cockpit.browser.evaluate(
            "document.querySelector('#lamp-link').className"
        )
        check(cockpit, "link-lost")
    finally:
        os.kill(pid, signal.SIGCONT)
    cockpit.until("!document.body.classList.contains('connection-lost')")
    cockpit.until("document.querySelector('#lamp-link').classList.contains('good')")


def test_after_landing_the_summary_stays_without_an_alarm(cockpit: Cockpit) -> None:
    browser = cockpit.browser
    browser.click("#tab-alarms")
    cockpit.emit({"event": "phase", "phase": "landed"})
    cockpit.status("landed", triggers=9)
    cockpit.until("document.querySelector('#landing').checkVisibility()")
    cockpit.until("document.querySelectorAll('[data-file]').length === 4")
    cockpit.emit({"event": "landing", "folders": ["/media/a"], "poweroff": ""})
    cockpit.until("document.querySelector('[data-action=verify]') !== null")
    cockpit.service.end()
    cockpit.until("document.body.classList.contains('flight-ended')")
    assert not browser.evaluate("document.body.classList.contains('connection-lost')")
    # What only the service can do is no longer offered.
    assert browser.evaluate("document.querySelector('[data-action]')") is None
    lamp = browser.evaluate("document.querySelector('#lamp-link').className")
    assert "off" in lamp
    assert browser.evaluate("document.querySelector('#alarm-bar').hidden")
    assert browser.text("#connection-lost").startswith("Landed. The service ended ")
    summary = browser.text("#landing")
    for expected in ("● 7 ▲ 1 ■ 1", "GeoJSON", "KML", "MAVLink", "CSV", "GPS 1466078"):
        assert expected in summary, expected
    csv = browser.evaluate("(async () => (await import('/landing.js')).textOf('fly-again.csv'))()")
    assert csv.startswith("line,strip,kind,from_m")
    assert browser.text("#image-which") == "7", "the selection outlives a lost connection"
    assert not browser.evaluate("document.querySelector('#quicklook').hidden")
    assert browser.evaluate("document.querySelector('#guidance').hidden")
    # Pictures show a path as it is on the computer of a camera.
    path = "/srv/missions/20261121T101500Z-small"
    browser.evaluate(
        "document.querySelectorAll('#landing code').forEach((one) => {"
        f" one.textContent = one.textContent.replace(/\\/\\S*/, '{path}'); }})"
    )
    check(cockpit, "after-landing")
    browser.open(cockpit.service.address)
    cockpit.until("document.querySelector('#phase-button')?.innerText === 'Starting'")
    cockpit.until("document.querySelector('#lamp-link .name')?.innerText === 'Link'")
    outside = [url for url in browser.requested if not url.startswith(("data:", "blob:"))]
    assert all(url.replace("ws:", "http:").startswith(cockpit.service.address) for url in outside)
