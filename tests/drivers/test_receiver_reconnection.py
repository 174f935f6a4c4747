"""Pulled cables and power loss are detected in time, reported, and recovered automatically.

All kinds at once, each with its driver on an emulated receiver; the others are not disturbed.
"""

from __future__ import annotations

import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from drivers.base import registry
from drivers.contract import EventMark, NavSample
from sim_hw.devices.network_line import UdpLine
from sim_hw.devices.pseudo_terminal import PseudoTerminal
from sim_hw.receivers.emulated_receiver import EmulatedReceiver
from sim_hw.receivers.mavlink_autopilot import MavlinkAutopilot
from sim_hw.receivers.nmea_receiver import NmeaReceiver
from sim_hw.receivers.novatel_receiver import NovatelReceiver
from sim_hw.receivers.septentrio_receiver import SeptentrioReceiver
from sim_hw.receivers.ublox_receiver import UbloxReceiver
from sim_hw.world.world_clock import WorldClock
from tests.drivers.fakes import RecordingSink
from tests.sim_hw.receiver_state import state_at

pytestmark = pytest.mark.realtime


WITHIN_S = 40.0
SILENCE_S = 1.0
KINDS: dict[str, type[EmulatedReceiver]] = {
    "ublox": UbloxReceiver,
    "novatel": NovatelReceiver,
    "septentrio": SeptentrioReceiver,
    "nmea": NmeaReceiver,
}


@dataclass
class Pair:
    """A receiver, its cable, its driver, and what the driver reported."""

    kind: str
    receiver: Any
    cable: PseudoTerminal | None
    navigator: Any
    recorder: RecordingSink

    def samples(self) -> int:
        return sum(isinstance(record, NavSample) for record in self.recorder.records)


def wait_for(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + WITHIN_S
    while not condition():
        assert time.monotonic() < deadline, f"waited {WITHIN_S:g} s for {what}"
        time.sleep(0.02)


@contextmanager
def running(pairs: list[Pair]) -> Iterator[None]:
    threads = [
        threading.Thread(target=pair.navigator.run, args=(pair.recorder,), daemon=True)
        for pair in pairs
    ]
    for pair, thread in zip(pairs, threads, strict=True):
        pair.receiver.start()
        thread.start()
    try:
        yield
    finally:
        for pair, thread in zip(pairs, threads, strict=True):
            pair.navigator.close()
            thread.join(5)
            pair.receiver.close()
    assert not any(thread.is_alive() for thread in threads)


def held() -> Counter[str]:
    """What is open and running, by what it refers to; what earlier tests left may end meanwhile."""
    found = Counter(f"thread {thread.ident}" for thread in threading.enumerate())
    for descriptor in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):  # the listing's own
            found[str(descriptor.readlink())] += 1
    return found


def on_cables(folder: Path) -> list[Pair]:
    clock = WorldClock.from_wall_clock()
    pairs = []
    for kind, receiver_type in KINDS.items():
        cable = PseudoTerminal(folder / kind)
        receiver = receiver_type(clock, state_at, rate_hz=10.0, line=cable)
        settings = {"port": receiver.port, "silence_s": SILENCE_S}
        navigator = registry.driver_for("navigator", kind)("gnss", settings)
        pairs.append(Pair(kind, receiver, cable, navigator, RecordingSink()))
    return pairs


def test_a_pulled_cable_is_reported_and_healed_for_every_kind(tmp_path: Path) -> None:
    before_it = held()
    pairs = on_cables(tmp_path)
    with running(pairs):
        for pair in pairs:
            wait_for(lambda pair=pair: pair.samples() >= 3, f"{pair.kind} to begin")
        for pair in pairs[:-1]:
            assert pair.cable is not None
            pair.cable.unplug()
        for pair in pairs[:-1]:
            wait_for(lambda pair=pair: "lost" in pair.recorder.event_names, f"{pair.kind} lost")
        before = [pair.samples() for pair in pairs]
        for pair in pairs[:-1]:
            assert pair.cable is not None
            pair.cable.plug_in()
        for pair, had in zip(pairs, before, strict=True):
            wait_for(lambda pair=pair, had=had: pair.samples() >= had + 3, f"{pair.kind} back")
    for pair in pairs[:-1]:
        assert pair.recorder.event_names[:3] == ["opened", "lost", "opened"]
        lost = next(e for e in pair.recorder.events if e.name == "lost")
        assert lost.is_fault and "automatically" in lost.sentence
    assert pairs[-1].recorder.event_names == ["opened"], "the one nobody touched"
    assert held() - before_it == Counter(), "nothing leaks"


def test_an_autopilot_that_falls_silent_and_restarts_is_received_again_at_the_right_time() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        here = probe.getsockname()
    clock = WorldClock.from_wall_clock()
    autopilot = MavlinkAutopilot(clock, state_at, line=UdpLine(here))
    navigator = registry.driver_for("navigator", "mavlink")(
        "fc", {"port": autopilot.port, "silence_s": SILENCE_S}
    )
    pair = Pair("mavlink", autopilot, None, navigator, RecordingSink())
    silent = threading.Event()
    autopilot.byte_filter = lambda data, _mono_ns: b"" if silent.is_set() else data
    with running([pair]):
        wait_for(lambda: pair.samples() >= 3, "the autopilot to begin")
        silent.set()
        autopilot.restart()
        wait_for(lambda: "silent" in pair.recorder.event_names, "its silence to be reported")
        silent.clear()
        wait_for(lambda: "recovered" in pair.recorder.event_names, "it to be received again")
        had = pair.samples()
        wait_for(lambda: pair.samples() >= had + 12, "its navigation")
        autopilot.mark(given_ns := clock.gps_ns(time.monotonic_ns()) + 50_000_000)
        wait_for(lambda: any(isinstance(r, EventMark) for r in pair.recorder.records), "its mark")
    mark = next(r for r in pair.recorder.records if isinstance(r, EventMark))
    assert mark.time_valid
    assert abs(mark.gps_ns - given_ns) < 1_500_000
    assert navigator.statistics()["clock_steps"] == 1
