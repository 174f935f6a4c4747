"""What is announced can be changed in flight: the phase is part of it."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
import zeroconf.asyncio

from daemon.configuration.model import WatchSection
from daemon.onboard.monitoring.client import mdns_announcer
from daemon.onboard.monitoring.flight_state import FlightState
from tests.daemon.onboard.monitoring import flight_events


class Recorder:
    """In place of the network."""

    reported: asyncio.Queue[Any]

    def __init__(self, **_how: Any) -> None:
        Recorder.reported = asyncio.Queue()

    async def async_register_service(self, info: Any, **_how: Any) -> None:
        await Recorder.reported.put(info)

    async_update_service = async_register_service

    async def async_unregister_all_services(self) -> None: ...
    async def async_close(self) -> None: ...


def test_a_new_phase_is_announced_under_the_same_name_and_host(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(zeroconf.asyncio, "AsyncZeroconf", Recorder)
    monkeypatch.setattr(mdns_announcer, "REFRESH_S", 0.01)
    state = FlightState("syntopic test")
    announcement = mdns_announcer.MdnsAnnouncer(state, WatchSection(), 8470)

    async def run() -> tuple[Any, Any]:
        await announcement.begin()
        first = await Recorder.reported.get()
        state.apply(flight_events.status("armed"))
        second = await Recorder.reported.get()
        await announcement.end()
        return first, second

    first, second = asyncio.run(asyncio.wait_for(run(), 30))
    assert (first.properties[b"phase"], second.properties[b"phase"]) == (b"idle", b"armed")
    assert first.name == second.name
    # Without one, zeroconf refuses the change and announces no more.
    assert first.server == second.server
    assert second.server.endswith(".local.")
