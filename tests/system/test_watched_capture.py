"""Fifty watchers join a flight, ten of them take nothing: what capture takes stays as it was."""

from __future__ import annotations

import asyncio
import statistics
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from daemon.cli.sim import Emulator, free_first_address, service_toml, simulator_arguments
from tests.daemon.onboard.monitoring.test_watchers import STALLED, WATCHERS, follow, stall
from tests.system.demo_mission import DemoMission
from tests.system.test_operators_page import READY_WITHIN_S, Running, busy_share

pytestmark = [pytest.mark.soak, pytest.mark.timeout(900)]

UNWATCHED, WATCHED = 15, 15
EXPOSURES = UNWATCHED + WATCHED


def test_capture_takes_no_longer_with_fifty_watchers(
    tmp_path: Path, flown: DemoMission, record_property: Callable[[str, Any], None]
) -> None:
    arguments = simulator_arguments("ultracam-x-mini", tmp_path / "sim", seed=1, dc=0, displace=[])
    arguments += ["--scene-cache", str(flown.scenes), "--exposures", str(EXPOSURES), "--still"]
    emulator = Emulator([*arguments, "--first-address", free_first_address()])
    config = tmp_path / "service.toml"
    config.write_text(service_toml(emulator.ready, root="missions", count=EXPOSURES, watch_port=0))
    print(f"cores busy with other things: {busy_share():.0%}")
    service = Running(config)
    try:
        port = service.wait_for(lambda e: e["event"] == "watching", READY_WITHIN_S)["port"]
        service.wait_for(lambda e: e["event"] == "ready", READY_WITHIN_S)
        service.wait_for(lambda e: e["event"] == "stored" and e["number"] == UNWATCHED, 300)
        watching = threading.Thread(target=lambda: asyncio.run(watch(port)))
        watching.start()
        watching.join(300)
        service.process.terminate()
        ended = service.wait_for(lambda e: e["event"] == "ended", 60)
    finally:
        if service.process.poll() is None:
            service.process.terminate()
            service.process.wait(60)
        emulator.end()
    assert ended["failure"] is None and ended["ledger"]["triggers"]["lost"] == 0
    # The first exposure warms what it touches; that during which they join is neither nor.
    alone = stored_s(service, range(2, UNWATCHED + 1))
    watched = stored_s(service, range(UNWATCHED + 2, EXPOSURES + 1))
    for name, values in (("alone", alone), ("watched", watched)):
        latency_text = f"{statistics.median(values):.3f} ({min(values):.3f} to {max(values):.3f}) s"
        print(f"trigger to stored, {name}, {len(values)} exposures: {latency_text}")
        record_property(name, latency_text)
    assert statistics.median(watched) <= max(alone)


async def watch(port: int) -> None:
    """Forty follow to the last exposure, ten take nothing until they are let go."""
    release = asyncio.Event()
    stalled = [asyncio.create_task(stall(port, release)) for _ in range(STALLED)]
    following = [follow(port, EXPOSURES) for _ in range(WATCHERS - STALLED)]
    await asyncio.gather(*following)
    release.set()
    await asyncio.gather(*stalled)


def stored_s(service: Running, numbers: Sequence[int]) -> list[float]:
    """From trigger to stored, seconds."""
    at_ns = {
        (event["event"], event["number"]): int(event["mono_ns"])
        for event in service.events
        if event["event"] in ("triggered", "stored")
    }
    return [(at_ns["stored", n] - at_ns["triggered", n]) * 1e-9 for n in numbers]
