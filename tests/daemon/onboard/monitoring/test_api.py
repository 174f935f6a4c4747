"""The API reports the state to clients and executes commands with a valid token only."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import msgpack
import pytest
from fastapi.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from daemon.onboard.monitoring.access.command_gateway import CommandGateway
from daemon.onboard.monitoring.access.roles import COMMAND_ROLES
from daemon.onboard.monitoring.access.tokens import add_token, read_tokens
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.web.api import AccessSettings, CommandName, create_app
from daemon.onboard.service.messages import Answer, CommandRefused, ServiceCommand
from tests.daemon.onboard.monitoring import flight_events


class Camera:
    """A service that answers at once, as long as it `lives`."""

    def __init__(self, folder: Path) -> None:
        self.commands: list[ServiceCommand] = []
        self.refused: list[CommandRefused] = []
        self.lives = True
        self.refusal = ""
        self.state = FlightState("syntopic test")
        self.state.apply(flight_events.mission(str(folder / "mission")))
        self.gateway = CommandGateway(self.receive)
        path = folder / "tokens.toml"
        self.operator = add_token(path, "operator", "operator")
        self.administrator = add_token(path, "chief", "administrator")
        self.pilot = add_token(path, "pilot", "observer")
        self.tokens = read_tokens(path)

    def receive(self, command: ServiceCommand | CommandRefused) -> None:
        if isinstance(command, CommandRefused):
            self.refused.append(command)
            return
        self.commands.append(command)
        if self.lives:
            answer = Answer(command.number, not self.refusal, self.refusal or "done as asked")
            asyncio.get_running_loop().call_soon(self.gateway.on_answer, answer)

    def client(self, *, anonymous_read: bool = True) -> TestClient:
        return TestClient(
            create_app(self.state, self.gateway, AccessSettings(self.tokens, anonymous_read))
        )


@pytest.fixture
def camera(tmp_path: Path) -> Camera:
    product = tmp_path / "mission/L2/000001"
    product.mkdir(parents=True)
    (product / "quicklook.jpg").write_bytes(b"\xff\xd8jpeg")
    (tmp_path / "mission/service.toml").write_text("[mission]\n")
    return Camera(tmp_path)


@pytest.fixture
def client(camera: Camera) -> Iterator[TestClient]:
    with camera.client() as client:
        yield client


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def test_requested_parts_are_reported(camera: Camera, client: TestClient) -> None:
    for event in (
        *flight_events.exposure(1),
        *flight_events.exposure(2, "refly"),
        flight_events.status(triggers=2),
    ):
        camera.state.apply(event)
    state = client.get("/api/v1/state").json()
    assert state["version"] == 1
    assert state["simulated"] is True
    assert [one["number"] for one in state["exposures"]] == [1, 2]
    assert client.get("/api/v1/ledger").json()["balanced"] is True
    assert [e["number"] for e in client.get("/api/v1/exposures?after=1").json()] == [2]
    assert client.get("/api/v1/exposures/2").json()["verdict"] == "refly"
    assert client.get("/api/v1/configuration").text == "[mission]\n"
    image = client.get("/api/v1/exposures/1/quicklook.jpg")
    assert image.headers["content-type"] == "image/jpeg"
    assert image.content.startswith(b"\xff\xd8")


def test_errors_are_problems(client: TestClient) -> None:
    for path, status in (
        ("/api/v1/exposures/9", 404),
        ("/api/v1/exposures/2/quicklook.jpg", 404),
        ("/api/v1/exposures/0", 422),
        ("/api/v1/exposures/1/..%2f..%2fservice.toml", 404),
        ("/api/v1/exposures?limit=0", 422),
        ("/api/v1/nothing", 404),
    ):
        answer = client.get(path)
        assert answer.status_code == status, path
        assert answer.headers["content-type"] == "application/problem+json", path
        assert answer.json()["status"] == status
    assert client.delete("/api/v1/state").status_code == 405


def test_commands_require_an_authorized_token(camera: Camera, client: TestClient) -> None:
    assert client.post("/api/v1/commands/start").status_code == 401
    assert client.post("/api/v1/commands/start", headers=bearer("guess")).status_code == 401
    answer = client.post("/api/v1/commands/start", headers=bearer(camera.pilot))
    assert answer.status_code == 403
    assert "pilot has the role observer; start needs the role operator" in answer.json()["detail"]
    assert camera.commands == []
    done = client.post("/api/v1/commands/start", headers=bearer(camera.operator))
    assert done.json() == {"done": True, "sentence": "done as asked"}
    (command,) = camera.commands
    assert (command.name, command.by, command.role) == ("start", "operator", "operator")
    assert command.address == "testclient"
    assert [(one.name, one.by, one.role, one.address) for one in camera.refused] == [
        ("start", "unknown", "none", "testclient"),
        ("start", "unknown", "none", "testclient"),
        ("start", "pilot", "observer", "testclient"),
    ]


@pytest.mark.trust
@pytest.mark.parametrize("name", get_args(CommandName))
def test_each_command_is_executed_from_its_role_upwards(
    camera: Camera, client: TestClient, name: str
) -> None:
    assert name in COMMAND_ROLES
    camera.state.apply(flight_events.lost("SU02"))
    (fault,) = client.get("/api/v1/faults").json()
    body = {"fault": fault["id"]} if name == "acknowledge" else {}
    by_role = (camera.pilot, camera.operator, camera.administrator)
    obeyed = [
        client.post(f"/api/v1/commands/{name}", headers=bearer(token), json=body).status_code == 200
        for token in by_role
    ]
    needs_administrator = name in ("new-mission", "release-disk", "accept-disk", "shutdown")
    assert obeyed == [False, not needs_administrator, True]
    assert len(camera.commands) == sum(obeyed)
    assert len(camera.refused) == 3 - sum(obeyed)


@pytest.mark.trust
def test_a_token_travels_in_a_header_and_never_in_the_address(camera: Camera) -> None:
    telemetry = "/api/v1/telemetry?form=json"
    with camera.client(anonymous_read=False) as client:
        for address, given in (
            (telemetry, {}),
            (f"{telemetry}&token={camera.pilot}", {}),
            (f"{telemetry}&token={camera.pilot}", {"headers": bearer(camera.pilot)}),
            (telemetry, {"subprotocols": ["syntopic.v1", "bearer.syn_guess"]}),
            (telemetry, {"headers": bearer("syn_guess")}),
        ):
            with pytest.raises(WebSocketDisconnect), client.websocket_connect(address, **given):
                pass
        with client.websocket_connect(telemetry, headers=bearer(camera.pilot)) as socket:
            assert socket.receive_json()["version"] == 1
        offered = ["syntopic.v1", f"bearer.{camera.pilot}"]
        with client.websocket_connect(telemetry, subprotocols=offered) as socket:
            assert socket.accepted_subprotocol == "syntopic.v1"
            assert socket.receive_json()["version"] == 1


def test_guessing_is_stopped_and_keeps_no_valid_token_out(
    camera: Camera, client: TestClient
) -> None:
    for _ in range(5):
        client.post("/api/v1/commands/start", headers=bearer("guess"))
    blocked = client.post("/api/v1/commands/start", headers=bearer("guess"))
    assert blocked.status_code == 429
    assert camera.commands == []
    stop = client.post("/api/v1/commands/stop", headers=bearer(camera.operator))
    assert stop.status_code == 200
    assert client.get("/api/v1/brief").status_code == 200  # watching goes on


def test_a_closed_service_shows_nothing_without_a_token(camera: Camera) -> None:
    with camera.client(anonymous_read=False) as client:
        assert client.get("/api/v1/state").status_code == 401
        assert client.get("/metrics").status_code == 401
        assert client.get("/api/v1/state", headers=bearer(camera.pilot)).status_code == 200
        assert client.get("/").status_code == 200  # the page itself holds nothing


def test_the_refusal_of_the_service_is_returned_unchanged(
    camera: Camera, client: TestClient
) -> None:
    camera.refusal = "missing: head SU02; override to fly without"
    answer = client.post("/api/v1/commands/start", headers=bearer(camera.operator))
    assert answer.status_code == 409
    assert answer.json()["detail"] == camera.refusal


def test_a_service_that_does_not_answer_is_not_waited_for_long(
    camera: Camera, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daemon.onboard.monitoring.access.command_gateway.ANSWER_TIMEOUT_S", 0.1)
    camera.lives = False
    answer = client.post("/api/v1/commands/stop", headers=bearer(camera.operator))
    assert answer.status_code == 504


def test_a_fault_is_acknowledged(camera: Camera, client: TestClient) -> None:
    camera.state.apply(flight_events.lost("SU02"))
    camera.state.apply(flight_events.recovered("SU02"))
    (fault,) = client.get("/api/v1/faults").json()
    send = {"headers": bearer(camera.operator)}
    assert client.post("/api/v1/commands/acknowledge", **send).status_code == 409
    unknown = client.post("/api/v1/commands/acknowledge", json={"fault": "x"}, **send)
    assert unknown.status_code == 404
    done = client.post("/api/v1/commands/acknowledge", json={"fault": fault["id"]}, **send)
    assert done.status_code == 200
    assert client.get("/api/v1/faults").json() == []


def test_telemetry_begins_with_the_complete_state_and_continues(
    camera: Camera, client: TestClient
) -> None:
    for event in flight_events.exposure(1):
        camera.state.apply(event)
    with client.websocket_connect("/api/v1/telemetry?form=json") as socket:
        first = socket.receive_json()
        assert [one["number"] for one in first["exposures"]] == [1]
        for event in flight_events.exposure(2):
            camera.state.apply(event)
        while True:
            record = socket.receive_json()
            if any(one["step"] == "processed" for one in record.get("exposures", [])):
                break
        assert [one["number"] for one in record["exposures"]] == [2]
    with client.websocket_connect("/api/v1/telemetry") as socket:
        assert msgpack.unpackb(socket.receive_bytes())["version"] == 1


def test_metrics_speak_prometheus(camera: Camera, client: TestClient) -> None:
    from prometheus_client.parser import text_string_to_metric_families

    for event in (
        *flight_events.exposure(1),
        flight_events.status(triggers=1),
        flight_events.lost("SU02"),
        {"event": "counters", "devices": {"SU02": {"frames": 7, "underruns": 0}}},
    ):
        camera.state.apply(event)
    text = client.get("/metrics").text
    samples = {
        (s.name, tuple(sorted(s.labels.items()))): s.value
        for family in text_string_to_metric_families(text)
        for s in family.samples
    }
    assert samples["syntopic_triggers_total", ()] == 1
    assert samples["syntopic_exposures_total", (("state", "complete"),)] == 1
    assert samples["syntopic_frames_total", (("cause", "used"),)] == 13
    assert samples["syntopic_marks_pending", ()] == 0
    rules = (Path(__file__).parents[4] / "systemd/alerts.yml").read_text()
    requests = set(re.findall(r"syntopic_\w+", rules))
    assert requests and requests <= {name for name, _ in samples}
    assert samples["syntopic_clock_sigma_seconds", ()] == pytest.approx(25e-9)
    assert samples["syntopic_device_ready", (("device", "SU02"), ("kind", ""))] == 0
    labels = (("counter", "frames"), ("device", "SU02"), ("kind", ""))
    assert samples["syntopic_device_events_total", labels] == 7
    assert samples["syntopic_phase", (("phase", "flying"),)] == 1


def test_the_page_is_small_and_requests_no_other_host(client: TestClient) -> None:
    page = client.get("/")
    assert page.status_code == 200
    assert "default-src 'self'" in page.headers["Content-Security-Policy"]
    folder = Path(__file__).parents[4] / "daemon/onboard/monitoring/web/page"
    own = [path for path in folder.rglob("*") if path.is_file() and "leaflet" not in path.name]
    # A browser loads the catalogs of one language, an English one not that of the service.
    loaded = [path for path in own if "messages" not in path.parts or path.parent.name == "fr"]
    assert sum(path.stat().st_size for path in loaded) < 515_000
    for path in own:
        if path.suffix in (".js", ".html", ".css") and path.parent.name != "vendor":
            assert "http://" not in path.read_text().replace("http://127", ""), path
            assert "https://" not in path.read_text(), path
    assert client.get("/docs").status_code == 200
    assert client.get("/openapi.json").json()["info"]["title"] == "Syntopic"


@pytest.mark.attack
@pytest.mark.parametrize(
    ("body", "kind"),
    [
        (b"[[[", "application/json"),
        (b'{"unknown": 1}', "application/json"),
        (b"x=1", "text/plain"),
        (b"[" * 20_000, "application/json"),
    ],
)
def test_the_role_is_checked_before_the_body_and_every_attempt_is_recorded(
    camera: Camera, client: TestClient, body: bytes, kind: str
) -> None:
    def answer(name: str, token: str) -> int:
        headers = bearer(token) | {"Content-Type": kind}
        path = f"/api/v1/commands/{name}"
        return int(client.post(path, content=body, headers=headers).status_code)

    assert answer("start", camera.pilot) == 403
    assert answer("nonsense", camera.pilot) == 403
    assert answer("release-disk", camera.operator) == 403
    assert answer("start", camera.operator) in (413, 415, 422)
    assert answer("nonsense", camera.operator) == 422
    assert [(one.name, one.by, one.role) for one in camera.refused] == [
        ("start", "pilot", "observer"),
        ("unknown", "pilot", "observer"),
        ("release-disk", "operator", "operator"),
        ("start", "operator", "operator"),
        ("unknown", "operator", "operator"),
    ]
    assert camera.commands == []
