"""The page under conditions of its operator: large text, forced colours, a second device.

Measured in the fullest state: a head and the receiver lost, thirty faults, a bad verdict.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from daemon.onboard.monitoring.web.page_files import PAGE
from tests.daemon.onboard.monitoring.cockpit import (
    FAULTS,
    MEASURES,
    SIZES,
    THEMES,
    Cockpit,
    axe,
    resize,
    save_picture,
)
from tests.daemon.onboard.monitoring.cockpit_flight import cockpit_in, degrade, expose, prepare
from tests.daemon.onboard.monitoring.page_service import WITHIN_S
from tests.support.browser import Browser, chromium

LANGUAGES = ("en", "de", "fr", "es", "zh")
TABS = "[...document.querySelectorAll('#tabs button')].filter((one) => one.checkVisibility())"


@pytest.fixture(scope="module")
def cockpit(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cockpit]:
    chromium()
    with cockpit_in(tmp_path_factory.mktemp("conditions")) as cockpit:
        prepare(cockpit)
        expose(cockpit, 2, 9)
        degrade(cockpit)
        yield cockpit


def emulate(browser: Browser, **features: str) -> None:
    listed = [{"name": name.replace("_", "-"), "value": value} for name, value in features.items()]
    browser.call("Emulation.setEmulatedMedia", features=listed)


def measured(browser: Browser, *faults: str) -> dict[str, Any]:
    browser.evaluate(MEASURES.read_text())
    found = browser.evaluate("measures()")
    return {fault: found[fault] for fault in faults if found[fault]}


def test_forced_colours_leave_shapes_states_and_contrast(cockpit: Cockpit) -> None:
    browser = cockpit.browser
    for scheme, theme in (("light", ""), ("dark", "dark")):
        emulate(browser, forced_colors="active", prefers_color_scheme=scheme)
        for width, height in SIZES:
            resize(browser, width, height, theme)
            where = f"{scheme} {width}"
            assert measured(browser, *FAULTS) == {}, where
            # What is pressed or selected differs from what is not by more than a removed colour.
            for one, other in (
                ("#map-follow", "#map-measure"),
                ("#tabs [aria-selected=true]", "#tabs [aria-selected=false]"),
            ):
                first, second = (
                    browser.evaluate(
                        f"getComputedStyle(document.querySelector('{name}')).backgroundColor"
                    )
                    for name in (one, other)
                )
                assert first != second, (where, one)
        marks = browser.evaluate(
            "[...document.querySelectorAll('.lamp .mark')].map((one) => one.textContent)"
        )
        assert len(set(marks)) >= 2 and "✖" in marks
    emulate(browser)
    resize(browser, *SIZES[0])


def test_text_of_twice_the_size_covers_and_hides_no_control(cockpit: Cockpit) -> None:
    """The zoom of a browser to 200 %: half as many pixels of the page, each of four."""
    browser = cockpit.browser
    for width, height in SIZES[:2]:
        for theme in THEMES:
            resize(browser, width // 2, height // 2, theme)
            save_picture(browser, f"zoomed-{width}{theme}")
            found = measured(browser, "overlapping", "weakTexts", "smallTexts")
            assert found == {}, (width, theme, found)
            assert browser.evaluate(f"({OUTSIDE})({json.dumps(PINNED)})") == [], (width, theme)
            # What scrolls is reached: the map, the verdict and a page, each in its turn.
            for control in ("#map-follow", "#verdict", "#tab-alarms"):
                assert browser.evaluate(f"centre('{control}')") is not None, (width, control)
    resize(browser, *SIZES[0])


def test_reduced_motion_moves_nothing(cockpit: Cockpit) -> None:
    browser = cockpit.browser
    running = "document.getAnimations().filter((one) => one.playState === 'running').length"
    emulate(browser, prefers_reduced_motion="reduce")
    cockpit.until(f"{running} === 0")
    emulate(browser)


@pytest.mark.parametrize("language", LANGUAGES)
def test_a_long_list_of_faults_is_whole_on_a_phone(cockpit: Cockpit, language: str) -> None:
    browser = cockpit.browser
    browser.open(f"{cockpit.service.address}?lang={language}")
    cockpit.until(f"document.documentElement?.lang === '{language}'")
    cockpit.until("document.querySelectorAll('#faults > li').length > 20")
    width, height = SIZES[2]
    for theme in THEMES:
        resize(browser, width, height, theme)
        for tab in ("map", "alarms"):
            browser.click(f"#tab-{tab}")
            found = measured(browser, *FAULTS)
            assert found == {}, (language, theme, tab, found)
        assert axe(browser) == [], (language, theme)
        # Each fault is read to its end by scrolling, and none is wider than the page.
        cut = browser.evaluate(
            "[...document.querySelectorAll('#faults > li, #faults > li *')]"
            ".filter((one) => one.scrollWidth > one.clientWidth + 1 && one.clientWidth)"
            ".map((one) => one.textContent.slice(0, 40))"
        )
        assert cut == [], (language, cut)
    catalog = json.loads((PAGE / f"messages/{language}/alarm.json").read_text("utf-8"))
    assert catalog["alarm.device/lost"] in browser.text("[data-fault='device SU03']")


PINNED = ".lamp, #theme, #alarm-bar button:not(.what), #phase-button, #open-commands"
OUTSIDE = """(selector) => [...document.querySelectorAll(selector)]
  .filter((one) => one.checkVisibility()).filter((one) => {
    const { left, top, right, bottom } = one.getBoundingClientRect();
    return left < -0.5 || top < -0.5 || right > innerWidth + 0.5 || bottom > innerHeight + 0.5;
  }).map((one) => one.id || one.textContent)"""


SEEN = """JSON.stringify({
  lamps: [...document.querySelectorAll('.lamp')].map((one) =>
    [one.className, one.querySelector('.value').textContent]),
  verdict: [...document.querySelectorAll('#verdict :is(.word, .which), #findings')]
    .map((one) => one.textContent),
  button: document.querySelector('#phase-button').innerText,
  alarm: document.querySelector('#alarm-bar .what').innerText,
  faults: [...document.querySelectorAll('#faults > li')].map((one) => one.dataset.fault).sort(),
  strip: [...document.querySelectorAll('#strip .t-mark')].map((one) => one.textContent),
})"""


def test_a_page_that_is_opened_in_flight_shows_what_the_other_one_shows(
    cockpit: Cockpit, tmp_path: Path
) -> None:
    """A second device with another clock, and each of the two acts."""
    first = cockpit.browser
    first.open(f"{cockpit.service.address}?lang=en")
    resize(first, *SIZES[0])
    cockpit.until("document.querySelectorAll('#faults > li').length > 20")
    with Browser(tmp_path / "second", width=1280, height=800) as second:
        second.call(
            "Page.addScriptToEvaluateOnNewDocument",
            source="const real = Date.now; Date.now = () => real() - 7 * 3600e3;",
        )
        second.open(f"{cockpit.service.address}?lang=en")
        second.wait_for("document.querySelectorAll('#faults > li').length > 20", WITHIN_S)
        second.evaluate(f"sessionStorage.setItem('token', {json.dumps(cockpit.service.token)})")
        cockpit.status("flying", triggers=9, left=40, age_s=8.0)
        agreed = f"{SEEN} === {json.dumps(first.evaluate(SEEN))}"
        second.wait_for(agreed, WITHIN_S)
        # What one device shelves sounds on the other; what one acknowledges both have seen.
        first.click("[data-fault='device SU03'] .shelve")
        item = "document.querySelector('[data-fault=\"device SU03\"]')"
        shelved = "JSON.parse(sessionStorage.getItem('shelved') ?? '[]').length"
        assert [browser.evaluate(shelved) for browser in (first, second)] == [1, 0]
        assert second.evaluate("document.body.dataset.sounding") == "warning"
        cockpit.service.commands.clear()
        second.click("[data-fault='device SU03'] .acknowledge")
        cockpit.service.until(lambda: [c.name for c in cockpit.service.commands] == ["acknowledge"])
        seen = f"{item}.innerText.includes('acknowledged by operator')"
        for browser in (first, second):
            browser.wait_for(seen, WITHIN_S)
