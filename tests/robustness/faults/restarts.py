"""Drivers and emulated devices, each device a process that is killed and started again.

What is stated of noticing and coming back is in `STATED`; what was seen comes out as figures.
"""

from __future__ import annotations

import json
import mmap
import random
import selectors
import signal
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drivers.base import registry
from drivers.contract import (
    CHUNK_ALLOWANCE_NBYTES,
    DeviceError,
    DeviceEvent,
    Frame,
    RawBytes,
    Record,
)
from sim_hw.processes.single_device import HEIGHT_PX, KINDS, WIDTH_PX

ROOT = Path(__file__).parents[3]
HEADS = ("head-1", "head-2")
ADDRESSES = {"head-1": "127.62.3.2", "head-2": "127.62.3.3"}
TRIGGER_AT = "127.62.3.9:4790"
EXPOSE_EVERY_S = 0.5
READY_WITHIN_S = 180.0


@dataclass(frozen=True)
class StatedTimes:
    """Within what a dead device is noticed, and back once it is there again, s."""

    detected_s: float
    back_s: float


SILENCE_S = 6.0
"""A machine that runs the tests in parallel with other programs may starve a device for seconds."""
SERIAL = StatedTimes(detected_s=SILENCE_S, back_s=5.0 + 3.0)
"""`silence_s` of the receivers; the longest back-off and a second of listening."""
HEAD = StatedTimes(detected_s=4.5, back_s=5.0 + 2.5 + 3.0)
"""Two seconds of grace plus a check every two; the longest back-off, and opening."""
TRIGGER = StatedTimes(detected_s=EXPOSE_EVERY_S + 0.5, back_s=EXPOSE_EVERY_S + 1.0)
"""It is asked twice a second here and answers within half of one."""


@dataclass
class Device:
    """An emulated device, its process, its driver and what came of it."""

    name: str
    kind: str
    at: str
    stated: StatedTimes
    driver: Any = None
    process: subprocess.Popen[str] | None = None
    thread: threading.Thread | None = None
    received_s: list[float] = field(default_factory=list)
    events: list[tuple[float, DeviceEvent]] = field(default_factory=list)
    down: list[tuple[float, float]] = field(default_factory=list)
    """When it was killed, and when it reported again that it is ready."""

    def sink(self, record: Record) -> None:
        now_s = time.monotonic()
        if isinstance(record, DeviceEvent):
            self.events.append((now_s, record))
        elif not isinstance(record, RawBytes):
            self.received_s.append(now_s)
        if isinstance(record, Frame):
            self.driver.recycle(record.slot)


class _Memory:
    """Slots in an anonymous mapping."""

    slot_count = 3
    slot_nbytes = WIDTH_PX * HEIGHT_PX * 2 + CHUNK_ALLOWANCE_NBYTES

    def __init__(self) -> None:
        mapping = mmap.mmap(-1, self.slot_count * self.slot_nbytes)
        self._slots = np.frombuffer(mapping, np.uint8).reshape(self.slot_count, self.slot_nbytes)

    def address(self, slot: int) -> int:
        return int(self._slots[slot].ctypes.data)


class _PolledDevice:
    """The trigger unit's client in a thread that fires twice a second."""

    def __init__(self, device: Device) -> None:
        host, _, port = device.at.rpartition(":")
        started_devices = registry.driver_for("trigger", "pulse-bus")
        self._client: Any = started_devices(device.name, {"host": host, "port": int(port)})
        self._device = device
        self._closing = threading.Event()

    def run(self, _sink: object) -> None:
        sequence = 0
        was_working = True
        while not self._closing.wait(EXPOSE_EVERY_S):
            sequence += 1
            try:
                self._client.fire(sequence)
            except DeviceError as error:
                if was_working:
                    self._put_event("lost", str(error), is_fault=True)
                was_working = False
            else:
                if not was_working:
                    self._put_event("opened", "", is_fault=False)
                was_working = True
                self._device.received_s.append(time.monotonic())

    def close(self) -> None:
        self._closing.set()
        self._client.close()

    def _put_event(self, name: str, sentence: str, *, is_fault: bool) -> None:
        event = DeviceEvent(self._device.name, name, is_fault, sentence, time.monotonic_ns())
        self._device.sink(event)


