"""The devices on the operator's page, in a real browser."""

from __future__ import annotations

from pathlib import Path

from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.support.browser import Browser, chromium


def test_the_counters_of_a_device_are_read_when_its_kind_is_expanded(tmp_path: Path) -> None:
    chromium()
    service = Service(tmp_path)
    service.emit(flight_events.mission(str(tmp_path / "mission")))
    service.emit({"event": "bound", "kind": "head", "device": "SU09", "found": {}})
    service.emit({"event": "device", "device": "SU09", "name": "opened", "mono_ns": "1"})
    service.emit({"event": "counters", "devices": {"SU09": {"frames": 7, "packets_missing": 0}}})
    heads = "document.querySelector('#devices details[data-kind=head]')"
    shown = f"{heads}?.querySelector('li[data-device=SU09] .counters')?.textContent"
    with Browser(tmp_path / "profile") as browser:
        browser.open(service.address)
        browser.wait_for(f"{shown} === ''", WITHIN_S)
        browser.evaluate(f"{heads}.open = true")
        browser.wait_for(f"{shown} === 'frames 7'", WITHIN_S)
    service.end()
