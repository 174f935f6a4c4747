"""The dialogs of the operator's page, measured at three sizes and in both themes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest

from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.cockpit import (
    CONTRAST,
    FAULTS,
    MEASURES,
    SIZES,
    THEMES,
    Cockpit,
    axe,
    save_picture,
)
from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.support.browser import Browser, chromium

REFUSAL = "Not ready: no position (check the antenna of the receiver). An override needs a reason."


@pytest.fixture(scope="module")
def cockpit(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cockpit]:
    chromium()
    folder = tmp_path_factory.mktemp("dialogs")
    service = Service(folder)
    try:
        with Browser(folder / "profile", width=1280, height=800) as browser:
            cockpit = Cockpit(service, browser)
            cockpit.emit(flight_events.mission(str(folder / "mission")))
            cockpit.status("ready", missing=["no position (check the antenna of the receiver)"])
            cockpit.emit(flight_events.lost("SU03"), flight_events.lost("gnss"))
            browser.open(service.address)
            browser.wait_for("document.querySelector('#link')?.innerText === 'connected'", WITHIN_S)
            browser.wait_for("document.querySelectorAll('#faults > li').length === 2", WITHIN_S)
            browser.evaluate(f"sessionStorage.setItem('token', {json.dumps(service.token)})")
            yield cockpit
    finally:
        service.end()


def check(cockpit: Cockpit, dialog: str, sizes: tuple[tuple[int, int], ...] = SIZES) -> None:
    """Measure an open dialog at each size and in each theme."""
    cockpit.browser.wait_for(f"document.querySelector('{dialog}').open", WITHIN_S)
    found = []
    for where, faults in measured(cockpit, sizes, f"dialog{dialog.replace('#', '-')}"):
        found += [(where, fault, faults[fault]) for fault in (*FAULTS, "axe") if faults[fault]]
        if faults["scrolls"]:
            found.append((where, "scrolls", True))
    assert found == [], "\n".join(map(str, found))
    cockpit.resize(1280, 800)


def measured(
    cockpit: Cockpit, sizes: tuple[tuple[int, int], ...], picture: str
) -> Iterator[tuple[str, dict[str, Any]]]:
    """What is measured at each size and in each theme; `axe` has the findings of axe."""
    cockpit.browser.evaluate(MEASURES.read_text())
    for width, height in sizes:
        for theme in THEMES:
            cockpit.resize(width, height, theme)
            faults = cockpit.browser.evaluate("measures()")
            yield (
                f"{picture} at {width}x{height} {theme or 'light'}",
                faults | {"axe": axe(cockpit.browser)},
            )
        save_picture(cockpit.browser, f"{picture}-{width}")


def close(cockpit: Cockpit, dialog: str) -> None:
    cockpit.browser.evaluate(f"document.querySelector('{dialog}').close('')")
    cockpit.browser.evaluate("new Promise((resolve) => setTimeout(resolve, 50))")


def test_the_dialog_of_all_commands_is_whole(cockpit: Cockpit) -> None:
    cockpit.browser.click("#open-commands")
    check(cockpit, "#commands")
    close(cockpit, "#commands")


def test_the_settings_are_whole(cockpit: Cockpit) -> None:
    cockpit.browser.click("#open-settings")
    check(cockpit, "#settings")
    close(cockpit, "#settings")


def test_the_dialog_for_a_token_is_whole(cockpit: Cockpit) -> None:
    browser = cockpit.browser
    browser.evaluate("sessionStorage.removeItem('token')")
    browser.click("#phase-button")
    check(cockpit, "#ask-token")
    close(cockpit, "#ask-token")
    browser.evaluate(f"sessionStorage.setItem('token', {json.dumps(cockpit.service.token)})")


def test_the_confirmation_of_a_destructive_command_is_whole(cockpit: Cockpit) -> None:
    sent = len(cockpit.service.commands)
    cockpit.browser.click("#open-commands")
    cockpit.browser.click("#commands [data-command=land]")
    check(cockpit, "#ask-confirm")
    assert cockpit.browser.text("#confirm-do") == cockpit.browser.text("#confirm-title")
    close(cockpit, "#ask-confirm")
    assert len(cockpit.service.commands) == sent, "a cancelled command was sent"


def test_the_override_names_what_is_missing_and_is_whole(cockpit: Cockpit) -> None:
    service = cockpit.service
    service.refusal = REFUSAL
    sent = len(service.commands)
    cockpit.browser.click("#phase-button")
    service.until(lambda: len(service.commands) == sent + 1)
    check(cockpit, "#ask-override")
    assert "check the antenna" in cockpit.browser.text("#missing-items")
    close(cockpit, "#ask-override")
    service.refusal = ""
    assert len(service.commands) == sent + 1, "an override without a reason was sent"


def test_a_long_refusal_is_read_by_keys_alone(cockpit: Cockpit) -> None:
    """Its end lies below the edge of its place: a region that scrolls takes the focus."""
    browser, service = cockpit.browser, cockpit.service
    service.refusal = " ".join([REFUSAL] * 4)
    sent = len(service.commands)
    browser.click("#phase-button")
    service.until(lambda: len(service.commands) == sent + 1)
    cockpit.until("document.querySelector('#ask-override').open")
    close(cockpit, "#ask-override")
    service.refusal = ""
    assert browser.evaluate(
        "(({ scrollHeight, clientHeight }) => scrollHeight > clientHeight)"
        "(document.querySelector('#answer'))"
    )
    assert axe(browser) == []
    browser.evaluate("document.querySelector('#answer').focus()")
    assert browser.evaluate("document.activeElement.id") == "answer"


def test_shelving_is_whole_at_each_size(cockpit: Cockpit) -> None:
    """The times of shelving are buttons of each alarm; one alarm is shelved and one is not."""
    browser = cockpit.browser
    browser.click("#tab-alarms")
    browser.click("#faults li .shelve")
    cockpit.until("document.querySelector('#faults').innerText.includes('shelved until')")
    found = []
    for where, faults in measured(cockpit, SIZES, "shelving"):
        found += [(where, fault, faults[fault]) for fault in (*FAULTS, "axe") if faults[fault]]
        if faults["weakest"][1] < CONTRAST:
            found.append((where, "contrast", faults["weakest"]))
    assert found == [], "\n".join(map(str, found))
    cockpit.resize(1280, 800)


@pytest.mark.parametrize("language", ["qps", "de", "fr", "es", "zh"])
def test_each_language_fits_the_dialogs(cockpit: Cockpit, language: str) -> None:
    browser = cockpit.browser
    browser.open(f"{cockpit.service.address}?lang={language}")
    shown = "document.querySelector('#phase-button')?.innerText"
    cockpit.until(f"{shown} !== undefined && {shown} !== '' && {shown} !== 'Arm'")
    cockpit.until("document.querySelectorAll('#faults > li').length === 2")
    browser.evaluate(MEASURES.read_text())
    found = []
    for width, height in (SIZES[0], SIZES[2]):
        cockpit.resize(width, height)
        for dialog in ("commands", "settings", "ask-token", "ask-override"):
            browser.evaluate(f"document.querySelector('#{dialog}').showModal()")
            faults = browser.evaluate("measures()")
            where = f"{dialog} at {width}x{height} {language}"
            found += [(where, fault, faults[fault]) for fault in FAULTS if faults[fault]]
            close(cockpit, f"#{dialog}")
        for name in ("land", "new-mission", "release-disk", "accept-disk", "shutdown"):
            browser.evaluate(
                f"import('/commands.js').then((commands) => {{ commands.confirmed('{name}'); }})"
            )
            cockpit.until("document.querySelector('#ask-confirm').open")
            faults = browser.evaluate("measures()")
            where = f"confirm {name} at {width}x{height} {language}"
            found += [(where, fault, faults[fault]) for fault in FAULTS if faults[fault]]
            close(cockpit, "#ask-confirm")
    assert found == [], "\n".join(map(str, found))
