"""MAVSDK takes photos with a flying rig, and the exposures it asked for are in the ledger."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from daemon.cli.sim import Emulator, free_first_address, service_toml, simulator_arguments
from tests.daemon.onboard.monitoring.test_mavsdk_camera import free_port
from tests.system.demo_mission import DemoMission
from tests.system.test_operators_page import READY_WITHIN_S, Running

PHOTOS = 2


@pytest.mark.system
@pytest.mark.peer
@pytest.mark.timeout(600)
def test_photos_that_a_ground_station_asked_for_are_in_the_ledger(
    tmp_path: Path, flown: DemoMission
) -> None:
    mavsdk = pytest.importorskip("mavsdk", reason="mavsdk is absent; pip install it")
    from mavsdk.plugins.camera import Camera

    arguments = simulator_arguments(
        "ultracam-x-mini", tmp_path / "sim", seed=1, dc=0.0, displace=[]
    )
    arguments += ["--scene-cache", str(flown.scenes), "--exposures", str(PHOTOS + 1)]
    emulator = Emulator([*arguments, "--still", "--first-address", free_first_address()])
    port = free_port()
    text = service_toml(emulator.ready, root="missions", watch_port=0)
    text = text.replace("[trigger]\n", '[trigger]\nstart = "on command"\n')
    text += f'\n[watch.mavlink]\nconnect = "udpout:127.0.0.1:{port}"\ncommands = "any"\n'
    config = tmp_path / "service.toml"
    config.write_text(text)
    service = Running(config)
    try:
        service.wait_for(lambda e: e["event"] == "ready", READY_WITHIN_S)
        sdk = mavsdk.Mavsdk(
            mavsdk.Configuration.create_with_component_type(mavsdk.ComponentType.GROUND_STATION)
        )
        sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        camera = _camera(sdk, Camera)
        (listed,) = _wait(lambda: camera.camera_list().cameras)
        received: list[Any] = []
        camera.subscribe_capture_info(
            lambda *telemetry: received.extend(one for one in telemetry if hasattr(one, "index"))
        )
        for number in range(1, PHOTOS + 1):
            camera.take_photo(listed.component_id)
            service.wait_for(
                lambda e, n=number: e["event"] == "sealed" and e["number"] == n, READY_WITHIN_S
            )
        _wait(lambda: {one.index for one in received} >= set(range(PHOTOS)))
        service.process.terminate()
        ended = service.wait_for(lambda e: e["event"] == "ended", 90)
        assert ended["ledger"]["balanced"]
        assert ended["ledger"]["triggers"]["triggers"] == PHOTOS
        assert ended["ledger"]["triggers"]["lost"] == 0
        by = {e["by"].split("/")[0] for e in service.events if e["event"] == "command"}
        assert len(by) == 1
        assert by.pop().startswith("mavlink ")
    finally:
        if service.process.poll() is None:
            service.process.kill()
            service.process.wait(60)
        emulator.end()


def _camera(sdk: Any, plugin: Any) -> Any:
    return plugin(_wait(sdk.get_systems)[0])


def _wait(telemetry: Any, within_s: float = 60.0) -> Any:
    deadline = time.monotonic() + within_s
    while not (found := telemetry()):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    return found
