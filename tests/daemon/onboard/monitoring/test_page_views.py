"""The pilot's view and the page of several aircraft, measured at three sizes and in both themes."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import uvicorn

from daemon.onboard.monitoring.fleet import create_fleet_app
from daemon.onboard.service.messages import ServiceEvent
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.cockpit import (
    CONTRAST,
    FAULTS,
    LINES,
    MEASURES,
    SIZES,
    THEMES,
    axe,
    save_picture,
)
from tests.daemon.onboard.monitoring.guidance_frames import approach_frame, guidance_frame
from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.daemon.onboard.monitoring.test_fleet import checksum, member
from tests.support.browser import Browser, chromium


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    chromium()
    with Browser(tmp_path_factory.mktemp("views") / "profile", width=1280, height=800) as browser:
        yield browser


def set_theme(browser: Browser, theme: str) -> None:
    """By the button of the view; the page of several aircraft has none."""
    if browser.evaluate("document.querySelector('#pilot-theme') === null"):
        browser.evaluate(f"document.documentElement.dataset.theme = '{theme}'")
    elif browser.evaluate("document.documentElement.dataset.theme || ''") != theme:
        browser.click("#pilot-theme")
    assert browser.evaluate("document.documentElement.dataset.theme || ''") == theme


def check(browser: Browser, refresh: Callable[[], None], themes: tuple[str, ...] = THEMES) -> None:
    """Measure the page after `refresh`; axe sees it where both themes are measured."""
    browser.evaluate(MEASURES.read_text())
    for width, height in SIZES:
        for theme in themes:
            metrics = {"width": width, "height": height, "deviceScaleFactor": 1}
            browser.call("Emulation.setDeviceMetricsOverride", **metrics, mobile=width < 500)
            set_theme(browser, theme)
            refresh()
            found = browser.evaluate("measures()")
            where = f"{width}x{height} {theme or 'light'}"
            for fault in FAULTS:
                assert found[fault] == [], f"{where}: {fault} {found[fault]}"
            assert not found["scrolls"], where
            assert found["weakest"][1] >= CONTRAST, f"{where}: {found['weakest']}"
            if themes == THEMES:
                assert axe(browser) == [], where


@pytest.mark.parametrize("language", ["en", "de", "fr", "es", "zh"])
def test_the_view_of_a_pilot_is_whole(browser: Browser, tmp_path: Path, language: str) -> None:
    service = Service(tmp_path)

    def emit(sent: dict[str, Any], seen: str) -> None:
        while not service.child.try_send(ServiceEvent(sent)):
            time.sleep(0.02)
        browser.wait_for(seen, WITHIN_S)
        browser.wait_for("!document.querySelector('#pilot').matches('.stale, .lost')", WITHIN_S)

    def deviate() -> None:
        # 38 m to the right, 55 m too low: both corrections are shown.
        sent = guidance_frame(LINES, 0.4, east_deg=0.0005, height_m=1340.0)
        emit(sent, "document.querySelectorAll('.g-cell.exceeded').length === 2")

    def approach() -> None:
        emit(approach_frame(LINES), "document.querySelector('[data-key=bearing]') !== null")

    def picture(name: str, send: Callable[[], None]) -> None:
        size = {"width": 1280, "height": 800, "deviceScaleFactor": 1, "mobile": False}
        browser.call("Emulation.setDeviceMetricsOverride", **size)
        for theme in THEMES:
            set_theme(browser, theme)
            send()
            save_picture(browser, f"{name}-1280{'-night' if theme else ''}")

    try:
        browser.open(f"{service.address}pilot?lang={language}")
        browser.wait_for(
            "document.querySelector('#pilot-link')?.classList.contains('good')", WITHIN_S
        )
        deviate()
        themes = THEMES if language == "en" else THEMES[:1]
        check(browser, deviate, themes)
        approach()
        check(browser, approach, themes)
        if language != "en":
            return
        assert browser.evaluate("document.querySelector('#pilot-alarm').hidden")
        for key, shown in (
            ("line", "Next line A1"),
            ("bearing", "Bearing · distance 190° · 1219 m"),
            ("height", "Height −40/+60 m −4 m"),
            ("start", "To start 1201 m · 0:22"),
        ):
            cell = browser.text(f"#pilot-cells [data-key={key}]")
            assert " ".join(cell.split()) == shown
        picture("pilot", deviate)
        picture("pilot-approach", approach)
    finally:
        service.end()


def test_the_page_of_several_aircraft_is_whole(browser: Browser) -> None:
    now_s = time.monotonic()
    quiet = member("a:1", flight_events.status("flying", triggers=7), rig="one", now_s=now_s)
    noted = member("b:2", checksum("gnss"), rig="two", now_s=now_s + 3600.0)
    lost = member("c:3", flight_events.lost("SU02"), rig="three", now_s=now_s)
    bound = socket.create_server(("127.0.0.1", 0))
    config = uvicorn.Config(create_fleet_app([quiet, noted, lost]), log_level="error")
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]}, daemon=True)
    thread.start()
    try:
        browser.open(f"http://127.0.0.1:{bound.getsockname()[1]}/")
        browser.wait_for("document.querySelectorAll('#aircraft li').length === 3", WITHIN_S)
        browser.wait_for("document.querySelectorAll('#faults li').length === 2", WITHIN_S)
        check(browser, lambda: None)
    finally:
        server.should_exit = True
        thread.join(10.0)
