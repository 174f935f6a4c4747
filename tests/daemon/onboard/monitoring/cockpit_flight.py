"""A flight for the operator's page: the service with a plan, maps and pictures, and its events."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2

from processing.rig import shipped_rigs
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.cockpit import Cockpit, lines, on_line, picture_of
from tests.daemon.onboard.monitoring.guidance_frames import aerial_map, vector_map
from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.support.browser import Browser

EXPOSURES = ["good", "good", "usable", "good", "good", "refly", "good", "good", "good"]
"""Verdicts of the exposures; the first is a test exposure on the ground."""
HEADS = [f"SU{k:02d}" for k in range(13)]
MISSING = ["no temperature of probe 1 (check the probes and their module)"]


@contextmanager
def cockpit_in(folder: Path) -> Iterator[Cockpit]:
    """A service that is idle, and a browser of 1280x800 on its page."""
    mission = folder / "mission"
    (mission / "L0").mkdir(parents=True)
    (mission / "rig.toml").write_bytes(shipped_rigs()["ultracam-x-mini"].read_bytes())
    (mission / "plan.geojson").write_text(json.dumps(lines()))
    (mission / "service.toml").write_text("[plan]\nground_height_m = 395.0\n")
    for number in range(1, len(EXPOSURES) + 1):
        product = mission / f"L2/{number:06d}"
        product.mkdir(parents=True)
        cv2.imwrite(str(product / "quicklook.jpg"), picture_of(number))
        cv2.imwrite(str(product / "thumbnail.jpg"), cv2.resize(picture_of(number), (200, 133)))
        (product / "histogram.json").write_text(
            json.dumps({"SU00": [0] * 8 + [50] * 24 + [0] * 32, "R": [0] * 63 + [500]})
        )
    service = Service(folder, maps=(aerial_map(folder), vector_map(folder)))
    try:
        with Browser(folder / "profile", width=1280, height=800) as browser:
            cockpit = Cockpit(service, browser)
            cockpit.emit(flight_events.mission(str(mission)))
            for head in HEADS:
                cockpit.emit({"event": "bound", "device": head, "kind": "head", "found": {}})
            for device, kind in (
                ("gnss", "navigator"),
                ("trigger", "trigger"),
                ("probes", "thermometer"),
            ):
                cockpit.emit({"event": "bound", "device": device, "kind": kind, "found": {}})
            cockpit.status("idle")
            browser.open(service.address)
            browser.wait_for("document.querySelector('#link')?.innerText === 'connected'", WITHIN_S)
            browser.evaluate(f"sessionStorage.setItem('token', {json.dumps(service.token)})")
            yield cockpit
    finally:
        if service.child.process.is_alive():
            service.end()


def opened(*devices: str) -> list[dict[str, Any]]:
    return [{"event": "device", "device": one, "name": "opened"} for one in devices]


def prepare(cockpit: Cockpit) -> None:
    """Ready but for a position, with exposure settings; then a test exposure."""
    cockpit.emit(*opened(*HEADS, "probes"), {"event": "device", "device": "gnss", "name": "fixed"})
    one = {"exposure_time_us": 4000.0, "gain_db": 0.0, "tdi_shifts": 0}
    settings = {"pan": one, "R": one}
    cockpit.emit(
        {"event": "exposure-settings", "by": "service", "control": "manual", "settings": settings}
    )
    cockpit.status("ready", missing=MISSING)
    cockpit.until("document.querySelector('#phase').innerText === 'not ready'")
    cockpit.until("document.querySelector('[data-check=plan].good') !== null")
    expose(cockpit, 1, 1)
    cockpit.status("ready", triggers=1, missing=MISSING)


def expose(cockpit: Cockpit, first: int, last: int) -> None:
    """Exposures up to their verdicts; all but the test exposure on the first line."""
    for number in range(first, last + 1):
        line = "A0" if number > 1 else ""
        north_m = 68.0 * number if line else 0.0
        for event in flight_events.exposure(
            number, EXPOSURES[number - 1], line=line, north_m=north_m
        ):
            cockpit.emit(event)


def degrade(cockpit: Cockpit) -> None:
    """A head and the receiver are lost, the disk is low, and there are many faults."""
    cockpit.guide(on_line(0.00005))
    cockpit.emit(flight_events.lost("SU03"), flight_events.lost("gnss"))
    for number in range(30):
        name = ("checksum", "frames-missing", "kernel-drops")[number % 3]
        sentence = (
            f"Head SU{number % 13:02d} reports a problem of its link. Check cable and network."
        )
        cockpit.emit(flight_events.device_event(f"SU{number % 13:02d}", name, sentence, fault=True))
    cockpit.emit({"event": "disk", "sentence": "The disk is low: room for 40 exposures, 1 min."})
    area = {"columns": 40, "rows": 26, "gaps": {"pan": [[30, 0, 40, 26]]}}
    report = {"verdict": "good", "flags": [], "findings": [], "figures": {}, "valid_area": area}
    cockpit.emit({"event": "judged", "number": 9, "report": report})
    cockpit.status("flying", triggers=9, left=40, age_s=8.0)
    cockpit.until("document.querySelectorAll('#faults > li').length > 20")
