"""A page of which a file did not come recovers by itself, in a real browser."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from daemon.onboard.monitoring.web.connections import REQUESTS_BURST
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.support.browser import Browser, chromium

CONNECTED = "document.querySelector('#link')?.innerText === 'connected'"
READY = "document.body?.dataset.ready !== undefined"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    chromium()
    return tmp_path_factory.mktemp("loading")


@pytest.fixture(scope="module")
def service(folder: Path) -> Iterator[Service]:
    service = Service(folder)
    service.emit(flight_events.mission())
    yield service
    service.end()


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    with Browser(tmp_path / "profile") as browser:
        browser.call("Network.setBypassServiceWorker", bypass=True)
        browser.call("Network.setCacheDisabled", cacheDisabled=True)
        yield browser


@pytest.mark.parametrize(
    "blocked",
    ["*/strip.js", "*/vendor/leaflet.js", "*/panels.css", "*/messages/en/map.json"],
    ids=["module", "library", "style", "catalog"],
)
def test_a_file_that_did_not_come_is_loaded_again(
    service: Service, browser: Browser, blocked: str
) -> None:
    browser.call("Network.setBlockedURLs", urls=[blocked])
    browser.open(service.address)
    name = blocked.split("/")[-1]
    browser.wait_for("document.readyState === 'complete'", WITHIN_S)
    browser.wait_for(f"!({READY}) || document.querySelector('#link').textContent !== ''", WITHIN_S)
    browser.call("Network.setBlockedURLs", urls=[])
    loaded = (
        f"performance.getEntriesByType('resource').some((one) => one.name.endsWith('/{name}')"
        " && one.responseStatus === 200)"
    )
    browser.wait_for(f"{CONNECTED} && {READY} && {loaded}", WITHIN_S)
    assert browser.evaluate("getComputedStyle(document.querySelector('#bar')).display") != "block"


@pytest.mark.parametrize("page", ["pilot.html", "fleet.html"])
def test_the_other_pages_recover_too(service: Service, browser: Browser, page: str) -> None:
    browser.call("Network.setBlockedURLs", urls=["*/format.js"])
    browser.open(f"{service.address}{page}")
    browser.wait_for("document.readyState === 'complete'", WITHIN_S)
    browser.call("Network.setBlockedURLs", urls=[])
    browser.wait_for(READY, WITHIN_S)


def is_refused_after_a_flood(address: str) -> bool:
    """Ask for what is not there until one answer is 429, however slow the machine is."""
    parts = urlsplit(address)
    request = f"GET /api/v1/none HTTP/1.1\r\nHost: {parts.netloc}\r\n\r\n".encode()
    deadline_s = time.monotonic() + WITHIN_S
    while time.monotonic() < deadline_s:
        # Pipelined. The connection is reset with the first refusal, which may be lost in it.
        for count in (2 * REQUESTS_BURST, 1):
            link = socket.create_connection((parts.hostname, parts.port), WITHIN_S)
            with link, suppress(OSError):
                link.sendall(request * count)
                link.shutdown(socket.SHUT_WR)
                while answer := link.recv(65536):
                    if b"HTTP/1.1 429" in answer:
                        return True
    return False


def test_a_page_opens_although_its_address_has_sent_too_many_requests(
    service: Service, tmp_path: Path
) -> None:
    with Browser(tmp_path / "profile") as browser:
        browser.open(service.address)
        browser.wait_for(f"{CONNECTED} && navigator.serviceWorker.controller !== null", WITHIN_S)
        browser.evaluate("location.reload()")
        browser.wait_for(f"{CONNECTED} && {READY}", WITHIN_S)
        assert is_refused_after_a_flood(service.address)
        browser.evaluate("location.reload()")
        browser.wait_for(f"{CONNECTED} && {READY} && typeof L === 'object'", WITHIN_S)


KEPT = """caches.open('syntopic-page').then((cache) => Promise.all(['/', '/page.js', '/strip.js',
  '/vendor/leaflet.js', '/panels.css', '/messages/en/alarm.json'].map((one) => cache.match(one))))
  .then((found) => found.every(Boolean))"""


def test_a_page_that_was_opened_once_opens_without_the_service(tmp_path: Path) -> None:
    """Nothing was stored by the worker while that page loaded: it was not there yet."""
    service = Service(tmp_path)
    service.emit(flight_events.mission())
    with Browser(tmp_path / "profile") as browser:
        browser.open(service.address)
        browser.wait_for(f"{CONNECTED} && {READY}", WITHIN_S)
        browser.wait_for(KEPT, WITHIN_S)
        service.end()
        browser.evaluate("window.isBefore = true; location.reload()")
        browser.wait_for(
            f"window.isBefore === undefined && {READY} && typeof L === 'object'", WITHIN_S
        )
        paths = browser.evaluate(
            "caches.open('syntopic-page').then((cache) => cache.keys())"
            ".then((all) => all.map((one) => new URL(one.url).pathname))"
        )
        assert not [one for one in paths if one.startswith("/api/")]


def test_a_thumbnail_that_is_missing_is_not_asked_for_with_each_record(
    service: Service, browser: Browser
) -> None:
    browser.open(service.address)
    browser.wait_for(f"{CONNECTED} && {READY}", WITHIN_S)
    browser.evaluate(
        """import('/thumbnails.js').then(async ({ thumbnailOf }) => {
          for (let k = 0; k < 5; k += 1) await thumbnailOf(4711);
        })"""
    )
    assert sum(one.endswith("/4711/thumbnail.jpg") for one in browser.requested) == 1


def test_a_complete_page_is_not_loaded_again(service: Service, browser: Browser) -> None:
    browser.open(service.address)
    browser.wait_for(f"{CONNECTED} && {READY}", WITHIN_S)
    browser.evaluate("window.isSame = true")
    browser.evaluate(
        "document.head.append(Object.assign(document.createElement('link'),"
        " { rel: 'stylesheet', href: 'missing.css' }))"
    )
    browser.evaluate("new Promise((resolve) => setTimeout(resolve, 2500))")
    assert browser.evaluate("window.isSame === true")
