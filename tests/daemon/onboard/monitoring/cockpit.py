"""A flight that the test leads, seen on the operator's page."""

from __future__ import annotations

import base64
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from daemon.onboard.service.messages import ServiceEvent
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.guidance_frames import SPEED_MPS, guidance_frame
from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.support.browser import Browser
from tests.support.npm import npm_package

SIZES = ((1280, 800), (2000, 1200), (390, 844))
THEMES = ("", "dark")
MAP_SHARES = {1280: 0.65, 2000: 0.53, 390: 0.95}
"""Least share of the width of the window that the map has, by that width."""
MEASURES = Path(__file__).with_name("cockpit_measures.js")
CONTRAST = 7.0
"""Of verdict, alarms, lamps and what is left, WCAG 2.2, 1.4.6."""
DECIDED = {"color-contrast", "label-content-name-mismatch"}
"""Rules of axe whose incomplete results are decided here: `weakTexts` measures the first, where axe
cannot see through a gradient or an overlap; the second cannot compare a glyph without letters with
a name."""
FAULTS = (
    *("outside", "overlapping", "smallTexts", "smallTargets"),
    *("clipped", "cut", "weakTexts", "weakLabels"),
)
"""What no state of the page may have, by the names of `cockpit_measures.js`."""
NOON_GPS_NS = 1_466_078_418_000_000_000


Guidance = Callable[[], dict[str, Any]]
"""Makes a frame of guidance of this moment."""


def on_line(east_deg: float) -> Guidance:
    """On the first line, displaced to the east."""
    return lambda: guidance_frame(LINES, 0.4, east_deg=east_deg)


class Cockpit:
    """A service, a browser on its page, and the present state of the flight."""

    def __init__(self, service: Service, browser: Browser) -> None:
        self.service, self.browser = service, browser
        self.mono_s = 100.0

    def emit(self, *events: dict[str, Any]) -> None:
        for event in events:
            self.mono_s += 0.1
            stamped = event | {"mono_ns": str(int(self.mono_s * 1e9))}
            while not self.service.child.try_send(ServiceEvent(stamped)):
                time.sleep(0.02)

    def status(
        self,
        phase: str,
        triggers: int = 0,
        left: int = 4120,
        *,
        age_s: float = 0.2,
        speed_mps: float | None = None,
        **further: Any,
    ) -> None:
        """Send a status; `age_s` is that of the position, and who flies a line flies at 55 m/s."""
        if speed_mps is None:
            speed_mps = SPEED_MPS if phase == "flying" else 0.0
        status = flight_events.status(phase, triggers, left)
        position = status["position"] | {
            "age_s": age_s,
            "satellites": 17,
            "fix": "3d",
            "height_m": 1395.0,
        }
        position["velocity_ned_mps"] = [speed_mps, 0.0, 0.0]
        # 2026-06-21, 12:00 UTC and later: light until the evening.
        disk: dict[str, Any] = {"gps_ns": str(NOON_GPS_NS + int(self.mono_s * 1e9))}
        disk |= {"disk_free_bytes": left * 150_000_000, "exposure_bytes": 150_000_000}
        disk |= {"disk_seconds": left * 2.4 if triggers else None, "is_disk_low": left < 100}
        lines = {"flown": [], "current": "A0" if phase == "flying" else None, "next": "A1"}
        disk |= {"lines": lines, "deviations": 0}
        self.emit(status | {"position": position, "missing": []} | disk | further)

    def guide(self, guidance: Guidance | None) -> None:
        """Send a frame of guidance and wait until it is shown; without one there is none."""
        if guidance is None:
            return
        while not self.service.child.try_send(ServiceEvent(guidance())):
            time.sleep(0.02)
        self.until("document.querySelector('#guidance [data-key=line]') !== null")
        self.until("!document.querySelector('#guidance').classList.contains('stale')")

    def resize(self, width: int, height: int, theme: str = "") -> None:
        resize(self.browser, width, height, theme)

    def until(self, script: str) -> None:
        self.browser.wait_for(script, WITHIN_S)

    def touch(self, selector: str, held_s: float = 0.0) -> None:
        """One touch, where the centre of an element is seen and nothing covers it."""
        place = self.browser.evaluate(f"centre({json.dumps(selector)})")
        assert place is not None, f"{selector} is covered or not shown"
        about = {"x": place[0], "y": place[1], "button": "left", "clickCount": 1}
        self.browser.call("Input.dispatchMouseEvent", type="mousePressed", **about)
        time.sleep(held_s)
        self.browser.call("Input.dispatchMouseEvent", type="mouseReleased", **about)


