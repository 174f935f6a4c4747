"""The operator's page in a real browser, fed by the real watch process."""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daemon.configuration import WatchSection
from daemon.messages import Answer, Command, Stop, Told
from daemon.processes import Child
from daemon.watch.tokens import add_token
from tests.browser import Browser, chromium
from tests.daemon.watch import flown

WITHIN_S = 30.0


class Service:
    """The service's end of the watch process, in the hands of the test."""

    def __init__(self, folder: Path) -> None:
        self.token = add_token(folder / "tokens.toml", "operator", "command")
        settings = WatchSection(port=0, tokens=folder / "tokens.toml", announce=False)
        self.child = Child("watch", "daemon.watch.process:main", (settings,), {})
        self.commands: list[Command] = []
        self.address = ""
        self.until(lambda: bool(self.address))

    def tell(self, event: dict[str, Any]) -> None:
        assert self.child.tell(Told(event))

    def until(self, is_so: Any, within_s: float = 60.0) -> None:
        deadline = time.monotonic() + within_s
        while not is_so():
            assert time.monotonic() < deadline, "the watch process is silent"
            if self.child.connection.poll(0.05):
                self.hear(self.child.connection.recv())

    def hear(self, message: object) -> None:
        if isinstance(message, Told) and message.event.get("event") == "watching":
            self.address = f"http://{message.event['host']}:{message.event['port']}/"
        elif isinstance(message, Command):
            self.commands.append(message)
            self.child.send(Answer(message.number, True, "done as asked"))

    def end(self) -> None:
        self.child.send(Stop())
        self.child.end(10.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    import cv2

    chromium()
    folder = tmp_path_factory.mktemp("page")
    product = folder / "mission/L2"
    random = np.random.default_rng(1)
    for number in (1, 2, 3):
        (product / f"{number:06d}").mkdir(parents=True)
        picture = cv2.resize(random.integers(30, 220, (24, 36, 3), dtype=np.uint8), (900, 600))
        cv2.imwrite(str(product / f"{number:06d}/quicklook.jpg"), picture)
    (folder / "mission/L0").mkdir()
    from processing.rig import shipped_rigs

    rig = shipped_rigs()["ultracam-x-mini"].read_bytes()
    (folder / "mission/rig.toml").write_bytes(rig)
    (folder / "mission/service.toml").write_text("[plan]\nground_height_m = 395.0\n")
    return folder


@pytest.fixture(scope="module")
def service(folder: Path) -> Iterator[Service]:
    service = Service(folder)
    service.tell(flown.mission(str(folder / "mission")))
    yield service
    service.end()


@pytest.fixture(scope="module")
def browser(folder: Path, service: Service) -> Iterator[Browser]:
    with Browser(folder / "profile") as browser:
        browser.open(service.address)
        browser.wait_for("document.querySelector('#link')?.innerText === 'linked'", WITHIN_S)
        yield browser


def test_a_flight_is_seen_as_it_happens(service: Service, browser: Browser) -> None:
    service.tell(flown.status(triggers=0))
    for number, verdict in ((1, "good"), (2, "usable"), (3, "refly")):
        for event in flown.exposure(number, verdict):
            service.tell(event)
        service.tell(flown.status(triggers=number))
        browser.wait_for(
            f"document.querySelector('#verdict').innerText.includes('exposure {number}')", WITHIN_S
        )
        assert verdict.upper() in browser.text("#verdict").upper()
    assert browser.text("#simulated") == "SIMULATED"
    assert browser.text("#triggers") == "3"
    assert browser.evaluate("document.querySelectorAll('#rows tr').length") == 3
    browser.wait_for("document.querySelectorAll('#map path').length >= 4", WITHIN_S)
    browser.wait_for("document.querySelector('#quicklook').naturalWidth === 900", WITHIN_S)
    browser.wait_for("document.querySelectorAll('.uplot').length === 3", WITHIN_S)


def test_a_fault_is_seen_within_two_seconds_and_acknowledged_with_a_token(
    service: Service, browser: Browser
) -> None:
    service.tell(flown.lost("SU02"))
    seen_s = browser.wait_for("document.querySelector('#faults li.stands') !== null", WITHIN_S)
    assert seen_s < 2.0
    assert "WARNING" in browser.text("#faults")
    assert "SU02 does not answer; look at its cable." in browser.text("#faults")
    service.tell(flown.recovered("SU02"))
    browser.wait_for("document.querySelector('#faults li.passed') !== null", WITHIN_S)
    # Nobody has shown a token yet: the page asks for one, and nothing is commanded.
    browser.click("#faults button")
    browser.wait_for("document.querySelector('#ask-token').open", WITHIN_S)
    browser.evaluate(f"document.querySelector('#token').value = {json.dumps(service.token)}")
    browser.click("#ask-token button[value=use]")
    service.until(lambda: [c.name for c in service.commands] == ["acknowledge"])
    browser.wait_for("document.querySelector('#faults li.none') !== null", WITHIN_S)
    assert service.commands[0].by == "operator"


def test_a_wrong_token_is_refused_in_words(service: Service, browser: Browser) -> None:
    before = len(service.commands)
    browser.evaluate("sessionStorage.setItem('token', 'guess')")
    browser.click("[data-command=start]")
    browser.wait_for("document.querySelector('#answer').innerText !== ''", WITHIN_S)
    browser.wait_for("document.querySelector('#answer').innerText.includes('not known')", WITHIN_S)
    assert len(service.commands) == before
    browser.evaluate(f"sessionStorage.setItem('token', {json.dumps(service.token)})")
    browser.click("[data-command=start]")
    service.until(lambda: service.commands[-1].name == "start")


def test_image_zooms_by_keyboard_and_the_cabin_gets_dark(browser: Browser) -> None:
    before = browser.evaluate("document.querySelector('#quicklook').style.transform")
    browser.evaluate(
        "document.querySelector('#image').dispatchEvent(new KeyboardEvent('keydown', {key: '+'}))"
    )
    assert browser.evaluate("document.querySelector('#quicklook').style.transform") != before
    browser.click("#theme")
    assert browser.evaluate("document.documentElement.dataset.theme") == "dark"
    dark = browser.evaluate("getComputedStyle(document.body.parentElement).backgroundColor")
    assert dark == "rgb(11, 15, 18)"


def test_nothing_leaves_the_host_and_nothing_breaks(service: Service, browser: Browser) -> None:
    outside = [url for url in browser.requested if not url.startswith(("data:", "blob:"))]
    assert outside
    assert all(url.replace("ws:", "http:").startswith(service.address) for url in outside), outside
    # The wrong token's refusal and the residuals that are not there are told by the browser, too.
    broken = [c for c in browser.complaints if "401" not in c and "404" not in c]
    assert broken == []


def test_axe_finds_nothing_serious(browser: Browser, tmp_path: Path) -> None:
    axe = _axe(tmp_path)
    browser.call("Page.setBypassCSP", enabled=True)
    for theme in ("dark", ""):
        browser.evaluate(f"document.documentElement.dataset.theme = '{theme}'")
        browser.evaluate(axe.read_text())
        found = browser.evaluate("axe.run(document, {resultTypes: ['violations']})")
        grave = [
            (one["id"], [node["html"][:120] for node in one["nodes"]])
            for one in found["violations"]
            if one["impact"] in ("serious", "critical")
        ]
        assert grave == [], f"theme {theme or 'light'}"


def test_a_picture_is_taken(browser: Browser, tmp_path: Path) -> None:
    keep = os.environ.get("SYNTOPIC_PICTURES")
    path = Path(keep) / "page-test.png" if keep else tmp_path / "page.png"
    browser.picture(path)
    assert path.stat().st_size > 20_000


def _axe(folder: Path) -> Path:
    """axe-core from npm, or a visible skip."""
    packed = (
        subprocess.run(
            ["npm", "pack", "axe-core@4", "--silent"],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=100,
            check=False,
        )
        if _has_npm()
        else None
    )
    if packed is None or packed.returncode != 0:
        pytest.skip("axe-core is not to be had; apt-get install npm, and a network is needed")
    subprocess.run(["tar", "xzf", packed.stdout.strip()], cwd=folder, check=True, timeout=60)
    return folder / "package" / "axe.min.js"


def _has_npm() -> bool:
    import shutil

    return shutil.which("npm") is not None
