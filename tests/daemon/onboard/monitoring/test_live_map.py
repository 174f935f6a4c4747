"""The preliminary orthomosaic and the triangulation: routes, and what the page shows of them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from daemon.onboard.live_orthomosaic.map_layout import tile_file
from daemon.onboard.live_orthomosaic.tile_files import encoded
from daemon.onboard.live_orthomosaic.web_tiles import map_px
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.live_map_state import LIST_MAX, TILES_MAX, LiveMapState
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.daemon.onboard.monitoring.test_api import Camera
from tests.support.browser import Browser

ZOOM = 16
ABOUT = {
    "zoom": ZOOM, "min_zoom": 11, "gsd_m": 1.6266, "images": 12, "measured_only": 1,
    "not_placed": 2, "pending": 0,
    "ground": {"kind": "plane", "source": "tie points", "height_m": 392.1, "relief_rms_m": 0.4},
}  # fmt: skip
BLOCK = {
    "event": "triangulation", "is_preliminary": True, "exposures": 12, "adjusted": 10,
    "sigma0": 0.97, "line_ties": [{"lines": ["A0", "A1"], "tried": 40, "found": 2}],
    "accuracy": {"points": 320, "plan_m": 0.041, "height_m": 0.09, "plan_95_m": 0.06,
                 "height_95_m": 0.14},
    "drifts": [{"name": "boresight about the camera's x", "unit": "mdeg", "value": 2.13,
                "sigma": 1.2, "determined": True},
               {"name": "time offset", "unit": "ms", "value": None, "sigma": None,
                "determined": False}],
    "findings": [{"name": "LINES_NOT_TIED", "lines": ["A0", "A1"], "exposures": [],
                  "sentence": "Lines A0 and A1 overlap, but only 2 of 40 points tie them."}],
}  # fmt: skip


def _event(tiles: list[list[int]]) -> dict[str, Any]:
    version = max((tile[3] for tile in tiles), default=0)
    return {"event": "orthomosaic", "tiles": tiles, "version": version, **ABOUT}


@pytest.fixture
def camera(tmp_path: Path) -> Camera:
    return Camera(tmp_path)


@pytest.fixture
def client(camera: Camera) -> Iterator[TestClient]:
    with camera.client() as found:
        yield found


def _map_folder(camera: Camera) -> Path:
    assert camera.state.mission_path is not None
    return Path(camera.state.mission_path) / "export/live-orthomosaic"


def test_only_tiles_newer_than_a_version_are_listed_coarse_ones_first(camera, client) -> None:
    assert client.get("/api/v1/orthomosaic").json() == {}
    assert "orthomosaic" not in camera.state.brief()
    camera.state.apply(_event([[16, 5, 5, 1, 900], [15, 2, 2, 2, 800]]))
    camera.state.apply(_event([[16, 5, 6, 3, 700], [16, 5, 5, 4, 900], [14, 1, 1, 5, 90]]))
    assert camera.state.brief()["orthomosaic"] == 5
    found = client.get("/api/v1/orthomosaic?after=2").json()
    assert found["tiles"] == [[14, 1, 1, 5, 90], [16, 5, 5, 4, 900], [16, 5, 6, 3, 700]]
    assert found["gsd_m"] == 1.6266 and not found["is_cut"]
    assert camera.state.changed("events", 0)[-1]["event"] != "orthomosaic"
    camera.state.apply(flight_events.mission("/other"))
    assert client.get("/api/v1/orthomosaic").json() == {}


def test_a_long_list_is_cut_to_the_newest_and_states_it() -> None:
    state = LiveMapState()
    for first in range(0, TILES_MAX + 500, 500):
        state.apply(_event([[ZOOM, k, 7, k + 1, 10] for k in range(first, first + 500)]))
    last = state.version
    found = state.changes(last - LIST_MAX - 1)
    assert len(found["tiles"]) == LIST_MAX and found["is_cut"]
    assert min(tile[3] for tile in found["tiles"]) == last - LIST_MAX + 1
    assert not state.changes(last - 3)["is_cut"] and len(state.changes(last - 3)["tiles"]) == 3


def test_a_tile_is_served_as_it_is_on_disk_and_is_not_stored_by_browsers(camera, client) -> None:
    path = tile_file(_map_folder(camera), (ZOOM, 5, 6))
    path.parent.mkdir(parents=True)
    path.write_bytes(b"RIFF0000WEBPtile")
    answer = client.get(f"/api/v1/orthomosaic/{ZOOM}/5/6")
    assert answer.content == path.read_bytes() and answer.headers["content-type"] == "image/webp"
    assert answer.headers["cache-control"] == "no-store"
    assert client.get(f"/api/v1/orthomosaic/{ZOOM}/5/7").status_code == 204
    assert client.get(f"/api/v1/orthomosaic/{ZOOM}/5/-7").status_code == 422
    assert client.get("/api/v1/orthomosaic/99/5/7").status_code == 422


def test_after_a_restart_of_the_page_the_map_is_that_of_the_disk(camera, client) -> None:
    folder = _map_folder(camera)
    folder.mkdir(parents=True)
    state = {**ABOUT, "version": 8, "not_placed": [{"exposure": 2, "reason": "lost"}]}
    (folder / "orthomosaic.json").write_text(json.dumps(state))
    found = client.get("/api/v1/orthomosaic").json()
    assert found["version"] == 8 and found["is_cut"] and found["zoom"] == ZOOM
    assert found["not_placed"] == 1
    (folder / "orthomosaic.json").write_text("no json")
    assert client.get("/api/v1/orthomosaic").json() == {}


def test_the_quality_report_is_served_without_scripts(camera, client) -> None:
    assert client.get("/api/v1/triangulation/report").status_code == 404
    folder = _map_folder(camera).parent / "triangulation/live"
    folder.mkdir(parents=True)
    (folder / "report.html").write_text("<!doctype html>")
    answer = client.get("/api/v1/triangulation/report")
    assert answer.text == "<!doctype html>"
    assert "sandbox" in answer.headers["content-security-policy"]


def test_reading_needs_a_token_where_the_page_does(camera) -> None:
    with camera.client(anonymous_read=False) as client:
        for path in ("", "/16/5/6"):
            assert client.get(f"/api/v1/orthomosaic{path}").status_code == 401


def test_the_state_of_the_flight_forgets_the_map_of_the_last_mission() -> None:
    state = FlightState("test")
    state.apply(_event([[ZOOM, 1, 1, 4, 10]]))
    state.apply(flight_events.mission("/next"))
    assert state.live_map.version == 0


@pytest.mark.timeout(180)
def test_the_page_shows_the_map_marked_preliminary_and_renews_a_tile(tmp_path: Path) -> None:
    mission = tmp_path / "mission"
    latitude, longitude = 47.07, 15.43  # of the status
    x, y = (map_px(ZOOM, np.array([latitude]), np.array([longitude]))[0] // 256).astype(int)
    folder = mission / "export/live-orthomosaic"

    def publish(grey: int, version: int) -> list[list[int]]:
        tiles = []
        for k, zoom in enumerate((14, 15, 16)):
            tile = (zoom, int(x) >> (ZOOM - zoom), int(y) >> (ZOOM - zoom))
            path = tile_file(folder, tile)
            path.parent.mkdir(parents=True, exist_ok=True)
            full = np.full((256, 256), 255, np.uint8)
            path.write_bytes(encoded(np.full((256, 256), grey, np.uint8), full))
            tiles.append([*tile, version + k, path.stat().st_size])
        return tiles

    service = Service(tmp_path)
    try:
        service.emit(flight_events.mission(str(mission)))
        service.emit(flight_events.status())
        service.emit(_event(publish(60, 1)))
        service.emit(BLOCK)
        with Browser(tmp_path / "browser") as browser:
            browser.open(service.address)
            browser.wait_for("document.body?.dataset.ready === ''", WITHIN_S)
            browser.wait_for("!document.querySelector('#map-orthomosaic-note').hidden", WITHIN_S)
            note = browser.text("#map-orthomosaic-note")
            for part in ("Preliminary orthomosaic", "1.63 m", "392 m", "12 images", "2 exposures"):
                assert part in note, note
            grey = (
                "(() => { const c = document.querySelector('.leaflet-orthomosaic-pane "
                "canvas[data-filled]'); return c ? c.getContext('2d').getImageData(128, 128, 1, 1)"
                ".data[0] : -1; })()"
            )
            browser.wait_for(f"Math.abs({grey} - 60) < 4", WITHIN_S)
            service.emit(_event(publish(200, 11)))
            browser.wait_for(f"Math.abs({grey} - 200) < 4", WITHIN_S)
            browser.click("#tab-expert")
            browser.wait_for(
                "document.querySelector('#triangulation-plan')?.textContent.includes('0.041')",
                WITHIN_S,
            )
            text = browser.text("#triangulation")
            for part in ("0.97", "10 of 12", "2 of 40", "do not tie", "LINES_NOT_TIED",
                         "2.1 ± 1.2 mdeg", "not determined", "Preliminary"):  # fmt: skip
                assert part in text, text
            browser.click("#map-orthomosaic")
            browser.wait_for(
                "!document.querySelector('.leaflet-orthomosaic-pane canvas')", WITHIN_S
            )
    finally:
        service.end()