def devices(folder: Path, kinds: Iterator[str] | None = None) -> list[Device]:
    """One of each kind, and a second head."""
    chosen = list(kinds or KINDS)
    started_devices = []
    for kind in chosen:
        if kind == "head":
            started_devices += [Device(name, "head", ADDRESSES[name], HEAD) for name in HEADS]
        elif kind == "trigger":
            started_devices.append(Device("trigger", "trigger", TRIGGER_AT, TRIGGER))
        else:
            started_devices.append(Device(kind, kind, str(folder / kind), SERIAL))
    return started_devices


def driver_of(device: Device) -> Any:
    """The driver that flies, on this device."""
    port: dict[str, object] = {"port": device.at, "silence_s": SILENCE_S}
    sections: Mapping[str, tuple[str, str, dict[str, object]]] = {
        "modbus": (
            "thermometer",
            "modbus-rtu",
            {**port, "parity": "N", "channels": ["a", "b"], "interval_s": 0.5},
        ),
        "ascii": (
            "thermometer",
            "ascii-line",
            {
                **port,
                "pattern": r"(?P<channel>CH\d) = (?P<value>\S+)",
                "channels": ["a", "b"],
                "channel_labels": ["CH1", "CH2"],
            },
        ),
        "head": (
            "head",
            "aravis",
            {"address": device.at, "trigger_source": "software", "exposure_time_us": 500.0},
        ),
    }
    if device.kind == "trigger":
        return _PolledDevice(device)
    kind, name, settings = sections.get(device.kind, ("navigator", device.kind, port))
    started_devices: Any = registry.driver_for(kind, name)
    if kind == "head":
        return started_devices(device.name, settings, memory=_Memory())
    return started_devices(device.name, settings)


SPAWNER = ThreadPoolExecutor(1, thread_name_prefix="nursery")
"""A device dies with the thread that started it: one thread that stays starts them all."""


def _popen(device: Device) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "sim_hw.processes.single_device", device.kind, "--at", device.at],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
    )


def start_process(device: Device) -> None:
    """Start the device and wait until it reports that it is ready."""
    process = SPAWNER.submit(_popen, device).result(READY_WITHIN_S)
    assert process.stdout is not None
    device.process = process
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        assert selector.select(READY_WITHIN_S), f"{device.name} did not start"
    assert json.loads(process.stdout.readline())["event"] == "ready"


def kill_process(device: Device) -> float:
    """Kill it; the moment before, on the monotonic clock in s."""
    assert device.process is not None
    killed_s = time.monotonic()
    device.process.send_signal(signal.SIGKILL)
    device.process.wait(10)
    if device.process.stdout is not None:
        device.process.stdout.close()
    device.process = None
    if device.kind not in ("head", "trigger"):
        # The name of a port goes with the port; the kernel may give its number to another device.
        Path(device.at).unlink(missing_ok=True)
    return killed_s


@contextmanager
def running(folder: Path) -> Iterator[list[Device]]:
    """All devices and their drivers."""
    started_devices = devices(folder)
    stop = threading.Event()
    exposing = threading.Thread(target=_expose, args=(started_devices, stop))
    try:
        for device in started_devices:
            start_process(device)
        for device in started_devices:
            device.driver = driver_of(device)
            device.thread = threading.Thread(
                target=device.driver.run, args=(device.sink,), name=device.name
            )
            device.thread.start()
        exposing.start()
        yield started_devices
    finally:
        stop.set()
        for device in started_devices:
            if device.driver is not None:
                device.driver.close()
        for device in started_devices:
            if device.thread is not None:
                device.thread.join(20)
            if device.process is not None:
                kill_process(device)
        if exposing.ident is not None:
            exposing.join(20)


