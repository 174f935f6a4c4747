"""MAVSDK, which we did not write, sees a camera, takes photos with it and misses none."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from daemon.configuration.model import MavlinkCameraSection
from daemon.onboard.monitoring.access.command_gateway import CommandGateway
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.mavlink.camera import MavlinkCamera
from daemon.onboard.service.messages import Answer, CommandRefused, ServiceCommand
from processing.rig import load_rig, shipped_rigs
from tests.daemon.onboard.monitoring import flight_events

pytestmark = pytest.mark.realtime


WITHIN_S = 40.0
RIG = load_rig(shipped_rigs()["ultracam-x-mini"])


class Flying:
    """A camera component over a service that exposes immediately on command."""

    def __init__(self, **settings: Any) -> None:
        self.port = free_port()
        connect = f"{settings.pop('scheme', 'udpout')}:127.0.0.1:{self.port}"
        self.settings = MavlinkCameraSection(connect=connect, **settings)
        self.state = FlightState("syntopic test")
        self.state.apply(flight_events.mission())
        self.state.apply(flight_events.status("ready"))
        self.commands: list[ServiceCommand] = []
        self.refused: list[CommandRefused] = []
        self.lose: set[int] = set()
        self.number = 0
        self.sent_indices: list[int] = []
        self._loop = asyncio.new_event_loop()
        self._begun = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        assert self._begun.wait(30)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self.gateway = CommandGateway(self._execute)
        self.camera = MavlinkCamera(
            self.settings, self.state, self.gateway, lambda: RIG, lambda: 395.0
        )
        self._loop.run_until_complete(self.camera.begin())
        really_send = self.camera._send

        def send(message: Any, address: tuple[str, int]) -> None:
            if message.get_type() == "CAMERA_IMAGE_CAPTURED":
                self.sent_indices.append(message.image_index)
                if message.image_index in self.lose:
                    self.lose.discard(message.image_index)
                    return
            really_send(message, address)

        self.camera._send = send
        self._begun.set()
        self._loop.run_forever()

    def _execute(self, command: ServiceCommand | CommandRefused) -> None:
        if isinstance(command, CommandRefused):
            self.refused.append(command)
            return
        self.commands.append(command)
        self._loop.call_soon(self.gateway.on_answer, Answer(command.number, True, "done"))
        if command.name == "trigger":
            self._loop.call_later(0.1, self._expose)
        elif command.name == "interval":
            for i in range(command.arguments["count"]):
                self._loop.call_later(command.arguments["interval_s"] * (i + 1), self._expose)

    def _expose(self) -> None:
        self.number += 1
        for event in flight_events.exposure(self.number):
            self.state.apply({**event, "mark_gps_ns": "1479300000000000000"})

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self.camera.end)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(10)


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_for(is_so: Callable[[], Any], what: str) -> Any:
    deadline = time.monotonic() + WITHIN_S
    while not (found := is_so()):
        assert time.monotonic() < deadline, f"waited {WITHIN_S} s for {what}"
        time.sleep(0.05)
    return found


@pytest.fixture
def flying() -> Iterator[Flying]:
    flying = Flying(commands="any")
    yield flying
    flying.close()


@pytest.fixture
def client(flying: Flying) -> Iterator[Any]:
    mavsdk = pytest.importorskip("mavsdk", reason="mavsdk is absent; pip install it")
    from mavsdk.plugins.camera import Camera

    sdk = mavsdk.Mavsdk(
        mavsdk.Configuration.create_with_component_type(mavsdk.ComponentType.GROUND_STATION)
    )
    sdk.add_any_connection(f"udpin://127.0.0.1:{flying.port}")
    wait_for(sdk.get_systems, "the camera's heartbeat")
    yield Camera(sdk.get_systems()[0])


@pytest.mark.peer
def test_mavsdk_lists_the_rig_as_one_camera(client: Any) -> None:
    listed = wait_for(lambda: client.camera_list().cameras, "the list of cameras")
    (camera,) = listed
    virtual = RIG.virtual_image
    assert virtual is not None
    assert camera.vendor_name == "Syntopic"
    assert camera.model_name == "ultracam-x-mini"
    assert camera.focal_length_mm == pytest.approx(virtual.f_mm)
    assert camera.horizontal_resolution_px == virtual.width_px
    assert camera.vertical_resolution_px == virtual.height_px
    assert camera.horizontal_sensor_size_mm == pytest.approx(virtual.width_px * virtual.pitch_mm)


@pytest.mark.peer
def test_mavsdk_takes_photos_and_recovers_a_lost_record(client: Any, flying: Flying) -> None:
    (camera,) = wait_for(lambda: client.camera_list().cameras, "the list of cameras")
    received: list[Any] = []
    client.subscribe_capture_info(
        lambda *messages: received.extend(t for t in messages if hasattr(t, "index"))
    )
    flying.lose = {1}
    for count in (1, 2, 3):
        client.take_photo(camera.component_id)
        wait_for(lambda n=count: flying.number >= n, f"exposure {count}")
        time.sleep(0.3)
    wait_for(lambda: {one.index for one in received} >= {0, 1, 2}, "records of all three")
    assert [c.name for c in flying.commands] == ["trigger"] * 3
    assert all(c.by.startswith("mavlink ") for c in flying.commands)
    # The lost one was sent twice: first lost, then on request.
    assert flying.sent_indices.count(1) >= 2
    lost = next(one for one in received if one.index == 1)
    assert lost.position.latitude_deg == pytest.approx(47.07)
    assert lost.position.absolute_altitude_m == pytest.approx(1395.0)
    assert lost.position.relative_altitude_m == pytest.approx(1000.0)
    assert lost.time_utc_us == 1_479_300_000_000_000 + 315_964_800_000_000 - 18_000_000


@pytest.mark.peer
def test_mavsdk_runs_an_interval(client: Any, flying: Flying) -> None:
    (camera,) = wait_for(lambda: client.camera_list().cameras, "the list of cameras")
    client.start_photo_interval(camera.component_id, 0.2)
    wait_for(lambda: flying.commands, "the command")
    command = flying.commands[0]
    assert command.name == "interval"
    assert command.arguments["interval_s"] == pytest.approx(0.2)
    client.stop_photo_interval(camera.component_id)
    wait_for(lambda: [c.name for c in flying.commands] == ["interval", "stop"], "the stop")
