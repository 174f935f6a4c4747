"""The operator's page in use: tabs, languages, keys, installation, and the touches of each task."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest

from daemon.onboard.monitoring.web.page_files import PAGE
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.cockpit import (
    CONTRAST,
    FAULTS,
    LINES,
    MEASURES,
    SIZES,
    Cockpit,
    axe,
)
from tests.daemon.onboard.monitoring.cockpit_flight import cockpit_in, degrade, expose, prepare
from tests.daemon.onboard.monitoring.guidance_frames import approach_frame
from tests.support.browser import chromium


@pytest.fixture(scope="module")
def cockpit(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cockpit]:
    chromium()
    with cockpit_in(tmp_path_factory.mktemp("use")) as cockpit:
        prepare(cockpit)
        expose(cockpit, 2, 9)
        degrade(cockpit)
        yield cockpit


def test_each_page_next_to_the_map_is_whole(cockpit: Cockpit) -> None:
    """What `check` measures, with every tab open; each size in one of the themes."""
    browser = cockpit.browser
    tabs = browser.evaluate("[...document.querySelectorAll('#tabs button')].map((one) => one.id)")
    assert len(tabs) == 9
    browser.evaluate(MEASURES.read_text())
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
    """The pseudo-locale brackets every text of the catalogs and makes it a third longer.

    On a phone the names of lamps and the labels of guidance have room for their translations only,
    which `test_each_language_fits_the_page` measures.
    """
    browser = cockpit.browser
    browser.open(f"{cockpit.service.address}?lang=qps")
    cockpit.until("document.querySelector('#phase-button')?.innerText.startsWith('[')")
    cockpit.until("document.querySelectorAll('#faults > li').length > 20")
    browser.evaluate(MEASURES.read_text())
    for width, height in SIZES:
        cockpit.resize(width, height)
        found = browser.evaluate("measures()")
        if width < 500:
            found["clipped"] = [
                one for one in found["clipped"] if not one.startswith(("name: ", "g-label: "))
            ]
        for fault in FAULTS:
            assert found[fault] == [], f"{width}: {fault} {found[fault]}"
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
    # The longest texts of the lamps, and the guidance between lines.
    cockpit.status("flying", triggers=9, left=40, in_holdover=True, clock_coasting_s=12.0)
    cockpit.until("document.querySelector('#lamp-time .value').innerText.includes('12 s')")
    for width, height in (SIZES[0], SIZES[2]):
        cockpit.resize(width, height)
        cockpit.guide(lambda: approach_frame(LINES))
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
    cockpit.status("flying", triggers=9, left=40)
    cockpit.until("document.querySelector('#speed').textContent === '107 kn'")
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
