"""Markup in every string that reaches the operator's page is shown as text, in a real browser."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from daemon.onboard.service.messages import ServiceEvent
from processing.rig import shipped_rigs
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.support.browser import Browser, chromium

pytestmark = pytest.mark.trust

TAG = "<b class=planted>"
MARKUP = (
    f'{TAG}</b><meta http-equiv=refresh content="0;url=/taken"><img class=planted src=/planted '
    "onerror=window.planted=1><svg class=planted onload=window.planted=1></svg>\"'></td></li>"
)
KEPT = frozenset({"event", "mono_ns", "phase", "path", "state", "verdict", "name", "gps_ns"})
"""Keys whose values decide what is shown."""
PLANTED = "document.querySelectorAll('.planted, meta[http-equiv], [onerror], [onload]').length"
SHOWN_IN = (
    *("#missing", "#devices", "#faults", "#findings", "#temperatures", "#exposure-now"),
    *("#exposure-control", "#overlaps", "#disks", "#recovery", "#rows", "#chart-temperature"),
    "#segments",
)
HOSTILE_SVG = f"""<svg xmlns="http://www.w3.org/2000/svg" xmlns:h="http://www.w3.org/1999/xhtml"
 onload="window.planted=1"><script>window.planted=1</script><foreignObject>
<h:meta http-equiv="refresh" content="0;url=/taken"/><h:img src="/planted"/></foreignObject>
<text>{"shown"}</text></svg>"""


def hostile(value: Any, key: str = "") -> Any:
    """The same with markup in every string and in every name of a probe, head or group."""
    if isinstance(value, str):
        return value if key in KEPT else f"{value}{MARKUP}"
    if isinstance(value, list):
        return [hostile(one, key) for one in value]
    if isinstance(value, dict):
        named = key in ("temperatures_c", "settings", "found")
        return {
            (f"{name}{MARKUP}" if named else name): hostile(one, name)
            for name, one in value.items()
        }
    return value


def events(folder: Path) -> Iterator[dict[str, Any]]:
    yield flight_events.mission(str(folder / "mission")) | {"recovery": ["one frame was lost"]}
    yield {"event": "bound", "device": "SU00", "kind": "head", "found": {"serial": "1"}}
    yield flight_events.lost("SU02")
    yield flight_events.lost("receiver")
    yield flight_events.recovered("receiver")
    yield flight_events.device_event("probe", "searching", "it is looked for", fault=False)
    settings = {"pan": {"exposure_time_us": 4000.0, "gain_db": 0.0, "tdi_shifts": 1}}
    yield {
        **{"event": "exposure-settings", "mono_ns": "1", "by": "automatic"},
        **{"control": "automatic", "lock": "line", "locked_on": "A1", "settings": settings},
    }
    for number, north_m in enumerate((0, 68, 136, 640, 708), start=1):
        yield from flight_events.exposure(number, "refly", line="A1", north_m=north_m)
    yield {"event": "triggered", "mono_ns": "1", "number": 6}
    yield {"event": "lost", "mono_ns": "1", "number": 6, "cause": "no frame came"}
    yield {"event": "triggered", "mono_ns": "1", "number": 7}
    yield {"event": "not-processed", "mono_ns": "1", "number": 7, "sentence": "no image"}
    yield {"event": "command", "mono_ns": "1", "name": "start", "by": "x", "sentence": "done"}
    disk = {"disk": "root", "path": "/a", "state": "in use", "healthy": False, "sentence": "hot"}
    status = flight_events.status("ready", triggers=7)
    yield status | {"missing": ["no head SU02"], "absent": ["trigger"], "disks": [disk]}


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    chromium()
    folder = tmp_path_factory.mktemp("markup")
    mission = folder / "mission"
    (mission / "L0").mkdir(parents=True)
    for number in range(1, 6):
        product = mission / f"L2/{number:06d}"
        product.mkdir(parents=True)
        cv2.imwrite(str(product / "quicklook.jpg"), np.full((60, 90, 3), 99, np.uint8))
        overlap = {"sensors": ["SU00", "SU01"], "sought": 90, "found": 9, "used": 5, "rms_px": 0.1}
        residuals = {"width_px": 90, "height_px": 60, "overlaps": [overlap], "vectors": []}
        (product / "residuals.json").write_text(json.dumps(hostile(residuals)))
        (product / "histogram.json").write_text(json.dumps({f"SU00{MARKUP}": [1] * 64}))
        (product / "residuals.svg").write_text(HOSTILE_SVG)
    (mission / "rig.toml").write_bytes(shipped_rigs()["ultracam-x-mini"].read_bytes())
    line = {"type": "LineString", "coordinates": [[15.43, 47.07], [15.43, 47.08]]}
    feature = {"type": "Feature", "properties": {"id": "A1", "strip": "S"}, "geometry": line}
    feature["properties"] = {"id": f"A1{MARKUP}", "strip": f"S{MARKUP}"}
    plan = {"type": "FeatureCollection", "features": [feature]}
    (mission / "plan.geojson").write_text(json.dumps(plan))
    (mission / "service.toml").write_text("[plan]\nground_height_m = 395.0\n")
    service = Service(folder)
    for event in events(folder):
        while not service.child.try_send(ServiceEvent(hostile(event))):
            time.sleep(0.02)
    yield service
    service.end()


@pytest.mark.parametrize("policy", [True, False], ids=["with policy", "without policy"])
def test_markup_in_any_string_is_text(service: Service, tmp_path: Path, policy: bool) -> None:
    """Also in browsers that know no trusted types."""
    with Browser(tmp_path / "profile") as browser:
        browser.call("Page.setBypassCSP", enabled=not policy)
        browser.open(service.address)
        browser.wait_for("document.querySelector('#link')?.innerText === 'connected'", WITHIN_S)
        for where in SHOWN_IN:
            if where == "#overlaps":
                browser.click("#rows tr:last-child button")
            shown = f"document.querySelector({json.dumps(where)})?.textContent.includes('{TAG}')"
            browser.wait_for(shown, WITHIN_S)
            assert browser.evaluate(PLANTED) == 0, where
        browser.evaluate(
            "document.querySelector('#map .leaflet-interactive')"
            ".dispatchEvent(new MouseEvent('mouseover', {bubbles: true}))"
        )
        service.refusal = f"not armed: {MARKUP}; override to fly without"
        browser.evaluate(f"sessionStorage.setItem('token', {json.dumps(service.token)})")
        browser.click("[data-command=arm]")
        service.until(lambda: any(one.name == "arm" for one in service.commands))
        for where in ("#answer", "#missing-items"):
            shown = f"document.querySelector('{where}').textContent.includes('{TAG}')"
            browser.wait_for(shown, WITHIN_S)
        assert TAG in str(browser.evaluate("document.title"))
        assert browser.evaluate(PLANTED) == 0
        assert browser.evaluate("window.planted === undefined")
        assert browser.evaluate("location.href") == service.address
        assert [url for url in browser.requested if "/planted" in url or "/taken" in url] == []
        uncaught = [one for one in browser.complaints if "Error" in one]
        assert uncaught == []
        service.commands.clear()


def test_the_browser_turns_html_of_a_library_into_text(service: Service, tmp_path: Path) -> None:
    with Browser(tmp_path / "profile") as browser:
        browser.open(service.address)
        browser.wait_for("document.querySelector('#link')?.innerText === 'connected'", WITHIN_S)
        script = (
            "((one) => { one.innerHTML = TEXT; return [one.childElementCount, one.textContent]; })"
            "(document.createElement('div'))"
        )
        for html in (MARKUP, "a & b < c", "&lt;b>"):
            assert browser.evaluate(script.replace("TEXT", json.dumps(html))) == [0, html]
        assert browser.text(".leaflet-control-zoom-in") == "+"
        script_text = "document.createElement('script').text = 'window.planted = 1'"
        refusal = (
            f"(() => {{ try {{ {script_text}; return ''; }} catch (e) {{ return e.name; }} }})()"
        )
        assert browser.evaluate(refusal) == "TypeError"


def test_a_drawing_of_a_mission_runs_nothing(service: Service, tmp_path: Path) -> None:
    with Browser(tmp_path / "profile") as browser:
        address = f"{service.address}api/v1/exposures/1/residuals.svg"
        browser.open(address)
        browser.wait_for("document.querySelector('text')?.textContent === 'shown'", WITHIN_S)
        time.sleep(0.5)  # no timer runs in a page without scripts
        assert browser.evaluate("location.href") == address
        assert browser.evaluate("window.planted === undefined")
        attempts = [url for url in browser.requested if "/taken" in url]
        assert attempts == []
