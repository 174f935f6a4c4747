"""The operator's page in a real browser, fed by the real watch process."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.support.browser import Browser, chromium
from tests.support.npm import npm_package

PLAN_SHOWN = "import('/map.js').then((map) => map.planShown())"
"""Labels of the plan that are seen, by kind, and the number of areas of gaps."""


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
        vectors = [[c, 1200, 0.05, -0.02, k] for k, c in enumerate((600, 1800, 3000))]
        overlaps = [
            {"sensors": ["SU00", "SU01"], "sought": 90, "found": 80, "used": 77, "rms_px": 0.05},
            {"sensors": ["SU00", "SU02"], "sought": 90, "found": 9, "used": 5, "rms_px": 0.07},
        ]
        residuals = {"width_px": 3600, "height_px": 2400, "overlaps": overlaps, "vectors": vectors}
        (product / f"{number:06d}/residuals.json").write_text(json.dumps(residuals))
        counts = {"SU00": [0] * 20 + [100] * 20 + [0] * 24, "R": [0] * 63 + [500]}
        (product / f"{number:06d}/histogram.json").write_text(json.dumps(counts))
    (folder / "mission/L0").mkdir()
    from processing.rig import shipped_rigs

    rig = shipped_rigs()["ultracam-x-mini"].read_bytes()
    (folder / "mission/rig.toml").write_bytes(rig)
    line = {"type": "LineString", "coordinates": [[15.43, 47.07], [15.43, 47.08]]}
    plan = {
        "type": "FeatureCollection",
        "features": [
            {"type": "Feature", "properties": {"id": "A1", "strip": "S"}, "geometry": line}
        ],
    }
    (folder / "mission/plan.geojson").write_text(json.dumps(plan))
    (folder / "mission/service.toml").write_text("[plan]\nground_height_m = 395.0\n")
    return folder


@pytest.fixture(scope="module")
def service(folder: Path) -> Iterator[Service]:
    service = Service(folder)
    service.emit(flight_events.mission(str(folder / "mission")))
    yield service
    service.end()


@pytest.fixture(scope="module")
def browser(folder: Path, service: Service) -> Iterator[Browser]:
    with Browser(folder / "profile") as browser:
        browser.open(service.address)
        browser.wait_for("document.querySelector('#link')?.innerText === 'connected'", WITHIN_S)
        yield browser


def test_a_flight_is_seen_as_it_happens(service: Service, browser: Browser) -> None:
    service.emit(flight_events.status(triggers=0))
    for number, verdict in ((1, "good"), (2, "usable"), (3, "refly")):
        for event in flight_events.exposure(number, verdict):
            service.emit(event)
        service.emit(flight_events.status(triggers=number))
        browser.wait_for(
            f"document.querySelector('#verdict').innerText.includes('exposure {number}')", WITHIN_S
        )
        assert verdict.upper() in browser.text("#verdict").upper()
    assert browser.text("#simulated") == "SIMULATED"
    assert browser.text("#triggers") == "3"
    assert browser.evaluate("document.querySelectorAll('#rows tr').length") == 3
    browser.wait_for("document.querySelectorAll('#map path').length >= 4", WITHIN_S)
    browser.wait_for("document.querySelector('#quicklook').naturalWidth === 900", WITHIN_S)
    browser.wait_for("document.querySelectorAll('.uplot').length === 4", WITHIN_S)


def test_the_planned_line_is_on_the_map_with_the_holes_in_what_was_flown(
    service: Service, browser: Browser
) -> None:
    browser.wait_for(f"{PLAN_SHOWN}.then(({{ line }}) => line.join() === 'A1')", WITHIN_S)
    # Planned positions are thousands in a large plan: pixels of one canvas, no elements.
    browser.wait_for(
        """(({ width, height }, context) => context.getImageData(0, 0, width, height).data
            .some((value, k) => k % 4 === 3 && value))
            (...[document.querySelector("#map .leaflet-plan-pane canvas")]
                .flatMap((canvas) => [canvas, canvas.getContext("2d")]))""",
        WITHIN_S,
    )
    assert browser.evaluate("document.querySelectorAll('#segments tr').length") == 0
    # An image covers 169 m along the line; between 340 m and 640 m none was made.
    for number, north_m in enumerate((0, 68, 136, 204, 272, 340, 640, 708, 776), start=4):
        for event in flight_events.exposure(number, "good", line="A1", north_m=north_m):
            service.emit(event)
    browser.wait_for("document.querySelectorAll('#segments tr').length === 1", WITHIN_S)
    line, from_m, to_m, hectares, why = browser.evaluate(
        "[...document.querySelectorAll('#segments td')].map((cell) => cell.innerText)"
    )
    assert line == "A1"
    assert 300 <= int(from_m) <= 400
    assert 560 <= int(to_m) <= 660
    assert float(hectares) > 0.5
    assert "of 2 images" in why
    assert "1 gap to re-fly" in browser.text("#coverage")
    shown = browser.evaluate(PLAN_SHOWN)
    assert shown["areas"] >= 1
    assert shown["gap"] == ["✖ A1"]
    reported = browser.evaluate(
        "fetch('/api/v1/advice/fly-again.geojson').then((answer) => answer.json())"
    )
    assert {f["properties"]["strip"] for f in reported["features"]} == {"S"}
    assert all(f["properties"]["simulated"] for f in reported["features"])


def test_residuals_are_drawn_over_the_image_and_listed_with_overlaps_and_histogram(
    browser: Browser,
) -> None:
    browser.click("#rows tr:last-child button")
    browser.wait_for("document.querySelector('#image-which').innerText === '1'", WITHIN_S)
    browser.click("#show-residuals")
    browser.wait_for(
        "document.querySelector('#vectors-note').innerText.includes('3 vectors')", WITHIN_S
    )
    paths = browser.evaluate(
        "[...document.querySelectorAll('#vectors path')].map((p) => p.getAttribute('d'))"
    )
    assert [path.split("l")[0] for path in paths] == [
        "M150.1 300.1",
        "M450.1 300.1",
        "M750.1 300.1",
    ]
    # The row goes down, as residuals of the virtual image do here: -0.02 is up.
    right, down = map(float, paths[0].split("l")[1].split(" "))
    assert right > 0 > down
    browser.evaluate("document.querySelector('#overlaps-panel').open = true")
    assert browser.evaluate("document.querySelectorAll('#overlaps tr').length") == 2
    assert "▲ few: 5" in browser.text("#overlaps")
    assert "R 99 / 99 % ▲ 100.0 % full" in browser.text("#histogram-note")


def test_an_exposure_without_image_shows_none_not_that_of_another(browser: Browser) -> None:
    assert browser.evaluate("!document.querySelector('#quicklook').hidden")
    browser.click("#rows tr:nth-last-child(4) td:nth-child(2)")
    browser.wait_for("document.querySelector('#quicklook').hidden", WITHIN_S)
    assert browser.text("#image-which") == "4"
    assert browser.text("#no-image") == "Exposure 4: no quick look"
    assert browser.text("#histogram-note") == ""


def test_a_fault_is_seen_within_two_seconds_and_acknowledged_with_a_token(
    service: Service, browser: Browser
) -> None:
    service.emit(flight_events.lost("SU02"))
    seen_s = browser.wait_for("document.querySelector('#faults li.active') !== null", WITHIN_S)
    assert seen_s < 2.0
    assert "WARNING" in browser.text("#faults")
    assert "SU02 does not answer; look at its cable." in browser.text("#faults")
    service.emit(flight_events.recovered("SU02"))
    browser.wait_for("document.querySelector('#faults li.cleared') !== null", WITHIN_S)
    # Without a token the page requests one and sends no command.
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
    rejected = "document.querySelector('#answer').innerText.includes('token rejected')"
    browser.wait_for(rejected, WITHIN_S)
    assert len(service.commands) == before
    browser.evaluate(f"sessionStorage.setItem('token', {json.dumps(service.token)})")
    browser.click("[data-command=start]")
    service.until(lambda: service.commands[-1].name == "start")


def test_what_forbids_arming_is_listed_with_its_cure_and_overridden_for_a_recorded_reason(
    service: Service, browser: Browser
) -> None:
    missing_items = ["no head SU02 (check its power and cable)", "no position (check the antenna)"]
    service.emit(flight_events.status("ready", triggers=3) | {"missing": missing_items})
    browser.wait_for("document.querySelectorAll('#missing li').length === 2", WITHIN_S)
    service.refusal = f"not armed: {'; '.join(missing_items)}; override to fly without"
    anonymous_read = "document.querySelector('#ask-override').open"
    # Leaving it by the keyboard overrides nothing; neither does a reason of blanks.
    browser.evaluate("document.querySelector('#phase-button').focus()")
    press(browser, "Enter")
    service.until(lambda: service.commands[-1].name == "arm")
    browser.wait_for(anonymous_read, WITHIN_S)
    listed = "[...document.querySelectorAll('#missing-items li')].map((one) => one.innerText)"
    assert browser.evaluate(listed) == missing_items
    assert browser.evaluate("document.activeElement.id") == "reason"
    browser.evaluate("document.querySelector('#reason').value = '  '")
    press(browser, "Enter")
    assert browser.evaluate(anonymous_read)
    save_screenshot(browser, "arming")
    press(browser, "Escape")
    browser.wait_for(f"!{anonymous_read}", WITHIN_S)
    assert [c.arguments["override"] for c in service.commands if c.name == "arm"] == [False]
    browser.click("[data-command=arm]")
    service.until(lambda: len([c for c in service.commands if c.name == "arm"]) == 2)
    browser.wait_for(anonymous_read, WITHIN_S)
    browser.evaluate("document.querySelector('#reason').value = 'SU02 is not needed here'")
    press(browser, "Enter")
    service.until(lambda: service.commands[-1].arguments["override"])
    given = service.commands[-1]
    assert (given.name, given.by) == ("arm", "operator")
    assert given.arguments["reason"] == "SU02 is not needed here"
    browser.wait_for("document.querySelector('#answer').innerText === 'Done: done as asked'", 30)
    service.refusal = ""
    service.emit(flight_events.status(triggers=3))


def test_exposure_settings_are_seen_and_set_from_the_page(
    service: Service, browser: Browser
) -> None:
    settings = {
        "pan": {"exposure_time_us": 4000.0, "gain_db": 0.0, "tdi_shifts": 1},
        "G": {"exposure_time_us": 2000.0, "gain_db": 1.5, "tdi_shifts": 0},
    }
    reported = {"by": "automatic", "control": "automatic", "lock": "line", "settings": settings}
    service.emit({"event": "exposure-settings", "mono_ns": "1", **reported})
    browser.evaluate("document.querySelector('#exposure-panel').open = true")
    browser.wait_for("document.querySelectorAll('#exposure-now li').length === 2", WITHIN_S)
    assert "G: 2000 µs, 1.5 dB, 0 TDI" in browser.text("#exposure-now")
    assert browser.text("#exposure-control") == "(automatic)"
    browser.evaluate("document.querySelector('#exposure [name=of]').value = 'G'")
    browser.evaluate("document.querySelector('#exposure [name=gain_db]').value = '2.5'")
    browser.click("#exposure button[type=submit]")
    service.until(lambda: service.commands[-1].name == "exposure")
    given = service.commands[-1].arguments
    assert (given["of"], given["gain_db"]) == ("G", 2.5)
    assert "exposure_time_us" not in given


def test_the_image_zooms_by_keyboard_and_the_theme_turns_dark(browser: Browser) -> None:
    browser.click("#tab-image")
    browser.click("#rows tr:last-child button")
    browser.wait_for("document.querySelector('#quicklook').clientWidth > 0", WITHIN_S)
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
    # The browser logs rejected tokens and commands and missing residuals, too.
    refused = ("401", "404", "409")
    broken = [c for c in browser.complaints if not any(status in c for status in refused)]
    assert broken == []


def test_axe_finds_nothing_serious(browser: Browser) -> None:
    axe = npm_package("axe-core") / "axe.min.js"
    browser.call("Page.setBypassCSP", enabled=True)
    for theme in ("dark", ""):
        browser.evaluate(f"document.documentElement.dataset.theme = '{theme}'")
        browser.evaluate(axe.read_text())
        grave = _grave(browser, "document")
        browser.evaluate("document.querySelector('#ask-override').showModal()")
        grave += _grave(browser, "'#ask-override'")
        browser.evaluate("document.querySelector('#ask-override').close()")
        assert grave == [], f"theme {theme or 'light'}"


@pytest.mark.trust
def test_a_head_that_sends_no_image_draws_its_hole_on_the_map(
    service: Service, browser: Browser
) -> None:
    # What is in view is counted.
    browser.evaluate("document.querySelector('#map-follow[aria-pressed=false]')?.click()")
    pieces = browser.evaluate(f"{PLAN_SHOWN}.then(({{ areas }}) => areas)")
    for number, north_m in enumerate((816, 884, 952, 1020), start=20):
        for event in flight_events.exposure(number, "usable", line="A1", north_m=north_m):
            service.emit(event | ({"missing": ["SU00"]} if event["event"] == "sealed" else {}))
    browser.wait_for(f"{PLAN_SHOWN}.then(({{ areas }}) => areas > {pieces})", WITHIN_S)
    browser.wait_for("document.querySelector('#segments').innerText.includes('SU00')", WITHIN_S)
    assert "pan: " in browser.text("#segments")
    assert "of 2 images" in browser.text("#segments")
    assert "exposures 20 to 23: no image of SU00" in browser.text("#segments")
    save_screenshot(browser, "hole")


@pytest.mark.trust
def test_the_lamp_of_the_phase_shows_what_holds(service: Service, browser: Browser) -> None:
    lamp = (
        "((one) => `${one.innerText}, ${one.className.trim()}`)(document.querySelector('#phase'))"
    )
    for phase, missing, shown in (
        ("idle", [], "idle, chip caution"),
        ("ready", ["no head SU02 (check its cable)"], "not ready, chip caution"),
        ("ready", [], "ready, chip"),
        ("armed", [], "armed, chip good"),
        ("flying", [], "flying, chip good"),
    ):
        service.emit(flight_events.status(phase, triggers=3) | {"missing": missing})
        browser.wait_for(f"{lamp} === '{shown}'", WITHIN_S)


@pytest.mark.trust
def test_a_position_that_is_old_is_not_shown_as_the_present_one(
    service: Service, browser: Browser
) -> None:
    here = {"latitude_deg": 47.07, "longitude_deg": 15.43, "satellites": 14}
    here |= {"velocity_ned_mps": [55.0, 0.0, 0.0]}
    for age_s, shown in ((0.2, ["14", "107 kn"]), (6.0, ["–", "–"])):
        service.emit(flight_events.status(triggers=3) | {"position": here | {"age_s": age_s}})
        browser.wait_for(f"document.querySelector('#satellites').innerText === '{shown[0]}'", 30)
        assert browser.text("#speed") == shown[1]


@pytest.mark.trust
def test_what_was_absent_at_the_start_and_came_stands_no_longer(
    service: Service, browser: Browser
) -> None:
    service.emit({"event": "ready", "mono_ns": "1", "absent": ["trigger", "head SU02"]})
    standing = (
        "[...document.querySelectorAll('#faults li.active')].map((one) => one.dataset.fault)"
        ".filter((fault) => fault.startsWith('absent')).sort().join()"
    )
    browser.wait_for(f"{standing} === 'absent head SU02,absent trigger'", WITHIN_S)
    service.emit(flight_events.status("flying", triggers=3) | {"absent": ["trigger"]})
    browser.wait_for(f"{standing} === 'absent trigger'", WITHIN_S)
    service.emit(flight_events.status("flying", triggers=3) | {"absent": []})
    browser.wait_for(f"{standing} === ''", WITHIN_S)


def test_values_without_a_connection_are_marked_and_cleared_for_another_flight(
    folder: Path, browser: Browser, tmp_path: Path
) -> None:
    """Reading requires a token; the page requests it, and shows images with it."""
    closed = Service(tmp_path, anonymous_read=False)
    try:
        closed.emit(flight_events.mission(str(folder / "mission")))
        for event in (*flight_events.exposure(1, "refly"), flight_events.status(triggers=1)):
            closed.emit(event)
        browser.open(closed.address)
        browser.wait_for("document.querySelector('#ask-token')?.open", WITHIN_S)
        assert browser.text("#link") == "token needed"
        browser.evaluate(f"document.querySelector('#token').value = {json.dumps(closed.token)}")
        browser.click("#ask-token button[value=use]")
        browser.wait_for("document.querySelector('#quicklook').naturalWidth === 900", WITHIN_S)
        assert "REFLY" in browser.text("#verdict").upper()
    finally:
        closed.end()
    browser.wait_for(
        "document.querySelector('#connection-lost').innerText.includes('Connection lost')", WITHIN_S
    )
    (tmp_path / "another").mkdir()
    another = Service(tmp_path / "another", port=int(closed.address.rstrip("/").split(":")[-1]))
    try:
        another.emit(flight_events.mission() | {"id": "20261122T080000Z-other"})
        browser.wait_for("document.querySelector('#link').innerText === 'connected'", WITHIN_S)
        browser.wait_for("document.querySelector('#rows').childElementCount === 0", WITHIN_S)
        assert browser.evaluate("document.querySelector('#connection-lost').hidden")
        browser.wait_for("document.querySelector('#verdict .word').innerText === 'WAITING'", 30)
    finally:
        another.end()


def test_a_picture_is_taken(browser: Browser, tmp_path: Path) -> None:
    keep = os.environ.get("SYNTOPIC_PICTURES")
    path = Path(keep) / "page-test.png" if keep else tmp_path / "page.png"
    browser.picture(path)
    assert path.stat().st_size > 20_000


def test_the_api_is_described_as_text_by_the_service_only(
    service: Service, browser: Browser
) -> None:
    browser.requested.clear()
    browser.open(f"{service.address}docs")
    browser.wait_for("document.querySelectorAll('#routes section').length > 10", WITHIN_S)
    assert browser.text("#simulated") == "SIMULATED"
    assert "interval_s in the body: number, > 0, ≤ 3600; for interval" in browser.text("#routes")
    outside = [
        url for url in browser.requested if not url.startswith(("data:", "http://127.0.0.1:"))
    ]
    assert outside == []


def _grave(browser: Browser, where: str) -> list[tuple[str, list[str]]]:
    found = browser.evaluate(f"axe.run({where}, {{resultTypes: ['violations']}})")
    return [
        (one["id"], [node["html"][:120] for node in one["nodes"]])
        for one in found["violations"]
        if one["impact"] in ("serious", "critical")
    ]


def press(browser: Browser, key: str) -> None:
    """A key, as from the keyboard."""
    code = {"Enter": 13, "Escape": 27}[key]
    text = {"text": "\r"} if key == "Enter" else {}
    about = {"key": key, "windowsVirtualKeyCode": code, **text}
    browser.call("Input.dispatchKeyEvent", type="keyDown", **about)
    browser.call("Input.dispatchKeyEvent", type="keyUp", key=key, windowsVirtualKeyCode=code)


def save_screenshot(browser: Browser, name: str) -> None:
    """What is seen, by day and by night, where somebody wants to look at it."""
    if keep := os.environ.get("SYNTOPIC_PICTURES"):
        for theme in ("dark", ""):
            browser.evaluate(f"document.documentElement.dataset.theme = '{theme}'")
            browser.picture(Path(keep) / f"{name}-{theme or 'light'}.png")


@pytest.mark.trust
@pytest.mark.parametrize("has_landed", [True, False])
def test_a_landing_ends_in_no_alarm_and_a_lost_service_does(
    folder: Path, tmp_path: Path, has_landed: bool
) -> None:
    service = Service(tmp_path)
    service.emit(flight_events.mission(str(folder / "mission")))
    service.emit(flight_events.status("flying"))
    with Browser(tmp_path / "profile") as browser:
        browser.open(service.address)
        browser.wait_for("document.querySelector('#phase')?.innerText === 'flying'", WITHIN_S)
        if has_landed:
            service.emit({"event": "phase", "mono_ns": "1", "phase": "landed"})
            browser.wait_for("document.querySelector('#phase').innerText === 'landed'", WITHIN_S)
        service.end()
        browser.wait_for("!document.querySelector('#connection-lost').hidden", WITHIN_S)
        lamp, bar = browser.text("#link"), browser.text("#connection-lost")
        style = browser.evaluate("document.querySelector('#link').className.trim()")
        if has_landed:
            assert (lamp, style) == ("ended", "chip")
            assert bar.startswith("Landed. The service ended ")
        else:
            assert (lamp, style) == ("disconnected", "chip warning")
            assert "Connection lost" in bar
        browser.evaluate("new Promise((resolve) => setTimeout(resolve, 1500))")
        assert (browser.text("#link"), browser.text("#connection-lost")) == (lamp, bar)
        save_screenshot(browser, "landed" if has_landed else "lost-link")
