"""The camera component obeys whom it may, answers what makes sense, and survives what does not."""

from __future__ import annotations

import asyncio
import math
import secrets
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from daemon.configuration.model import MavlinkCameraSection
from daemon.onboard.monitoring.access.command_gateway import CommandGateway
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.mavlink.camera import MavlinkCamera
from daemon.onboard.monitoring.mavlink.requests import service_command
from daemon.onboard.monitoring.mavlink.signatures import read_key
from processing.rig import load_rig, shipped_rigs
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.test_mavsdk_camera import Flying, wait_for

pytestmark = pytest.mark.realtime


dialect = pytest.importorskip(
    "pymavlink.dialects.v20.ardupilotmega", reason="pip install 'syntopic[mavlink]'"
)
KEY = bytes(range(32))
RIG = load_rig(shipped_rigs()["ultracam-x-mini"])


class Station:
    """A ground station by pymavlink itself, at the port the camera reports."""

    def __init__(self, port: int, key: bytes | None = None) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", port))
        self.socket.settimeout(0.2)
        self.mav = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
        self.reader = dialect.MAVLink(None)
        self.reader.robust_parsing = True
        if key is not None:
            self.mav.signing.secret_key = key
            self.mav.signing.sign_outgoing = True
            self.mav.signing.timestamp = round((time.time() - 1_420_070_400) * 1e5)
        self.received: list[Any] = []
        wait_for(lambda: self.receive("HEARTBEAT"), "a heartbeat")

    def receive(self, kind: str) -> list[Any]:
        try:
            data, self.camera = self.socket.recvfrom(2048)
            self.received += self.reader.parse_buffer(bytearray(data)) or []
        except TimeoutError:
            pass
        return [message for message in self.received if message.get_type() == kind]

    def request(self, command: int, *parameters: float) -> Any:
        """Send a command and return its acknowledgement's result."""
        self.received.clear()
        given = [*parameters, *([0.0] * (7 - len(parameters)))]
        message = self.mav.command_long_encode(1, 100, command, 0, *given)
        self.socket.sendto(bytes(message.pack(self.mav)), self.camera)
        (ack, *_) = wait_for(lambda: self.receive("COMMAND_ACK"), f"the answer to {command}")
        assert (ack.target_system, ack.target_component) == (255, 190)
        return ack.result

    def close(self) -> None:
        self.socket.close()


@pytest.fixture
def key_file(tmp_path: Path) -> Path:
    path = tmp_path / "key"
    path.write_text(KEY.hex() + "\n")
    path.chmod(0o600)
    return path


@pytest.fixture
def signed(key_file: Path) -> Iterator[Flying]:
    flying = Flying(commands="signed", signing_key=key_file)
    yield flying
    flying.close()


def test_only_signed_commands_are_executed_and_any_client_may_read(signed: Flying) -> None:
    unknown_sender = Station(signed.port)
    assert unknown_sender.request(512, 259) == dialect.MAV_RESULT_ACCEPTED
    assert wait_for(lambda: unknown_sender.receive("CAMERA_INFORMATION"), "what camera it is")
    assert unknown_sender.request(2000, 0, 0, 1) == dialect.MAV_RESULT_DENIED
    assert signed.commands == []
    wait_for(lambda: signed.refused, "the record of the refused command")
    (refused,) = signed.refused
    assert (refused.name, refused.role, refused.address) == ("trigger", "none", "udp 127.0.0.1")
    assert refused.by.startswith("mavlink ") and "signature" in refused.sentence
    unknown_sender.close()
    forger = Station(signed.port, secrets.token_bytes(32))
    forger.received.clear()
    message = forger.mav.command_long_encode(1, 100, 2000, 0, 0, 0, 1, 0, 0, 0, 0)
    forger.socket.sendto(bytes(message.pack(forger.mav)), forger.camera)
    time.sleep(0.5)
    assert signed.commands == []
    forger.close()
    operator = Station(signed.port, KEY)
    assert operator.request(2000, 0, 0, 1) == dialect.MAV_RESULT_ACCEPTED
    assert [(c.name, c.role) for c in signed.commands] == [("trigger", "operator")]
    operator.close()


def test_a_recorded_command_cannot_be_played_again(signed: Flying) -> None:
    operator = Station(signed.port, KEY)
    message = operator.mav.command_long_encode(1, 100, 2000, 0, 0, 0, 1, 0, 0, 0, 0)
    recorded = bytes(message.pack(operator.mav))
    operator.socket.sendto(recorded, operator.camera)
    wait_for(lambda: len(signed.commands) == 1, "the command")
    for _ in range(5):
        operator.socket.sendto(recorded, operator.camera)
    time.sleep(0.5)
    assert len(signed.commands) == 1
    operator.close()


