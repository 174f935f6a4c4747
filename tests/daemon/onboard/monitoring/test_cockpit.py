"""The operator's page through events of a whole flight, at three sizes and in both themes.

One service and one browser for all states, which the test sends: also those that a short flight
does not have, such as a deviation and thirty faults.
"""

from __future__ import annotations

import base64
import json
import os
import re
import signal
from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.cockpit import (
    LINES,
    SIZES,
    SPEED_MPS,
    THEMES,
    Cockpit,
    Guidance,
    faults_of_page,
    on_line,
    save_picture,
)
from tests.daemon.onboard.monitoring.cockpit_flight import (
    HEADS,
    MISSING,
    cockpit_in,
    degrade,
    expose,
    opened,
    prepare,
)
from tests.daemon.onboard.monitoring.guidance_frames import approach_frame
from tests.support.browser import chromium


@pytest.fixture(scope="module")
def cockpit(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cockpit]:
    chromium()
    with cockpit_in(tmp_path_factory.mktemp("cockpit")) as cockpit:
        yield cockpit


PICTURED = "deviation"
"""The others are pictured in a flight of `tests/system/test_cockpit_in_flight.py`."""


def check(
    cockpit: Cockpit,
    state: str,
    guidance: Guidance | None = None,
    *,
    phone_tab: str = "map",
) -> None:
    """Measure the page at each size and in each theme.

    `phone_tab` is what a phone shows, whose map covers the pages.
    """
    browser = cockpit.browser
    for width, height in SIZES:
        for theme in THEMES:
            cockpit.resize(width, height, theme)
            cockpit.guide(guidance)
            found = faults_of_page(browser, width, phone_tab)
            assert found == [], f"{state} at {width}x{height} {theme or 'light'}: {found}"
        if state == PICTURED:
            cockpit.resize(width, height)
            cockpit.guide(guidance)
            save_picture(browser, f"{state}-{width}")
    cockpit.resize(1280, 800)


def test_before_arming(cockpit: Cockpit) -> None:
    prepare(cockpit)
    # PAN ends at half of full scale and asks for half as much time again. Red is saturated.
    cockpit.until("document.querySelector('#exposure-suggestion').innerText.includes('6000 µs')")
    assert "R: 2000 µs" in cockpit.browser.text("#exposure-suggestion [data-group=R]")
    cockpit.until("document.querySelector('[data-check=test].good') !== null")
    assert cockpit.browser.text("#phase-button") == "Arm"
    cockpit.browser.evaluate("window.test = document.querySelector('#test-exposure')")
    cockpit.status("ready", triggers=1, left=4100, missing=MISSING)
    cockpit.until("document.querySelector('[data-check=disk]').innerText.includes('615')")
    assert cockpit.browser.evaluate("window.test.isConnected")
    cockpit.status("ready", triggers=1, missing=MISSING)
    check(cockpit, "before-arming")


def test_on_a_line(cockpit: Cockpit) -> None:
    expose(cockpit, 2, 6)
    cockpit.status("flying", triggers=6)
    cockpit.until("document.querySelector('#phase-button').innerText === 'Stop line'")
    cockpit.until("document.querySelector('#left-lines').innerText.includes('of 5')")
    cockpit.until("document.querySelector('#left-light').innerText.includes('until 16:')")
    cockpit.until("/^\\d/.test(document.querySelector('#left-end dd').innerText)")
    assert "GB" in cockpit.browser.text("#left-disk")
    assert "min" in cockpit.browser.text("#left-disk") or " h " in cockpit.browser.text(
        "#left-disk"
    )
    cockpit.until("document.querySelectorAll('#strip .thumb img[src]').length === 6")
    cockpit.until("document.querySelectorAll('#map canvas[data-map]').length > 0")
    cockpit.until("document.querySelectorAll('#map .placed').length === 6")
    cockpit.until("/^\\d+ s ago$/.test(document.querySelector('#verdict .since').innerText)")
    check(cockpit, "on-a-line", on_line(0.00005))
    assert cockpit.browser.text("#guidance [data-key=height] .g-label") == "Height −40/+60 m"
    for lamp, value in (
        ("time", "GPS"),
        ("position", "17 sat."),
        ("disk", "618 GB"),
        ("processing", "0 waiting"),
    ):
        assert cockpit.browser.text(f"#lamp-{lamp} .value") == value


