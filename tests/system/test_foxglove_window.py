"""A flown mission's log, opened in Foxglove Studio itself: its last open release, from npm."""

from __future__ import annotations

import json
import os
import shutil
import threading
from collections.abc import Iterator
from datetime import UTC, datetime
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from mcap.reader import make_reader

from tests.support.browser import Browser
from tests.support.npm import npm_package
from tests.system.demo_mission import DemoMission, syntopic

pytestmark = [pytest.mark.system, pytest.mark.timeout(400)]

PAGE = Path(__file__).parent / "foxglove"
PACKAGES = {"react": "react", "react-dom": "react-dom", "studio": "@foxglove/studio-base"}
WITHIN_S = 60.0
PROBLEMS = "[...document.querySelectorAll('button')].find(b => b.innerText.startsWith('Problems'))"


class Quiet(SimpleHTTPRequestHandler):
    """Files of a folder, without a line for each."""

    def log_message(self, format: str, *arguments: object) -> None:  # noqa: A002 (its name there)
        pass


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[str]:
    """The address Foxglove Studio is served at."""
    folder = tmp_path / "www"
    shutil.copytree(PAGE, folder)
    for name, package in PACKAGES.items():
        (folder / name).symlink_to(npm_package(package))
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=folder)) as server:
        serving = threading.Thread(target=server.serve_forever)
        serving.start()
        yield f"http://127.0.0.1:{server.server_port}/index.html"
        server.shutdown()
        serving.join(10)


def test_foxglove_opens_the_log_of_a_mission(
    flown: DemoMission, studio: str, tmp_path: Path
) -> None:
    done = syntopic("export", "foxglove", str(flown.mission), "--json")
    assert done.returncode == 0, done.stderr
    exported = json.loads(done.stdout)
    at = datetime.fromtimestamp(last_thumbnail_ns(Path(exported["file"])) * 1e-9 + 0.001, UTC)
    with Browser(tmp_path / "profile", height=1000) as browser:
        browser.open(f"{studio}?time={at:%Y-%m-%dT%H:%M:%S.%fZ}")
        browser.wait_for(shows("Waiting for first GPS point"), WITHIN_S)
        choose(browser, "[data-puppeteer-file-upload]", Path(exported["file"]))
        browser.wait_for(shows("Problems"), WITHIN_S)
        for topic, count in exported["messages"].items():
            browser.wait_for(shows(f"{topic}\tfoxglove."), WITHIN_S)
            assert f"\t{count}\t" in line_of(browser, f"{topic}\tfoxglove.")
        browser.wait_for(shows("[exposures]:\xa0exposure 12, line 1: complete"), WITHIN_S)
        assert "Waiting for" not in browser.text("#root"), "the map or the image is empty"
        browser.evaluate(f"{PROBLEMS}.click()")
        browser.wait_for(shows("No problems found"), WITHIN_S)
        if pictures_folder := os.environ.get("SYNTOPIC_PICTURES"):
            browser.picture(Path(pictures_folder) / "foxglove.png")
        assert [url for url in browser.requested if "//127.0.0.1" not in url and "://" in url] == []


def last_thumbnail_ns(log: Path) -> int:
    """When the last exposure was taken, UTC in ns since 1970."""
    with log.open("rb") as file:
        messages = make_reader(file).iter_messages(["/thumbnail"])
        return max(message.log_time for _, _, message in messages)


def shows(text: str) -> str:
    """An expression that is true where the page shows a text."""
    return f"document.getElementById('root')?.innerText.includes({json.dumps(text)})"


def line_of(browser: Browser, begun: str) -> str:
    """The line that begins like this."""
    lines = browser.text("#root").splitlines()
    return next(line for line in lines if line.startswith(begun))


def choose(browser: Browser, selector: str, file: Path) -> None:
    """A file for an input, as a person would choose it."""
    root = browser.call("DOM.getDocument")["root"]["nodeId"]
    node = browser.call("DOM.querySelector", nodeId=root, selector=selector)["nodeId"]
    browser.call("DOM.setFileInputFiles", files=[str(file.resolve())], nodeId=node)
