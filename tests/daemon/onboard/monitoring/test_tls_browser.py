"""A browser on another host: what a trusted certificate gives a page, and what one that was clicked
through does not."""

from __future__ import annotations

import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from daemon.onboard.monitoring.access.certificate_authority import issue_certificate
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.support.browser import Browser, chromium
from tests.support.namespaces import Host, two_hosts

pytestmark = pytest.mark.trust
NAME = f"{socket.gethostname().lower().partition('.')[0]}.local"
ABILITIES = """(async () => ({
  secure: isSecureContext,
  wakeLock: "wakeLock" in navigator
    && await navigator.wakeLock.request("screen").then(() => true, (e) => e.name),
  serviceWorker: "serviceWorker" in navigator
    && await navigator.serviceWorker.register("/vendor/uplot.js")
      .then(() => true, (e) => e.name),
}))()"""
"""Any script of the page that does without a document serves as a service worker."""


def trusting_profile(home_folder: Path, authority: Path) -> Path:
    """A home folder whose certificate store trusts an authority, as a tablet that installed it."""
    if shutil.which("certutil") is None:
        pytest.skip("no certutil here; apt-get install libnss3-tools")
    store = home_folder / ".pki/nssdb"
    store.mkdir(parents=True)
    for arguments in (
        ("-N", "--empty-password"),
        ("-A", "-n", "syntopic", "-t", "C,,", "-i", str(authority)),
    ):
        subprocess.run(
            ["certutil", "-d", f"sql:{store}", *arguments],
            check=True,
            capture_output=True,
            timeout=60,
        )
    return home_folder


@contextmanager
def camera_and_tablet(folder: Path) -> Iterator[tuple[Service, Host, Host]]:
    chromium()
    with two_hosts() as (camera, tablet):
        issue_certificate(folder / "tls", names=[camera.address])
        files = {"tls_certificate": folder / "tls/server.pem", "tls_key": folder / "tls/server.key"}
        service = camera.run(lambda: Service(folder, host=camera.address, **files))
        try:
            service.emit(flight_events.mission())
            service.emit(flight_events.status(triggers=3))
            yield service, camera, tablet
        finally:
            service.end()


def visits(folder: Path, home_folder: Path, camera: Host, *steps: tuple[str, bool]) -> list[Any]:
    """What pages can do, each an address and whether its certificate is clicked through.

    To be called in the thread of the host that the browser is on.
    """
    home_folder.mkdir(exist_ok=True)
    mapped = f"--host-resolver-rules=MAP {NAME} {camera.address}"
    with Browser(folder, flags=(mapped,), environment={"HOME": str(home_folder)}) as browser:
        return [_visit(browser, *step) for step in steps]


def _visit(browser: Browser, address: str, ignore: bool) -> Any:
    browser.call("Security.setIgnoreCertificateErrors", ignore=ignore)
    # The page's own policy lets nobody register a service worker; here certificates are looked at.
    browser.call("Page.setBypassCSP", enabled=True)
    browser.open("about:blank")
    browser.wait_for("location.href === 'about:blank'", WITHIN_S)
    browser.open(address)
    browser.wait_for(
        "document.readyState === 'complete' && location.href !== 'about:blank'", WITHIN_S
    )
    if browser.evaluate("document.querySelector('#triggers') === null"):
        return browser.evaluate("document.body.innerText")
    browser.wait_for("document.querySelector('#triggers').innerText === '3'", WITHIN_S)
    return browser.evaluate(ABILITIES)


def test_a_trusted_certificate_gives_service_worker_and_wake_lock_on_another_host(
    tmp_path: Path,
) -> None:
    with camera_and_tablet(tmp_path) as (service, camera, tablet):
        home_folder = trusting_profile(tmp_path / "home", tmp_path / "tls/authority.pem")
        untrusting = tmp_path / "untrusting"
        port = service.address.rstrip("/").rpartition(":")[2]
        plain = service.address.replace("https", "http")

        def seen(home_folder: Path, *steps: tuple[str, bool]) -> list[Any]:
            profile = tmp_path / f"{home_folder.name} profile"
            return tablet.run(lambda: visits(profile, home_folder, camera, *steps))

        by_name = f"https://{NAME}:{port}/"
        trusted = seen(home_folder, (service.address, False), (by_name, False), (plain, False))
        everything = {"secure": True, "wakeLock": True, "serviceWorker": True}
        assert trusted[:2] == [everything, everything]
        assert trusted[2].strip() == f"This port requires TLS: use {service.address}"
        refused, clicked_through = seen(
            untrusting, (service.address, False), (service.address, True)
        )
        assert "ERR_CERT_AUTHORITY_INVALID" in refused
        assert clicked_through["serviceWorker"] == "SecurityError", clicked_through