def map_light(cockpit: Cockpit) -> float:
    """Mean luminance of the map at its left edge, where nothing covers the base map, 0 to 255."""
    x, y, height = cockpit.browser.evaluate(
        "(() => { const b = document.querySelector('#map').getBoundingClientRect();"
        " return [b.left, b.top, b.height]; })()"
    )
    clip = {"x": x + 80, "y": y + 0.4 * height, "width": 120, "height": 0.2 * height, "scale": 1}
    shot = cockpit.browser.call("Page.captureScreenshot", format="png", clip=clip)
    coded = np.frombuffer(base64.b64decode(shot["data"]), np.uint8)
    return float(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE).mean())


PIXELS_OF = """((colours) => {
  const canvas = document.querySelector('.leaflet-plan-pane canvas');
  const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
  return colours.map(([r, g, b]) => {
    let n = 0;
    for (let i = 0; i < data.length; i += 4)
      if (data[i] === r && data[i + 1] === g && data[i + 2] === b && data[i + 3] === 255) n += 1;
    return n;
  });
})"""
ACCENTS = [[0, 56, 124], [163, 202, 255]]
"""Of the line that is flown, by day and by night."""


def test_the_map_has_the_theme_of_the_page(cockpit: Cockpit) -> None:
    lights = []
    for k, theme in enumerate(THEMES):
        cockpit.resize(1280, 800, theme)
        cockpit.until("document.querySelectorAll('#map canvas[data-map]').length > 0")
        pixels = cockpit.browser.evaluate(f"{PIXELS_OF}({json.dumps(ACCENTS)})")
        assert pixels[k] > 100 and pixels[1 - k] == 0, (theme, pixels)
        lights.append(map_light(cockpit))
    day, night = lights
    assert day > 60.0, "the base map is seen"
    assert night < 0.6 * day
    cockpit.resize(1280, 800)


def acknowledge(cockpit: Cockpit, alarm: str) -> None:
    cockpit.service.commands.clear()
    cockpit.browser.click(f"{alarm} .acknowledge")
    cockpit.service.until(lambda: [c.name for c in cockpit.service.commands] == ["acknowledge"])
    # The answer of the service is shown for some seconds.
    cockpit.until("document.querySelector('#answer').textContent !== ''")
    cockpit.until("document.querySelector('#answer').textContent === ''")


def test_a_deviation_beyond_its_limit_is_an_alarm(cockpit: Cockpit) -> None:
    sentence = "38 m right of line A0 (limit 25 m). Steer left"
    event = {"event": "deviation", "fault": True, "line": "A0", "exceeded": ["across"]}
    event |= {"across_m": 38.0, "across_ahead_m": 38.0, "height_deviation_m": 0.0, "count": 1}
    cockpit.emit(event | {"sentence": sentence})
    cockpit.until("document.body.dataset.sounding === 'warning'")
    assert "38 m right of line A0" in cockpit.browser.text("#alarm-bar .what")
    check(cockpit, "deviation", on_line(0.0005))
    assert cockpit.browser.evaluate(
        "document.querySelector('#guidance [data-key=across]').classList.contains('exceeded')"
    )
    cockpit.emit({"event": "deviation", "fault": False, "line": "A0", "sentence": "It is over."})
    cockpit.until("document.body.dataset.sounding === ''")
    acknowledge(cockpit, "#faults")
    cockpit.until("document.querySelector('#alarm-bar').hidden")