def _expose(started_devices: list[Device], stop: threading.Event) -> None:
    heads = [device for device in started_devices if device.kind == "head"]
    while not stop.wait(EXPOSE_EVERY_S):
        for head in heads:
            # A head that is lost cannot be triggered; its driver reports the loss.
            with suppress(DeviceError):
                head.driver.trigger()


def wait_until_all_speak(started_devices: list[Device], within_s: float) -> float:
    """Wait until every device was received from now on; returns the time that took."""
    began_s = time.monotonic()
    waiting = list(started_devices)
    while waiting:
        waiting = [d for d in waiting if not d.received_s or d.received_s[-1] < began_s]
        assert time.monotonic() - began_s < within_s, f"silent: {[d.name for d in waiting]}"
        time.sleep(0.05)
    return time.monotonic() - began_s


def descriptors() -> int:
    """How many this process has open."""
    return len(list(Path("/proc/self/fd").iterdir()))


def kill_at_random(started_devices: list[Device], lasts_s: float, seed: int) -> int:
    """Kill and restart devices at random, each on its own; how often."""
    stop = threading.Event()
    mortals = [
        threading.Thread(target=_kill_repeatedly, args=(d, stop, random.Random(f"{seed}-{d.name}")))
        for d in started_devices
    ]
    for mortal in mortals:
        mortal.start()
    stop.wait(lasts_s)
    stop.set()
    for mortal in mortals:
        mortal.join(2 * READY_WITHIN_S)
        assert not mortal.is_alive()
    return sum(len(device.down) for device in started_devices)


def _kill_repeatedly(device: Device, stop: threading.Event, rng: random.Random) -> None:
    run_s = rng.uniform(1.0, 10.0)
    while not stop.wait(run_s):
        killed_s = kill_process(device)
        device.down.append((killed_s, float("inf")))
        stop.wait(rng.uniform(0.2, 9.0))
        start_process(device)
        device.down[-1] = (killed_s, time.monotonic())
        run_s = rng.uniform(15.0, 45.0)


@dataclass
class Figures:
    """What was seen of one device."""

    kills: int
    detected_s: list[float]
    unnoticed: int
    """Restarted before there was anything to notice: it spoke again without having been lost."""
    back_s: list[float]
    disturbances: list[str]

    def row(self, device: Device) -> str:
        """A row of the table in docs/reference/results/faults.md."""
        cells = [
            device.name,
            str(self.kills),
            _spread(self.detected_s),
            f"{device.stated.detected_s:g}",
            _spread(self.back_s),
            f"{device.stated.back_s:g}",
            str(len(self.disturbances)),
        ]
        return "| " + " | ".join(cells) + " |"


def _spread(values_s: list[float]) -> str:
    if not values_s:
        return "-"
    return f"{statistics.median(values_s):.1f}, {max(values_s):.1f}"


def figures(device: Device) -> Figures:
    """What its driver reported and delivered around every kill."""
    found = Figures(len(device.down), [], 0, [], [])
    excused: list[tuple[float, float]] = []
    for killed_s, ready_s in device.down:
        received_s = next((s for s in device.received_s if s > ready_s), float("inf"))
        found.back_s.append(received_s - ready_s)
        reported_s = next(
            (s for s, event in device.events if event.is_fault and killed_s <= s <= received_s),
            None,
        )
        if reported_s is None:
            found.unnoticed += 1
        else:
            found.detected_s.append(reported_s - killed_s)
        excused.append((killed_s, max(received_s, ready_s) + device.stated.detected_s))
    for at_s, event in device.events:
        if event.is_fault and not any(begin <= at_s <= end for begin, end in excused):
            found.disturbances.append(f"{event.name}: {event.sentence}")
    return found
