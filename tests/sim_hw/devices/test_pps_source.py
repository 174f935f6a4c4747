"""The emulated pulse per second, through the driver: whole seconds of GPS time, and silence."""

from __future__ import annotations

import threading

import pytest

from drivers.contract import DeviceEvent, PpsEdge
from drivers.triggers.pps.device import PpsDevice
from sim_hw.devices.pps_source import PpsSource
from sim_hw.world.world_clock import NS_PER_S, WorldClock

pytestmark = pytest.mark.realtime


def test_edges_are_full_seconds_of_gps_time_and_a_pulled_cable_is_reported() -> None:
    clock = WorldClock.from_wall_clock()
    source = PpsSource(clock, seed=3)
    source.start()
    pps = PpsDevice("pps", {"device": source.device, "silence_s": 1.5})
    edges: list[PpsEdge] = []
    events: list[str] = []
    enough, silent, back = threading.Event(), threading.Event(), threading.Event()

    def sink(record: object) -> None:
        if isinstance(record, PpsEdge):
            edges.append(record)
            if len(edges) == 3:
                enough.set()
            if silent.is_set():
                back.set()
        elif isinstance(record, DeviceEvent):
            events.append(record.name)
            if record.name == "silent":
                silent.set()

    assert pps.bind()["edge"] == "assert"
    thread = threading.Thread(target=pps.run, args=(sink,))
    thread.start()
    try:
        assert enough.wait(30)
        source.suspend()
        assert silent.wait(30)
        source.resume()
        assert back.wait(30)
    finally:
        pps.close()
        thread.join(20)
        source.close()
    assert events[0] == "opened" and "recovered" in events
    for edge in edges:
        gps_ns = clock.gps_ns(edge.mono_ns)
        late_ns = (gps_ns + NS_PER_S // 2) % NS_PER_S - NS_PER_S // 2
        assert -100_000 < late_ns < 2_000_000, "late by its latency, and by reading two clocks"