def test_between_lines(cockpit: Cockpit) -> None:
    expose(cockpit, 7, 9)
    lines = {"flown": ["A0"], "current": None, "next": "A1"}
    cockpit.status("armed", triggers=9, speed_mps=SPEED_MPS, lines=lines)
    cockpit.until("document.querySelector('#phase-button').innerText === 'Start line'")
    assert cockpit.browser.text("#phase-second") == "Land"
    check(cockpit, "between-lines", lambda: approach_frame(LINES))
    for key, label, value in (
        ("line", "Next line", "A1"),
        ("bearing", "Bearing · distance", "190° · 1219 m"),
        ("height", "Height −40/+60 m", "−4 m"),
        ("start", "To start", "1201 m · 0:22"),
        ("countdown", "Next of 18", "22.2 s"),
        ("turn", "Turn onto A2", "↰ 180° · 304 m"),
        ("speed", "Speed", "107 kn"),
    ):
        assert cockpit.browser.text(f"#guidance [data-key={key}] .g-label") == label
        assert cockpit.browser.text(f"#guidance [data-key={key}] .g-value") == value
    assert not cockpit.browser.evaluate(
        "document.querySelector('#guidance .g-bar').checkVisibility()"
    )
    assert "on the ground" not in cockpit.browser.text("#left")


def test_degraded_with_many_faults(cockpit: Cockpit) -> None:
    """Without a receiver neither the position nor guidance is new."""
    degrade(cockpit)
    for lamp, state in (
        ("heads", "warning"),
        ("disk", "warning"),
        ("position", "warning"),
        ("trigger", "good"),
    ):
        cockpit.until(f"document.querySelector('#lamp-{lamp}').classList.contains('{state}')")
    assert cockpit.browser.text("#lamp-position .value") == "8 s old"
    assert cockpit.browser.text("#lamp-disk .value") == "1 min"
    assert cockpit.browser.evaluate("document.body.dataset.sounding") == "warning"
    # The right quarter of exposure 9 has no data, and that is hatched where it is.
    cockpit.until("document.querySelectorAll('#map path.no-data').length === 1")
    hatched, image = cockpit.browser.evaluate(
        "[document.querySelector('#map path.no-data'),"
        " [...document.querySelectorAll('#map .placed')]"
        ".sort((a, b) => a.getBoundingClientRect().top - b.getBoundingClientRect().top)[0]]"
        ".map((one) => one.getBoundingClientRect()).map((one) => [one.left, one.top, one.right,"
        " one.bottom])"
    )
    width = image[2] - image[0]
    assert hatched[0] == pytest.approx(image[0] + 0.75 * width, abs=3.0)
    assert hatched[1:] == pytest.approx(image[1:], abs=3.0)
    assert "no-data-hatch" in cockpit.browser.evaluate(
        "getComputedStyle(document.querySelector('#map path.no-data')).fill"
    )
    cockpit.until("document.querySelector('#guidance').classList.contains('lost')")
    cockpit.until("document.querySelector('.aircraft-mark .old') !== null")
    check(cockpit, "degraded")


def test_an_alarm_is_acknowledged_by_name_and_reports_the_end_of_its_cause(
    cockpit: Cockpit,
) -> None:
    item = "document.querySelector('[data-fault=\"device gnss\"]')"
    cockpit.until(f"{item} !== null")
    acknowledge(cockpit, "[data-fault='device gnss']")
    cockpit.until(f"{item}.innerText.includes('acknowledged by operator (administrator)')")
    item = "document.querySelector('[data-fault=\"device SU03\"]')"
    cockpit.emit(flight_events.recovered("SU03"))
    cockpit.until(f"{item}.innerText.includes('cause is gone')")