def test_requests_of_every_kind_are_answered_or_refused() -> None:
    flying = Flying(commands="none")
    station = Station(flying.port)
    try:
        accepted, unsupported = dialect.MAV_RESULT_ACCEPTED, dialect.MAV_RESULT_UNSUPPORTED
        for identity, kind in (
            (259, "CAMERA_INFORMATION"),
            (260, "CAMERA_SETTINGS"),
            (261, "STORAGE_INFORMATION"),
            (262, "CAMERA_CAPTURE_STATUS"),
        ):
            assert station.request(512, identity) == accepted
            assert wait_for(lambda k=kind: station.receive(k), kind)
        assert station.request(512, 269) == unsupported
        assert station.request(512, math.nan) == unsupported
        assert station.request(512, 263, math.nan) == dialect.MAV_RESULT_DENIED
        assert station.request(2002, 17) == dialect.MAV_RESULT_DENIED
        assert station.request(31337) == unsupported
        assert station.request(2000, 0, 1, 3) == dialect.MAV_RESULT_DENIED  # nobody may command
        assert flying.camera.counts["commands_refused"] == 1
        wait_for(lambda: flying.refused, "the record of the refused command")
    finally:
        station.close()
        flying.close()


@given(
    st.sampled_from(["capture", "distance", "interval", "control", "once", "stop"]),
    st.lists(st.floats(width=32), min_size=7, max_size=7),
)
def test_no_parameter_is_too_odd(action: str, parameters: list[float]) -> None:
    message = dialect.MAVLink(None).command_long_encode(1, 100, 2000, 0, *parameters)
    expected = service_command(action, message)
    assert expected is None or expected[0] in ("trigger", "interval", "distance", "start", "stop")


@settings(max_examples=300)
@given(st.binary(max_size=300))
def test_any_bytes_are_received_without_error(data: bytes) -> None:
    camera = _camera()
    camera.datagram_received(data, ("127.0.0.1", 1))
    assert len(camera._senders.peers) <= 1


def test_damaged_messages_are_counted_and_the_next_is_understood() -> None:
    camera = _camera()
    mav = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    good = bytes(mav.heartbeat_encode(6, 8, 0, 0, 4).pack(mav))
    for cut in range(1, len(good)):
        camera.datagram_received(good[:cut], ("127.0.0.1", 1))
        camera.datagram_received(bytes(len(good)) + good + good, ("127.0.0.1", 1))
    assert camera.counts["messages"] >= len(good) - 1
    assert camera.counts["bad_bytes"] > 0


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"connect": "tcp:host:1"}, "udpout:HOST:PORT"),
        ({"connect": "udpin:host:port"}, "udpout:HOST:PORT"),
        ({"commands": "signed"}, "signing_key is missing"),
        ({"component_id": 99}, "greater than or equal to 100"),
    ],
)
def test_settings_that_cannot_work_are_refused(settings: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValidationError, match=sentence):
        MavlinkCameraSection(**settings)


def test_a_key_that_is_none_is_refused(tmp_path: Path) -> None:
    (tmp_path / "key").write_text("abc")
    section = MavlinkCameraSection(commands="signed", signing_key=tmp_path / "key")
    with pytest.raises(ValueError, match="signing key"):
        MavlinkCamera(section, FlightState("x"), CommandGateway(lambda _: None), lambda: RIG)


@pytest.mark.trust
@pytest.mark.parametrize("mode", [0o604, 0o602, 0o644, 0o666])
def test_a_key_that_everybody_may_read_or_change_is_refused_with_the_command(
    tmp_path: Path, mode: int
) -> None:
    path = tmp_path / "the key"
    path.write_text(KEY.hex())
    path.chmod(mode)
    section = MavlinkCameraSection(commands="signed", signing_key=path)
    with pytest.raises(ValueError, match=f"chmod 600 '{path}'"):
        MavlinkCamera(section, FlightState("x"), CommandGateway(lambda _: None), lambda: RIG)
    for closed in (0o600, 0o640):
        path.chmod(closed)
        assert read_key(path) == KEY


def _camera() -> MavlinkCamera:
    state = FlightState("syntopic test")
    state.apply(flight_events.mission())
    with asyncio.Runner():
        return MavlinkCamera(
            MavlinkCameraSection(), state, CommandGateway(lambda _: None), lambda: RIG
        )
