"""The page is an app that a browser offers to install."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.support.browser import Browser, chromium

LOADED = "document.body?.dataset.ready !== undefined"


def installability_errors(browser: Browser) -> list[str]:
    found: list[dict[str, Any]] = browser.call("Page.getInstallabilityErrors")[
        "installabilityErrors"
    ]
    return sorted(one["errorId"] for one in found)


def test_a_browser_finds_nothing_against_installing_the_page(tmp_path: Path) -> None:
    chromium()
    service = Service(tmp_path, hosts=("camera.test",))
    flags = ("--host-resolver-rules=MAP camera.test 127.0.0.1",)
    try:
        with Browser(tmp_path / "profile", flags=flags) as browser:
            browser.open(service.address)
            browser.wait_for("navigator.serviceWorker?.controller != null", WITHIN_S)
            assert installability_errors(browser) == []
            # The browser does look: by a name that is not localhost it requires TLS.
            port = service.address.rstrip("/").rpartition(":")[2]
            browser.open(f"http://camera.test:{port}/")
            browser.wait_for(f"location.host.startsWith('camera.test') && {LOADED}", WITHIN_S)
            assert installability_errors(browser) == ["not-from-secure-origin"]
    finally:
        service.end()
