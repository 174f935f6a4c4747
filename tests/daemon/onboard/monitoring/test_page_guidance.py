"""Map, guidance, strip, full resolution and manual verdicts on the page, in a real browser."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from daemon.mission.store.level0 import tiff_parts
from processing.rig import shipped_rigs
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.guidance_frames import guidance_frame, vector_map
from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.daemon.onboard.monitoring.test_base_maps import geotiff
from tests.support.browser import Browser, chromium

LINES = {"A1": [[15.43, 47.07], [15.43, 47.08]], "A2": [[15.434, 47.08], [15.434, 47.07]]}
MARKED_RED = (
    "(() => { const c = [...document.querySelectorAll('#deep canvas')]; return c.some((one) => {"
    " const d = one.getContext('2d').getImageData(0, 0, 256, 256).data;"
    " for (let i = 0; i < d.length; i += 4)"
    "   if (d[i] === 255 && d[i + 1] === 0 && d[i + 3] > 200) return true;"
    " return false; }); })()"
)


def frame(along_share: float, east_deg: float = 0.0, height_m: float = 1395.0) -> dict[str, Any]:
    return guidance_frame(LINES, along_share, east_deg=east_deg, height_m=height_m)


def status(triggers: int) -> dict[str, Any]:
    lines = {"flown": [], "current": "A1", "next": "A2"}
    return flight_events.status(triggers=triggers) | {"lines": lines, "deviations": 0}


def write_products(mission: Path) -> None:
    random = np.random.default_rng(1)
    for number in range(1, 7):
        folder = mission / f"L2/{number:06d}"
        folder.mkdir(parents=True)
        pan = cv2.resize(random.integers(3000, 20000, (60, 90), dtype=np.uint16), (1800, 1200))
        pan[100:150, 200:260] = 32768
        (folder / "pan.tif").write_bytes(
            b"".join(bytes(p) for p in tiff_parts([pan], {"bands": ["pan"]}))
        )
        shown = (pan / 110).clip(0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / "quicklook.jpg"), cv2.resize(shown, (900, 600)))
        cv2.imwrite(str(folder / "thumbnail.jpg"), cv2.resize(shown, (200, 133)))
        vectors = [
            [c, r, 0.05, -0.02, 0] for c in range(100, 1800, 300) for r in range(100, 1200, 300)
        ]
        residuals = {"width_px": 1800, "height_px": 1200, "overlaps": [], "vectors": vectors}
        (folder / "residuals.json").write_text(json.dumps(residuals))
        (folder / "histogram.json").write_text(json.dumps({"SU00": [1] * 64}))


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    chromium()
    folder = tmp_path_factory.mktemp("guidance")
    mission = folder / "mission"
    (mission / "L0").mkdir(parents=True)
    write_products(mission)
    (mission / "rig.toml").write_bytes(shipped_rigs()["ultracam-x-mini"].read_bytes())
    features = [
        {"type": "Feature", "properties": {"id": name, "strip": name},
         "geometry": {"type": "LineString", "coordinates": at}}
        for name, at in LINES.items()
    ]  # fmt: skip
    plan = {"type": "FeatureCollection", "features": features}
    (mission / "plan.geojson").write_text(json.dumps(plan))
    (mission / "service.toml").write_text("[plan]\nground_height_m = 395.0\n")
    roads = vector_map(folder)
    ground = np.tile(np.linspace(40, 220, 400).astype(np.uint8), (400, 1))
    ortho = geotiff(folder / "ortho.tif", ground)
    service = Service(folder, maps=(roads, ortho))
    service.emit(flight_events.mission(str(mission)))
    for number, verdict in enumerate(("good", "usable", "refly", "good", "good", "good"), start=1):
        for event in flight_events.exposure(number, verdict, line="A1", north_m=68.0 * number):
            service.emit(event)
    service.emit(status(6))
    yield service
    service.end()


@pytest.fixture(scope="module")
def browser(service: Service, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    folder = tmp_path_factory.mktemp("browser")
    with Browser(folder / "profile", width=1280, height=800) as browser:
        browser.open(service.address)
        browser.wait_for("document.querySelector('#link')?.innerText === 'connected'", WITHIN_S)
        browser.evaluate(f"sessionStorage.setItem('token', {json.dumps(service.token)})")
        yield browser


def pressed(service: Service, browser: Browser, selector: str, name: str) -> dict[str, Any]:
    """Arguments of the command that a button sends."""
    service.commands.clear()
    browser.click(selector)
    service.until(lambda: any(one.name == name for one in service.commands))
    return dict(service.commands[-1].arguments)


def test_guidance_is_shown_with_its_age_and_grays(service: Service, browser: Browser) -> None:
    service.emit(frame(0.3))
    browser.wait_for(
        "document.querySelector('#guidance [data-key=line] .g-value') !== null", WITHIN_S
    )
    assert browser.text("#guidance [data-key=line] .g-value") == "A1"
    assert browser.text("#guidance [data-key=turn] .g-value").startswith("↱ 180°")
    service.emit(frame(0.31, east_deg=0.0005))
    browser.wait_for(
        "document.querySelector('#guidance [data-key=across].exceeded') !== null", WITHIN_S
    )
    assert "▶" in browser.text("#guidance [data-key=across] .g-value")
    browser.wait_for("document.querySelector('#guidance').classList.contains('stale')", WITHIN_S)
    age_s = float(browser.text("#guidance .age").split()[0])
    assert age_s > 1.0
    service.emit(frame(0.32))
    browser.wait_for("!document.querySelector('#guidance').classList.contains('stale')", WITHIN_S)


def test_the_strip_shows_the_last_exposures_with_verdict(browser: Browser) -> None:
    browser.wait_for("document.querySelectorAll('#strip .thumb img[src]').length === 6", WITHIN_S)
    assert browser.text("#strip .thumb .t-mark") == "● 6"
    assert browser.evaluate("document.querySelectorAll('#strip .thumb.refly').length") == 1


def test_base_maps_are_drawn_below_the_lines(browser: Browser) -> None:
    browser.wait_for("document.querySelectorAll('#map-choice option').length === 3", WITHIN_S)
    browser.wait_for(
        "document.querySelectorAll('#map canvas[data-map=\"0\"]').length > 0", WITHIN_S
    )
    water = (
        "[...document.querySelectorAll('#map canvas[data-map=\"0\"]')].some((c) => {"
        " const d = c.getContext('2d').getImageData(200, 200, 1, 1).data;"
        " return d[0] === 0xb7 && d[2] === 0xea; })"
    )
    browser.wait_for(water, WITHIN_S)
    assert browser.text("#map-attribution") == "made up"
    browser.wait_for("document.querySelectorAll('#map .placed').length === 6", WITHIN_S)
    browser.click("#map-thumbnails")
    browser.wait_for("document.querySelectorAll('#map .placed').length === 0", WITHIN_S)
    browser.click("#map-thumbnails")


def choose_map(browser: Browser, number: str) -> None:
    browser.evaluate(
        "(() => { const one = document.querySelector('#map-choice');"
        f" one.value = '{number}'; one.dispatchEvent(new Event('change')); }})()"
    )


def test_a_tile_that_is_refused_is_asked_for_again(browser: Browser) -> None:
    browser.evaluate(
        "window.refused = []; window.given = []; window.realFetch = window.fetch;"
        "window.fetch = (address, options) => {"
        " if (!String(address).includes('/maps/0/')) return window.realFetch(address, options);"
        " if (window.refused.length < 3) {"
        "   window.refused.push(address); return Promise.reject(new TypeError('lost')); }"
        " window.given.push(address); return window.realFetch(address, options); }; true"
    )
    choose_map(browser, "")
    choose_map(browser, "0")
    browser.wait_for("window.refused.length === 3", WITHIN_S)
    browser.wait_for("window.refused.every((one) => window.given.includes(one))", WITHIN_S)
    browser.evaluate("window.fetch = window.realFetch; true")


def test_only_pictures_are_dimmed_at_night(browser: Browser) -> None:
    """Vector tiles have a style of their own."""
    dimmed = "document.querySelector('.leaflet-ground-pane .leaflet-layer.raster') !== null"
    assert not browser.evaluate(dimmed)
    choose_map(browser, "1")
    assert browser.evaluate(dimmed)
    choose_map(browser, "0")


def limits_shown(browser: Browser, below_m: float | None, above_m: float | None) -> Any:
    """The label of the height for limits of a frame."""
    limits = json.dumps({"across_m": 25.0, "below_m": below_m, "above_m": above_m})
    return browser.evaluate(
        "import('/guidance_view.js').then(({cellsOf}) => cellsOf({exceeded: [], is_captured: true,"
        f" across_m: 0, line: 'A', limits: {limits}}}).find((one) => one.key === 'height').label)"
    )


def test_the_label_of_the_height_has_the_limits_that_there_are(browser: Browser) -> None:
    assert limits_shown(browser, 40.0, 60.0) == "Height −40/+60 m"
    assert limits_shown(browser, 40.0, None) == "Height ≥ −40 m"
    assert limits_shown(browser, None, 60.0) == "Height ≤ +60 m"
    assert limits_shown(browser, None, None) == "Height"


def test_a_way_is_measured(browser: Browser) -> None:
    browser.click("#map-measure")
    box = browser.evaluate(
        "(() => { const b = document.querySelector('#map').getBoundingClientRect();"
        " return [b.left + b.width / 2, b.top + b.height / 2]; })()"
    )
    for x in (box[0] - 60, box[0] + 60):
        for kind in ("mousePressed", "mouseReleased"):
            browser.call(
                "Input.dispatchMouseEvent", type=kind, x=x, y=box[1], button="left", clickCount=1
            )
        time.sleep(0.3)  # a second click within the time of a double click zooms
    browser.wait_for(
        "document.querySelector('#map-measured').textContent.includes('90°')", WITHIN_S
    )
    # The clicks lie on footprints; measuring selects none of them.
    assert browser.evaluate("import('/feed.js').then(({feed}) => feed.isFollowing)")
    browser.click("#map-measure")


def test_full_resolution_is_read_on_request_only(browser: Browser) -> None:
    assert not any("/api/v1/images/" in one for one in browser.requested)
    browser.click("#strip .thumb:last-child")
    browser.wait_for("!document.querySelector('#image-panel').hidden", WITHIN_S)
    browser.click("#full-resolution")
    browser.wait_for("document.querySelectorAll('#deep canvas').length > 0", WITHIN_S)
    browser.wait_for("document.querySelector('[data-overlay=saturation]') !== null", WITHIN_S)
    browser.click("[data-overlay=saturation]")
    browser.wait_for(MARKED_RED, WITHIN_S)
    browser.click("[data-overlay=residuals]")
    browser.wait_for("document.querySelectorAll('#deep svg path').length === 24", WITHIN_S)
    browser.wait_for("true", WITHIN_S)
    asked = [one for one in browser.requested if "/api/v1/images/1/pan/" in one]
    assert asked


def test_full_resolution_is_that_of_the_selected_exposure(
    service: Service, browser: Browser
) -> None:
    """Neither tiles of the one before remain, nor does a late answer bring them back."""
    for event in flight_events.exposure(7, line="A1", north_m=476.0):
        service.emit(event)
    browser.wait_for("document.querySelectorAll('#strip .thumb').length === 7", WITHIN_S)
    browser.click("#strip .thumb:first-child")
    browser.click("#full-resolution")
    browser.wait_for(
        "document.querySelector('#deep-tools').innerText.includes('no image of full')", WITHIN_S
    )
    assert browser.evaluate("document.querySelectorAll('#deep canvas, #deep path').length") == 0
    browser.evaluate(
        "const real = window.fetch; window.fetch = async (address, options) => {"
        " const answer = await real(address, options);"
        " if (String(address).endsWith('/images/5')) await new Promise((r) => setTimeout(r, 600));"
        " return answer; }; true"
    )
    for child in (3, 5):
        browser.click(f"#strip .thumb:nth-child({child})")
        browser.click("#full-resolution")
    browser.wait_for("document.querySelectorAll('#deep canvas').length > 0", WITHIN_S)
    time.sleep(1.0)  # the answer for exposure 5 has come meanwhile
    assert any("/images/3/pan/" in one for one in browser.requested)
    assert not any("/images/5/pan/" in one for one in browser.requested)
    browser.click("#full-resolution")


def test_manual_verdict_and_retake_are_two_touches(service: Service, browser: Browser) -> None:
    browser.click("#strip .thumb:nth-child(4)")
    browser.wait_for("document.querySelector('#manual-state').textContent.includes('4')", WITHIN_S)
    assert pressed(service, browser, "#manual-reject", "reject")["number"] == 4
    manual = {"kind": "reject", "by": "anna", "role": "operator", "reason": ""}
    manual["utc"] = "2026-05-01T10:00:00Z"
    service.emit({"event": "manual-verdict", "number": 4, "manual": manual})
    browser.wait_for("document.querySelector('#strip .thumb.good.reject') !== null", WITHIN_S)
    assert "anna" in browser.text("#manual-state")
    browser.click("#manual-accept")
    browser.wait_for(
        "document.querySelector('#manual-reason[aria-invalid=true]') !== null", WITHIN_S
    )
    browser.evaluate("document.querySelector('#manual-reason').value = 'sharp enough'")
    given = pressed(service, browser, "#manual-accept", "accept")
    assert (given["number"], given["reason"]) == (4, "sharp enough")
    retake = pressed(service, browser, "#manual-retake", "retake")
    assert (retake["line"], retake["number"]) == ("A1", 4)
    assert retake["from_m"] == retake["to_m"] == pytest.approx(4 * 68.0, abs=3.0)
    at = [[47.072, 15.43], [47.073, 15.43]]
    service.emit(
        {"event": "retake", "line": "A1 R1", "of": "A1", "number": 4, "at": at, "places_m": [5.0]}
    )
    browser.wait_for(
        "import('/map.js').then((map) => map.planShown().retake.join() === '↻ A1 R1')", WITHIN_S
    )


def test_the_pilot_sees_guidance_alone(service: Service, browser: Browser, tmp_path: Path) -> None:
    browser.open(f"{service.address}pilot")
    for k in range(5):
        service.emit(frame(0.4 + 0.01 * k, height_m=1340.0))
        time.sleep(0.1)
    browser.wait_for(
        "document.querySelector('#pilot-cells [data-key=height].exceeded') !== null", WITHIN_S
    )
    assert browser.text("#pilot-alarm").startswith("▲")
    assert browser.evaluate("document.documentElement.scrollHeight <= innerHeight")
    assert browser.evaluate("document.documentElement.scrollWidth <= innerWidth")
    for selector in (".g-label", ".age", "#pilot-link"):
        size = browser.evaluate(
            f"parseFloat(getComputedStyle(document.querySelector('{selector}')).fontSize)"
        )
        assert size >= 12
    assert all(url.startswith(("http://127.0.0.1", "data:", "blob:")) for url in browser.requested)
    assert [one for one in browser.complaints if "Error" in one] == []