def resize(browser: Browser, width: int, height: int, theme: str = "") -> None:
    """Set the size of the window, and the theme by the button of the page."""
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.call("Emulation.setDeviceMetricsOverride", **metrics)
    if browser.evaluate("document.documentElement.dataset.theme || ''") != theme:
        browser.click("#theme")
    assert browser.evaluate("document.documentElement.dataset.theme || ''") == theme
    browser.evaluate("new Promise((r) => requestAnimationFrame(() => requestAnimationFrame(r)))")


LINES = {
    f"A{k}": [[15.43 + 0.004 * k, 47.07], [15.43 + 0.004 * k, 47.082]][:: -1 if k % 2 else 1]
    for k in range(5)
}


def lines() -> dict[str, Any]:
    features = [
        {
            "type": "Feature",
            "properties": {"id": name, "strip": f"S{name[1:]}"},
            "geometry": {"type": "LineString", "coordinates": ends},
        }
        for name, ends in LINES.items()
    ]
    return {"type": "FeatureCollection", "features": features, "specification": {"sun_deg": 20.0}}


def picture_of(number: int) -> np.ndarray:
    """Fields and a road, so that a picture of the page is not noise."""
    random = np.random.default_rng(number)
    fields = random.integers((60, 90, 60), (110, 150, 120), (6, 9, 3)).astype(np.uint8)
    ground = cv2.resize(fields, (900, 600), interpolation=cv2.INTER_NEAREST)
    cv2.line(ground, (0, 80 + 40 * number), (900, 300), (170, 170, 170), 9)
    return ground


def faults_of_page(browser: Browser, width: int, phone_tab: str = "map") -> list[Any]:
    """What is wrong with the page as it is seen: measured, and findings of axe.

    Args:
        browser: with the page, resized to `width`.
        width: of the window, pixels.
        phone_tab: what a phone shows; its map covers the pages.

    Returns:
        Name and places of each fault.
    """
    browser.evaluate(MEASURES.read_text())
    if width < 500:
        browser.click(f"#tab-{phone_tab}")
    measured = browser.evaluate("measures()")
    found: list[Any] = [(fault, measured[fault]) for fault in FAULTS if measured[fault]]
    if measured["scrolls"]:
        found.append(("scrolls", True))
    share = browser.evaluate("document.querySelector('#map').clientWidth / innerWidth")
    if phone_tab == "map" and share < MAP_SHARES[width]:
        found.append(("share of the map", share))
    if measured["weakest"][1] < CONTRAST:
        found.append(("weakest", measured["weakest"]))
    return found + axe(browser)


def axe(browser: Browser) -> list[Any]:
    """Violations, and incomplete results that are not decided here.

    A page that is redrawn while axe compares places gives results of no moment, so that only those
    that a second run has as well are reported.
    """
    if not browser.evaluate("typeof axe === 'object'"):
        browser.call("Page.setBypassCSP", enabled=True)
        browser.evaluate((npm_package("axe-core") / "axe.min.js").read_text())
    first = _axe_once(browser)
    return [one for one in _axe_once(browser) if one[0] in dict(first)] if first else []


def _axe_once(browser: Browser) -> list[tuple[str, list[str]]]:
    # The rule of WCAG 2.2 is off by default.
    options = "{resultTypes: ['violations', 'incomplete'], rules: {'target-size': {enabled: true}}}"
    found = browser.evaluate(f"axe.run(document, {options})")
    assert found["testEngine"]["name"] == "axe-core"
    return [
        (one["id"], [node["html"][:120] for node in one["nodes"]][:4])
        for one in (*found["violations"], *found["incomplete"])
        if one in found["violations"] or one["id"] not in DECIDED
    ]


TILES_SHOWN = """(() => {
  const tiles = [...document.querySelectorAll('#map canvas.leaflet-tile')];
  const isDrawn = (one) => one.getContext('2d').getImageData(128, 128, 1, 1).data[3] > 0;
  const isThere = tiles.some(isDrawn) && tiles.every((one) => one.matches('.leaflet-tile-loaded'));
  const isOnline = !document.body.matches('.connection-lost, .flight-ended');
  return isThere || !isOnline || !document.querySelector('#map');
})()"""


def save_picture(browser: Browser, name: str) -> None:
    if folder := os.environ.get("SYNTOPIC_PICTURES"):
        browser.evaluate("new Promise((resolve) => setTimeout(resolve, 250))")
        browser.wait_for(TILES_SHOWN, 10.0)
        message = browser.call("Page.captureScreenshot", format="webp", quality=55)
        path = Path(folder) / f"{name}.webp"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(base64.b64decode(message["data"]))
