"""The pilot's view and the page of several aircraft, measured at three sizes and in both themes."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

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
from tests.daemon.onboard.monitoring.guidance_frames import guidance_frame
from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.daemon.onboard.monitoring.test_fleet import checksum, member
from tests.support.browser import Browser, chromium


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    chromium()
    with Browser(tmp_path_factory.mktemp("views") / "profile", width=1280, height=800) as browser:
        yield browser


def check(browser: Browser, refresh: Callable[[], None], themes: tuple[str, ...] = THEMES) -> None:
    """Measure the page after `refresh`; axe sees it where both themes are measured."""
    browser.evaluate(MEASURES.read_text())
    for width, height in SIZES:
        for theme in themes:
            metrics = {"width": width, "height": height, "deviceScaleFactor": 1}
            browser.call("Emulation.setDeviceMetricsOverride", **metrics, mobile=width < 500)
            browser.evaluate(f"document.documentElement.dataset.theme = '{theme}'")
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

    def send() -> None:
        # 38 m to the right, 55 m too low: both corrections are shown.
        sent = guidance_frame(LINES, 0.4, east_deg=0.0005, height_m=1340.0)
        while not service.child.try_send(ServiceEvent(sent)):
            time.sleep(0.02)
        browser.wait_for("document.querySelectorAll('.g-cell.exceeded').length === 2", WITHIN_S)
        browser.wait_for("!document.querySelector('#pilot').matches('.stale, .lost')", WITHIN_S)

    try:
        browser.open(f"{service.address}pilot?lang={language}")
        browser.wait_for(
            "document.querySelector('#pilot-link')?.classList.contains('good')", WITHIN_S
        )
        send()
        check(browser, send, THEMES if language == "en" else THEMES[:1])
        if language == "en":
            browser.call(
                "Emulation.setDeviceMetricsOverride",
                width=1280,
                height=800,
                deviceScaleFactor=1,
                mobile=False,
            )
            browser.evaluate("document.documentElement.dataset.theme = ''")
            send()
            save_picture(browser, "pilot-1280")
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