def test_the_link_is_lost_and_comes_back_by_itself(cockpit: Cockpit) -> None:
    pid = cockpit.service.child.process.pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    try:
        cockpit.until("document.body.classList.contains('connection-lost')")
        assert "Connection lost" in cockpit.browser.text("#connection-lost")
        assert "warning" in cockpit.browser.evaluate(
            "document.querySelector('#lamp-link').className"
        )
        check(cockpit, "link-lost")
    finally:
        os.kill(pid, signal.SIGCONT)
    cockpit.until("!document.body.classList.contains('connection-lost')")
    cockpit.until("document.querySelector('#lamp-link').classList.contains('good')")


def test_after_landing_the_summary_stays_without_an_alarm(cockpit: Cockpit) -> None:
    browser = cockpit.browser
    browser.click("#strip .thumb:nth-child(3)")
    browser.click("#tab-alarms")
    for device in ("SU05", "SU06", "gnss"):
        cockpit.emit(flight_events.recovered(device))
    cockpit.emit(*opened(*HEADS), {"event": "device", "device": "gnss", "name": "fixed"})
    cockpit.emit({"event": "phase", "phase": "landed"})
    cockpit.status("landed", triggers=9)
    cockpit.until("document.querySelector('#landing').checkVisibility()")
    cockpit.until("document.querySelectorAll('[data-file]').length === 4")
    cockpit.emit({"event": "landing", "folders": ["/media/a"], "poweroff": ""})
    cockpit.until("document.querySelector('[data-action=verify]') !== null")
    actions = ("verify", "copy", "report", "shutdown", "new-mission")
    for action in actions:
        assert (
            browser.evaluate(f"document.querySelector('[data-action={action}]').disabled") is False
        )
    # The time of the summary goes on; a button that were made again would lose a touch.
    browser.evaluate("window.verify = document.querySelector('[data-action=verify]')")
    shown = browser.text("[data-summary=time]")
    cockpit.mono_s += 5.0
    cockpit.status("landed", triggers=9)
    cockpit.until(
        f"document.querySelector('[data-summary=time]').innerText !== {json.dumps(shown)}"
    )
    assert browser.evaluate("window.verify.isConnected")
    check(cockpit, "landed", phone_tab="flight")
    cockpit.service.end()
    cockpit.until("document.body.classList.contains('flight-ended')")
    assert not browser.evaluate("document.body.classList.contains('connection-lost')")
    # What only the service can do is no longer offered.
    assert browser.evaluate("document.querySelector('[data-action]')") is None
    lamp = browser.evaluate("document.querySelector('#lamp-link').className")
    assert "off" in lamp
    assert browser.evaluate("document.querySelector('#alarm-bar').hidden")
    assert browser.text("#connection-lost").startswith("Landed. The service ended ")
    summary = browser.text("#landing")
    for expected in ("● 7 ▲ 1 ■ 1", "GeoJSON", "KML", "MAVLink", "CSV", "GPS 1466078"):
        assert expected in summary, expected
    # Noon and the seconds of this flight, without the 18 leap seconds of GPS time.
    time_of = browser.text("[data-summary=time]")
    assert re.search(r"\b12:0\d:\d\d UTC · GPS 1466078\d{3} s", time_of), time_of
    csv = browser.evaluate("(async () => (await import('/landing.js')).textOf('fly-again.csv'))()")
    assert csv.startswith("line,strip,kind,from_m")
    assert browser.text("#image-which") == "7", "the selection outlives a lost connection"
    assert not browser.evaluate("document.querySelector('#quicklook').hidden")
    assert browser.evaluate("document.querySelector('#guidance').hidden")
    check(cockpit, "after-landing", phone_tab="flight")
    browser.open(cockpit.service.address)
    cockpit.until("document.querySelector('#phase-button')?.innerText === 'Starting'")
    cockpit.until("document.querySelector('#lamp-link .name')?.innerText === 'Link'")
    outside = [url for url in browser.requested if not url.startswith(("data:", "blob:"))]
    assert all(url.replace("ws:", "http:").startswith(cockpit.service.address) for url in outside)
