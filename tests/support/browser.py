"""A real browser under test: Debian's Chromium, headless, driven by its DevTools protocol."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import pytest

from tests.support.stopwatch import Stopwatch

START_TIMEOUT_S = 60.0
CALL_TIMEOUT_S = 60.0
FLAGS = (
    *("--headless", "--disable-gpu", "--hide-scrollbars", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--disable-extensions", "--remote-debugging-port=0", "--force-device-scale-factor=1"),
)


def chromium() -> str:
    """The program, or a visible skip."""
    found = shutil.which("chromium") or shutil.which("chromium-browser")
    if found is None:
        pytest.skip("no Chromium here; apt-get install chromium")
    return found


class Browser:
    """One page in one browser. Every request it makes is noted in `requested`."""

    def __init__(
        self,
        profile: Path,
        *,
        width: int = 1500,
        height: int = 1180,
        flags: Sequence[str] = (),
        environment: Mapping[str, str] | None = None,
    ) -> None:
        from websockets.sync.client import connect

        sandbox = ("--no-sandbox",) if os.geteuid() == 0 else ()
        self._process = subprocess.Popen(
            [
                *(chromium(), *FLAGS, *flags, *sandbox, f"--user-data-dir={profile}"),
                *(f"--window-size={width},{height}", "about:blank"),
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **(environment or {})},
        )
        port_file = profile / "DevToolsActivePort"
        watch = Stopwatch()
        while not (port_file.exists() and port_file.read_text().count("\n")):
            assert watch.is_within(START_TIMEOUT_S), "Chromium did not start"
            assert self._process.poll() is None, "Chromium ended at once"
            time.sleep(0.05)
        port = port_file.read_text().splitlines()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=30) as answer:
            pages = [one for one in json.load(answer) if one["type"] == "page"]
        self._open = ExitStack()
        self._link = self._open.enter_context(
            # Every call has a limit of its own: a browser that has no core answers no pings.
            connect(pages[0]["webSocketDebuggerUrl"], max_size=64_000_000, ping_interval=None)
        )
        self._number = 0
        self.requested: list[str] = []
        self.complaints: list[str] = []
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def __enter__(self) -> Browser:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._open.close()
        self._process.terminate()
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(20)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol; record the other messages that arrive meanwhile."""
        self._number += 1
        self._link.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        watch = Stopwatch()
        while True:
            try:
                message = json.loads(self._link.recv(timeout=5.0))
            except TimeoutError:
                assert watch.is_within(CALL_TIMEOUT_S), f"no answer to {method}"
                continue
            if message.get("id") == self._number:
                assert "error" not in message, message
                result: dict[str, Any] = message["result"]
                return result
            self._note(message)

    def open(self, address: str) -> None:
        self.call("Page.navigate", url=address)

    def evaluate(self, script: str) -> Any:
        """The value of an expression on the page."""
        message = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in message, message["exceptionDetails"]
        return message["result"].get("value")

    def wait_for(self, script: str, within_s: float) -> float:
        """Wait until an expression is true; returns how long that took, in seconds."""
        watch = Stopwatch()
        while not self.evaluate(script):
            assert watch.is_within(within_s), f"waited {watch.elapsed_s:.1f} s for {script}"
            time.sleep(0.05)
        return watch.elapsed_s

    def text(self, selector: str) -> str:
        return str(
            self.evaluate(f"document.querySelector({json.dumps(selector)})?.innerText ?? ''")
        )

    def click(self, selector: str) -> None:
        self.evaluate(f"document.querySelector({json.dumps(selector)}).click()")

    def picture(self, path: Path) -> None:
        """What is seen, as PNG."""
        message = self.call("Page.captureScreenshot", format="png")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(base64.b64decode(message["data"]))

    def _note(self, message: dict[str, Any]) -> None:
        method, content = message.get("method"), message.get("params", {})
        if method == "Network.requestWillBeSent":
            self.requested.append(content["request"]["url"])
        elif method == "Runtime.exceptionThrown":
            self.complaints.append(str(content["exceptionDetails"]))
        elif method == "Log.entryAdded" and content["entry"]["level"] == "error":
            self.complaints.append(str(content["entry"].get("text")))
