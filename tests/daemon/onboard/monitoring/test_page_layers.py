"""Layers that are switched on in a browser: hill shade of the map, sharpness of the image."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from daemon.configuration.model import PlanSection
from daemon.mission.store.level0 import tiff_parts
from processing.rig import shipped_rigs
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.cockpit import MEASURES, Cockpit, lines
from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.daemon.onboard.monitoring.test_base_maps import geotiff
from tests.daemon.onboard.monitoring.vector_tiles import labelled_tile
from tests.support.browser import Browser, chromium

RIDGE_EAST_M = 532_900.0
"""Of a ridge from south to north, in UTM zone 33, amid the lines of the tests."""
PIXELS = """(selector, isWanted) => {
  // Mean place in the window, in px, of the wanted pixels of canvases; null without any.
  const [count, sum] = [{}, {}];
  for (const canvas of document.querySelectorAll(selector)) {
    const { left, width } = canvas.getBoundingClientRect();
    const pixels = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
    for (let i = 0; i < pixels.length; i += 4) {
      const kind = isWanted(...pixels.slice(i, i + 4));
      if (!kind) continue;
      count[kind] = (count[kind] || 0) + 1;
      sum[kind] = (sum[kind] || 0) + left + ((i / 4) % canvas.width + 0.5) / canvas.width * width;
    }
  }
  return Object.fromEntries(Object.keys(count).map((kind) => [kind, sum[kind] / count[kind]]));
}"""
SHADE = (
    f"({PIXELS})('.leaflet-relief-pane canvas',"
    " (r, g, b, a) => a < 20 ? null : r > 200 ? 'lit' : r < 50 ? 'dark' : null)"
)
SHARPNESS = (
    f"({PIXELS})('#deep .leaflet-overlay-pane canvas',"
    " (r, g, b, a) => a < 90 || a > 130 ? null : g > r + 60 ? 'sharp' : r > g + 60 ? 'blurred'"
    " : null)"
)


def height_model(folder: Path) -> Path:
    """A ridge: it rises to the east on its western side."""
    rows, columns, cell_m = 500, 500, 10.0
    from rasterio.transform import from_origin

    west, north = RIDGE_EAST_M - columns * cell_m / 2, 5_216_500.0
    east = west + (np.arange(columns) + 0.5) * cell_m
    heights = np.tile(1500.0 - 0.5 * np.abs(east - RIDGE_EAST_M), (rows, 1)).astype(np.float32)
    transform = from_origin(west, north, cell_m, cell_m)
    return geotiff(
        folder / "ridge.tif", heights, transform=transform, blockxsize=256, blockysize=256
    )


def write_image(folder: Path) -> None:
    """Noise at the resolution of the sensor on the left, the same blurred over pixels right."""
    folder.mkdir(parents=True)
    pan = np.random.default_rng(3).integers(3000, 20000, (1200, 1800), dtype=np.uint16)
    pan[:, 900:] = cv2.GaussianBlur(pan[:, 900:], (0, 0), 4.0) * 3 - 22000
    parts = tiff_parts([pan], {"bands": ["pan"]})
    (folder / "pan.tif").write_bytes(b"".join(bytes(part) for part in parts))
    shown = cv2.resize((pan / 110).clip(0, 255).astype(np.uint8), (900, 600))
    cv2.imwrite(str(folder / "quicklook.jpg"), shown)
    cv2.imwrite(str(folder / "thumbnail.jpg"), cv2.resize(shown, (200, 133)))


@pytest.fixture(scope="module")
def cockpit(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cockpit]:
    chromium()
    folder = tmp_path_factory.mktemp("layers")
    mission = folder / "mission"
    (mission / "L0").mkdir(parents=True)
    (mission / "rig.toml").write_bytes(shipped_rigs()["ultracam-x-mini"].read_bytes())
    (mission / "plan.geojson").write_text(json.dumps(lines()))
    (mission / "service.toml").write_text("[plan]\nground_height_m = 395.0\n")
    write_image(mission / "L2/000001")
    plan = PlanSection(elevation=height_model(folder), elevation_crs="EPSG:32633")
    service = Service(folder, plan=plan)
    try:
        with Browser(folder / "profile", width=1280, height=800) as browser:
            cockpit = Cockpit(service, browser)
            cockpit.emit(flight_events.mission(str(mission)))
            for event in flight_events.exposure(1, line="A0", north_m=68.0):
                cockpit.emit(event)
            cockpit.status("flying", triggers=1)
            browser.open(service.address)
            browser.wait_for("document.querySelector('#link')?.innerText === 'connected'", WITHIN_S)
            browser.evaluate(MEASURES.read_text())
            yield cockpit
    finally:
        service.end()


def test_hill_shade_is_drawn_from_the_height_model_and_removed(cockpit: Cockpit) -> None:
    browser = cockpit.browser
    cockpit.until("document.querySelector('#map-relief') !== null")
    assert browser.evaluate("document.querySelectorAll('.leaflet-relief-pane canvas').length") == 0
    cockpit.touch("#map-relief")
    cockpit.until(f"Object.keys({SHADE}).length === 2")
    assert browser.evaluate("document.querySelector('#map-relief').ariaPressed") == "true"
    found = browser.evaluate(SHADE)
    # The light comes from the north-west: the western side is lit, the eastern one is dark.
    assert found["lit"] + 20.0 < found["dark"]
    # Below the lines and the footprints.
    order = browser.evaluate(
        "['relief', 'overlay'].map((name) => Number(getComputedStyle("
        "document.querySelector(`#map .leaflet-${name}-pane`)).zIndex))"
    )
    assert order[0] < order[1]
    cockpit.touch("#map-relief")
    cockpit.until("document.querySelectorAll('.leaflet-relief-pane canvas').length === 0")
    assert browser.evaluate("document.querySelector('#map-relief').ariaPressed") == "false"


def test_sharpness_is_a_layer_of_the_image_at_full_resolution(cockpit: Cockpit) -> None:
    browser = cockpit.browser
    cockpit.until("document.querySelectorAll('#strip .thumb').length === 1")
    cockpit.touch("#strip .thumb")
    cockpit.touch("#full-resolution")
    cockpit.until("document.querySelector('[data-overlay=sharpness]') !== null")
    assert not any("/sharpness/" in one for one in browser.requested)
    assert browser.evaluate(SHARPNESS) == {}
    cockpit.touch("[data-overlay=sharpness]")
    cockpit.until(f"Object.keys({SHARPNESS}).length === 2")
    assert any("/api/v1/images/1/sharpness/" in one for one in browser.requested)
    found = browser.evaluate(SHARPNESS)
    middle = browser.evaluate(
        "(() => { const { left, width } = document.querySelector('#deep').getBoundingClientRect();"
        " return left + width / 2; })()"
    )
    assert found["sharp"] < middle < found["blurred"]
    cockpit.touch("[data-overlay=sharpness]")
    assert browser.evaluate(SHARPNESS) == {}


def test_names_on_vector_maps_are_read_on_every_ground(cockpit: Cockpit) -> None:
    """Measured at the edges of their strokes, day and night."""
    browser = cockpit.browser
    browser.evaluate(MEASURES.read_text())
    for ground in ("land", "water", "buildings", "boundary"):
        tile = json.dumps(list(labelled_tile(ground)))
        for is_night, ink in ((False, "#3a3a3a"), (True, "#b9c0c6")):
            contrast = browser.evaluate(
                "import('/mvt.js').then(({drawTile}) => {"
                " const canvas = document.createElement('canvas');"
                " canvas.width = canvas.height = 256;"
                f" drawTile(canvas, new Uint8Array({tile}), {json.dumps(is_night)});"
                " const area = { left: 60, top: 100, width: 136, height: 50 };"
                f" return canvasContrast(canvas.getContext('2d'), area, colourOf('{ink}')); }})"
            )
            assert contrast is not None and contrast >= 4.5, (ground, is_night, contrast)
