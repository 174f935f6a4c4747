"""`syntopic monitor --serve` without addresses: services that announce themselves become rows."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from zeroconf import Error as ZeroconfError
from zeroconf import ServiceInfo, Zeroconf

from daemon.cli.monitor import MonitorError, _announced_services
from daemon.onboard.monitoring.client import mdns_browser
from daemon.onboard.monitoring.client.mdns_announcer import SERVICE_TYPE
from daemon.onboard.monitoring.client.mdns_browser import AnnouncedService, parse_announcement
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.page_service import Service

ROW_WITHIN_S = 90.0


def announcement(port: int, *addresses: str, **text: str) -> ServiceInfo:
    name = f"test-{os.getpid()}-{port}"
    return ServiceInfo(
        SERVICE_TYPE, f"{name}.{SERVICE_TYPE}", port=port, parsed_addresses=list(addresses),
        properties=text, server=f"{name}.local.",
    )  # fmt: skip


@contextmanager
def announced(info: ServiceInfo) -> Iterator[None]:
    """Announce a service on the loopback interface."""
    try:
        zeroconf = Zeroconf(interfaces=["127.0.0.1"])
    except OSError as error:
        pytest.skip(f"no multicast on the loopback interface: {error}")
    try:
        zeroconf.register_service(info)
        yield
    finally:
        zeroconf.close()


def free_port() -> int:
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        return int(bound.getsockname()[1])


def row_of(page_port: int, address: str) -> dict[str, Any] | None:
    """The row of a service, once its state was received."""
    try:
        with urllib.request.urlopen(
            f"http://127.0.0.1:{page_port}/api/v1/fleet", timeout=5
        ) as answer:
            rows = json.load(answer)["aircraft"]
    except OSError:
        return None
    found = [one for one in rows if one["address"] == address and one["is_linked"]]
    return found[0] if found else None


def test_a_service_that_announces_itself_becomes_a_row(tmp_path: Path) -> None:
    service = Service(tmp_path)
    service.emit(flight_events.mission() | {"rig": "north-camera"})
    service.emit(flight_events.status("flying", triggers=7))
    address = service.address.rstrip("/")
    page_port = free_port()
    try:
        with announced(announcement(int(address.rpartition(":")[2]), "127.0.0.1", version="1")):
            command = "from daemon.cli import main; main()"
            monitor = subprocess.Popen(
                [sys.executable, "-c", command, "monitor", "--serve", str(page_port)]
            )
            try:
                deadline_s = time.monotonic() + ROW_WITHIN_S
                while (row := row_of(page_port, address)) is None:
                    assert monitor.poll() is None, "the command ended"
                    assert time.monotonic() < deadline_s, "the announced service has no row"
                    time.sleep(0.2)
            finally:
                monitor.terminate()
                monitor.wait(20)
        assert (row["name"], row["phase"], row["triggers"]) == ("north-camera", "flying", 7)
    finally:
        service.end()


def test_what_is_announced_is_found_with_its_text(tmp_path: Path) -> None:
    port = free_port()
    try:
        with announced(announcement(port, "127.0.0.1", rig="north", phase="armed")):
            found = {one.address: one.text for one in mdns_browser.find_services(2.0)}
    except ZeroconfError as error:
        pytest.skip(f"no announcement is possible here: {error}")
    assert found[f"127.0.0.1:{port}"] == {"rig": "north", "phase": "armed"}


def test_an_announcement_without_an_address_is_no_service() -> None:
    assert parse_announcement(announcement(8470)) is None
    found = parse_announcement(announcement(8470, "fe80::1", rig="a\x1b[31m"))
    assert found is not None
    assert found.address == "[fe80::1]:8470"
    assert "\x1b" not in found.text["rig"]


def test_every_announced_service_gets_a_row_and_none_gets_a_token(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    both = [AnnouncedService("a:1", {}), AnnouncedService("b:2", {})]
    monkeypatch.setattr(mdns_browser, "find_services", lambda: both)
    assert _announced_services("") == ["a:1", "b:2"]
    with pytest.raises(MonitorError, match="not sent to announced addresses"):
        _announced_services("syn_" + "a" * 43)
    monkeypatch.setattr(mdns_browser, "find_services", list)
    with pytest.raises(MonitorError, match="no service announced itself"):
        _announced_services("")
