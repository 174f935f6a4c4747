"""A flight is started, watched and landed from the operator's page, in a real browser."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from daemon.cli.sim import Emulator, free_first_address, service_toml, simulator_arguments
from daemon.watch.tokens import add_token
from tests.browser import Browser, chromium
from tests.system.flown import ROOT, Flown

EXPOSURES = 4
READY_WITHIN_S = 180.0
FLOWN_WITHIN_S = 120.0
SEEN_WITHIN_S = 2.0


class Running:
    """A service and what it says."""

    def __init__(self, config: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "daemon", "run", str(config), "--json-lines"],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        self.events: list[dict[str, Any]] = []
        self._fresh: queue.Queue[dict[str, Any]] = queue.Queue()
        threading.Thread(target=self._hear, daemon=True).start()

    def _hear(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._fresh.put(json.loads(line))

    def wait_for(self, is_it: Callable[[dict[str, Any]], bool], within_s: float) -> dict[str, Any]:
        """The first event of a kind, whether it has come already or not."""
        deadline = time.monotonic() + within_s
        checked = 0
        while True:
            while checked < len(self.events):
                if is_it(self.events[checked]):
                    return self.events[checked]
                checked += 1
            try:
                self.events.append(self._fresh.get(timeout=deadline - time.monotonic()))
            except (queue.Empty, ValueError):
                raise AssertionError(f"not within {within_s} s: {self.events[-3:]}") from None


@pytest.fixture(scope="module")
def camera(
    tmp_path_factory: pytest.TempPathFactory, flown: Flown
) -> Iterator[tuple[Running, str, str]]:
    """A service that waits for the command to start; its page's address, and a token."""
    chromium()
    folder = tmp_path_factory.mktemp("watched")
    arguments = simulator_arguments(
        "ultracam-x-mini", folder / "sim", seed=1, dc=12.0, displace=["SU02=1.0,-0.6"]
    )
    arguments += ["--scene-cache", str(flown.scenes), "--exposures", str(EXPOSURES + 1)]
    emulator = Emulator([*arguments, "--first-address", free_first_address()])
    config = folder / "service.toml"
    text = service_toml(
        emulator.ready, root="missions", count=EXPOSURES, end_when_done=False, watch_port=0
    )
    config.write_text(text.replace("[trigger]\n", '[trigger]\nstart = "on command"\n'))
    token = add_token(folder / "tokens.toml", "operator", "command")
    service = Running(config)
    try:
        told = service.wait_for(lambda e: e["event"] == "watching", READY_WITHIN_S)
        yield service, f"http://{told['host']}:{told['port']}/", token
    finally:
        if service.process.poll() is None:
            service.process.terminate()
            service.process.wait(60)
        emulator.end()


@pytest.mark.system
@pytest.mark.timeout(600)
def test_a_flight_is_flown_from_the_page(
    camera: tuple[Running, str, str], tmp_path: Path, record_property: Callable[[str, Any], None]
) -> None:
    service, address, token = camera
    with Browser(tmp_path / "profile") as browser:
        browser.open(address)
        browser.wait_for("document.querySelector('#link')?.innerText === 'linked'", 60)
        assert browser.text("#simulated") == "SIMULATED"
        service.wait_for(lambda e: e["event"] == "ready", READY_WITHIN_S)
        browser.wait_for("document.querySelector('#phase').innerText === 'armed'", 10)

        refused = browser.evaluate(
            "fetch('/api/v1/commands/start', {method: 'POST'}).then((answer) => answer.status)"
        )
        assert refused == 401
        assert not any(e["event"] == "triggered" for e in service.events)

        browser.evaluate(f"sessionStorage.setItem('token', {json.dumps(token)})")
        browser.click("[data-command=start]")
        latencies_s = []
        for number in range(1, EXPOSURES + 1):
            browser.wait_for(
                f"/exposure ([{number}-9])/.test(document.querySelector('#verdict').innerText)",
                FLOWN_WITHIN_S,
            )
            seen_ns = time.monotonic_ns()
            fired = service.wait_for(
                lambda e, n=number: e["event"] == "triggered" and e["number"] == n, 5
            )
            latencies_s.append((seen_ns - int(fired["mono_ns"])) * 1e-9)
        record_property("trigger_to_verdict_s", [round(value, 2) for value in latencies_s])
        print(f"trigger to verdict on the page: {[round(value, 2) for value in latencies_s]} s")
        browser.wait_for("document.querySelectorAll('#rows tr').length === 4", 10)
        browser.wait_for("document.querySelector('#quicklook').naturalWidth > 0", 20)
        keep = os.environ.get("SYNTOPIC_PICTURES")
        browser.picture(Path(keep) / "page.png" if keep else tmp_path / "page.png")

        browser.evaluate("window.confirm = () => true")
        browser.click("[data-command=land]")
        ended = service.wait_for(lambda e: e["event"] == "ended", 60)
        assert ended["failure"] is None
        assert ended["ledger"]["triggers"]["lost"] == 0
        commands = [(e["name"], e["by"]) for e in service.events if e["event"] == "command"]
        assert commands == [("start", "operator"), ("land", "operator")]


@pytest.mark.system
@pytest.mark.timeout(600)
def test_a_head_that_goes_is_seen_within_two_seconds_and_acknowledged(
    tmp_path: Path, flown: Flown
) -> None:
    """The emulator is killed under a waiting service: every device is lost, and is told so."""
    chromium()
    arguments = simulator_arguments(
        "ultracam-x-mini", tmp_path / "sim", seed=1, dc=0.0, displace=[]
    )
    arguments += ["--scene-cache", str(flown.scenes), "--exposures", "2"]
    emulator = Emulator([*arguments, "--first-address", free_first_address()])
    config = tmp_path / "service.toml"
    text = service_toml(emulator.ready, root="missions", count=1, watch_port=0)
    config.write_text(text.replace("[trigger]\n", '[trigger]\nstart = "on command"\n'))
    token = add_token(tmp_path / "tokens.toml", "operator", "command")
    service = Running(config)
    try:
        told = service.wait_for(lambda e: e["event"] == "watching", READY_WITHIN_S)
        with Browser(tmp_path / "profile") as browser:
            browser.open(f"http://{told['host']}:{told['port']}/")
            browser.wait_for("document.querySelector('#link')?.innerText === 'linked'", 60)
            service.wait_for(lambda e: e["event"] == "ready", READY_WITHIN_S)
            emulator.process.kill()
            fault = service.wait_for(
                lambda e: e["event"] == "device" and e["fault"] and e["name"] == "lost", 60
            )
            name = json.dumps(f"device {fault['device']}")
            browser.wait_for(f"document.querySelector('[data-fault={name}]') !== null", 30)
            seen_s = (time.monotonic_ns() - int(fault["mono_ns"])) * 1e-9
            assert seen_s < SEEN_WITHIN_S
            browser.evaluate(f"sessionStorage.setItem('token', {json.dumps(token)})")
            browser.click(f"[data-fault={name}] button")
            # It stands still, so it stays; but somebody has seen it.
            browser.wait_for(f"document.querySelector('[data-fault={name}] button') === null", 30)
            assert "WARNING" in browser.text("#faults")
            keep = os.environ.get("SYNTOPIC_PICTURES")
            browser.picture(Path(keep) / "faults.png" if keep else tmp_path / "faults.png")
    finally:
        if service.process.poll() is None:
            service.process.terminate()
            service.process.wait(90)
        emulator.end()
