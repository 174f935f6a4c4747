"""Several aircraft on one page."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from fastapi.testclient import TestClient

from daemon.cli.monitor_fleet import FleetError, serve_fleet
from daemon.onboard.monitoring.client.telemetry_client import (
    AccessOptions,
    ClientError,
    parse_service_address,
)
from daemon.onboard.monitoring.fleet import OLD_S, FleetMember, create_fleet_app, fleet_json
from daemon.onboard.monitoring.flight_state import FlightState
from tests.daemon.onboard.monitoring import flight_events
from tests.support.browser import Browser, chromium


def member(
    address: str, *events: dict[str, Any], rig: str = "", now_s: float = 10.0
) -> FleetMember:
    state = FlightState("syntopic test")
    for event in (flight_events.mission() | {"rig": rig or address}, *events):
        state.apply(event)
    created = FleetMember(parse_service_address(address), AccessOptions())
    created.add(state.snapshot(), now_s)
    return created


def checksum(device: str) -> dict[str, Any]:
    return flight_events.device_event(device, "checksum", "Look.", fault=True)


def test_each_aircraft_has_a_row_and_their_alarms_are_one_list() -> None:
    quiet = member("a:1", flight_events.status("flying", triggers=7), checksum("gnss"), rig="one")
    loud = member("b:2", flight_events.lost("SU02"), rig="two")
    found = fleet_json([quiet, loud], now_s=11.0)
    assert [(row["name"], row["is_linked"], row["age_s"]) for row in found["aircraft"]] == [
        ("one", True, 1.0),
        ("two", True, 1.0),
    ]
    assert found["aircraft"][0]["triggers"] == 7
    assert [(a["aircraft"], a["code"]) for a in found["alarms"]] == [
        ("two", "device/lost"),
        ("one", "device/checksum"),
    ]


def test_an_old_or_lost_state_is_not_shown_as_linked() -> None:
    old, lost = member("a:1"), member("b:2")
    lost.add(None, 10.5)
    rows = fleet_json([old, lost], now_s=10.0 + OLD_S + 0.1)["aircraft"]
    assert [row["is_linked"] for row in rows] == [False, False]
    assert "lost" in rows[1]["problem"]
    assert fleet_json([lost], now_s=10.6)["aircraft"][0]["is_linked"] is False
    never = FleetMember(parse_service_address("c:3"), AccessOptions())
    row = fleet_json([never], now_s=1.0)["aircraft"][0]
    assert (row["is_linked"], row["age_s"], row["name"]) == (False, None, "http://c:3")


def test_a_hostile_record_makes_no_row_fail() -> None:
    hostile = FleetMember(parse_service_address("a:1"), AccessOptions())
    hostile.add({"mission": 7, "status": [], "faults": [3, {"severity": []}], "phase": {}}, 1.0)
    found = fleet_json([hostile], now_s=1.0)
    assert len(found["alarms"]) == 1


def test_the_page_and_its_state_are_served_with_the_policy_of_the_page() -> None:
    client = TestClient(create_fleet_app([member("a:1")]))
    assert client.get("/api/v1/fleet").json()["aircraft"][0]["address"] == "http://a:1"
    page = client.get("/")
    assert "fleet.js" in page.text
    assert "default-src 'self'" in page.headers["Content-Security-Policy"]
    assert client.post("/api/v1/fleet").status_code == 405


def test_an_address_of_the_page_that_is_none_is_refused() -> None:
    with pytest.raises(FleetError, match="write HOST:PORT"):
        serve_fleet("here", [parse_service_address("a:1")], AccessOptions())


@pytest.mark.trust
@pytest.mark.parametrize("listen_at", ["0.0.0.0:8480", "[::]:8480", "10.0.0.5:8480", "tower:8480"])
def test_what_needs_a_token_is_not_served_to_other_machines_without_one(
    listen_at: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    served: list[str] = []
    monkeypatch.setattr("uvicorn.run", lambda *_, host, **__: served.append(host))
    monkeypatch.setattr(FleetMember, "start", lambda _member: None)
    service = parse_service_address("127.0.0.1:1")
    access = AccessOptions("syn_" + "a" * 43)
    with pytest.raises(FleetError, match="--serve-without-token"):
        serve_fleet(listen_at, [service], access)
    assert served == []
    for at, given, is_open in (
        (listen_at, AccessOptions(), False),
        (listen_at, access, True),
        ("127.0.0.1:8480", access, False),
        ("8480", access, False),
    ):
        serve_fleet(at, [service], given, is_open=is_open)
    assert len(served) == 4


def test_the_reason_of_a_lost_connection_is_shown_and_that_values_are_old(tmp_path: Path) -> None:
    chromium()
    broken = FleetMember(parse_service_address("127.0.0.1:1"), AccessOptions(), _refused)
    broken.start()
    config = uvicorn.Config(create_fleet_app([broken]), port=0, log_level="error", lifespan="off")
    server = uvicorn.Server(config)
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
        thread.start()
        with Browser(tmp_path / "profile") as browser:
            browser.open(f"http://127.0.0.1:{listening.getsockname()[1]}/")
            browser.wait_for(
                "document.querySelector('#aircraft .problem')?.innerText === 'token rejected'", 30
            )
            # What is shown stays, and the page states since when it is old.
            server.should_exit = True
            thread.join(30)
            browser.wait_for("!document.querySelector('#connection-lost').hidden", 30)
            assert "frozen" in browser.text("#connection-lost")


def _refused(*_: Any) -> Iterator[dict[str, Any] | None]:
    raise ClientError("token rejected")
