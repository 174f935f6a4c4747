"""A small flight whose processes are threads: `check` and `run` over the same planted faults."""

from __future__ import annotations

import asyncio
import importlib
import multiprocessing
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from daemon import DaemonError
from daemon.cli.check import collect_results
from daemon.configuration.model import ConfigurationError
from daemon.mission.store.level0 import tiff_parts
from daemon.onboard.pipeline import worker
from daemon.onboard.preflight import prerequisites, system_check
from daemon.onboard.preflight.check_results import CheckOutcome, CheckResult, worst_outcome
from daemon.onboard.preflight.service_file import load
from daemon.onboard.service import supervisor
from daemon.onboard.service.processes import ServiceConnection, ServiceDisconnectedError
from daemon.onboard.service.service import Service
from daemon.products.processor import Processor
from sim_hw.devices.modbus_probe import ModbusProbe
from sim_hw.devices.pseudo_terminal import PseudoTerminal
from sim_hw.devices.pulse_bus import PulseBus
from sim_hw.receivers.emulated_receiver import ReceiverState
from sim_hw.receivers.ublox_receiver import UbloxReceiver
from sim_hw.world.world_clock import WorldClock

WIDTH_PX, HEIGHT_PX = 64, 48
AGREED_WITHIN_S = 30.0
"""A busy machine may take as long; a quiet one a second."""
RIG = """\
format = 1
name = "pair"
timing = "synchronous"
frame_interval_s = 0.2
master_cone = "A"
colour_master_cone = "A"
reference_cone = "A"

[calibration]
id = "pair-1"
date = "2026-11-01"
""" + "".join(
    f"""
[[cone]]
name = "{cone}"
role = "colour"
bands = ["{band}"]
position_mm = [0, 0, 0]
rotation_rad = [0, 0, 0]
probe = ""
calibration_c = 20.0

[cone.lens]
f_mm = 100.0

[[cone.sensor]]
name = "SU{cone}"
serial = "SN-{cone}"
width_px = {WIDTH_PX}
height_px = {HEIGHT_PX}
pitch_um = 7.2
x_mm = 0.0
y_mm = 0.0
bits = 12
"""
    for cone, band in (("A", "red"), ("B", "nir"))
)
SERVICE = """\
[mission]
root = "missions"
rig = "rig.toml"
simulated = true

[trigger]
driver = "software"
interval_s = 0.2
count = 3

[processing]
threads = 1
parallel_exposures = 1

[limits]
ready_timeout_s = 1.0
frame_timeout_s = 1.0
mark_timeout_s = 0.5
disk_reserve_bytes = 0
disk_warn_exposures = 0

[[head]]
sensor = "SUA"
driver = "folder"
folder = "frames"
loop = true

[[head]]
sensor = "SUB"
driver = "folder"
folder = "frames"
loop = true
"""


@dataclass
class Planted:
    """The folder of a flight, what was planted in it, and what has to be closed after it."""

    folder: Path
    monkeypatch: pytest.MonkeyPatch
    service: str = SERVICE
    rig: str = RIG
    closing: list[Callable[[], None]] = field(default_factory=list)

    @property
    def config(self) -> Path:
        return self.folder / "service.toml"

    def change(self, old: str, new: str) -> None:
        """In service.toml, or else in rig.toml."""
        assert (old in self.service) != (old in self.rig), f"{old!r} has to be in one of them"
        self.service = self.service.replace(old, new)
        self.rig = self.rig.replace(old, new)

    def add(self, text: str) -> None:
        self.service += f"\n{text}\n"

    def write(self) -> None:
        service = self.service.replace('"frames"', f'"{self.folder / "frames"}"')
        self.config.write_text(service)
        (self.folder / "rig.toml").write_text(self.rig)

    def frames(self, cone: str, **known: object) -> None:
        """The frames of a head."""
        reported = {"syntopic": 1, "head_serial": f"SN-{cone}", "pixel_format": "Mono12", **known}
        # Any value of a frame by name.
        height, width = known.get("shape", (HEIGHT_PX, WIDTH_PX))  # type: ignore[misc]
        path = self.folder / "frames" / "000001" / f"SU{cone}.tif"
        path.parent.mkdir(parents=True, exist_ok=True)
        about = {key: value for key, value in reported.items() if key != "shape"}
        pixels = np.full((height, width), 1000, np.uint16)
        path.write_bytes(b"".join(bytes(part) for part in tiff_parts([pixels], about)))

    # Emulated devices

    def receiver(self) -> PseudoTerminal:
        line = PseudoTerminal()
        receiver = UbloxReceiver(WorldClock.from_wall_clock(), _state, line=line)
        self._start(receiver)
        self.add(f'[[navigator]]\nname = "gnss"\ndriver = "ublox"\nport = "{line.port}"')
        return line

    def line(self, data: Callable[[int], bytes], *, every_s: float = 0.1) -> str:
        """A serial line on which somebody repeats bytes; its port."""
        line, event = PseudoTerminal(), threading.Event()

        def speak() -> None:
            count = 0
            while not event.wait(every_s):
                line.write(data(count))
                count += 1

        thread = threading.Thread(target=speak, daemon=True)
        thread.start()

        def close() -> None:
            event.set()
            thread.join()
            line.close()

        self.closing.append(close)
        return line.port

    def thermometer(self, *values_c: float | None, settings: str = "") -> None:
        """A module with a probe for each cone, and a rig that has probes A and B."""
        line = PseudoTerminal()
        self._start(ModbusProbe([lambda v=v: v for v in values_c], line=line))
        names = ", ".join(f'"{name}"' for name in "AB"[: len(values_c)])
        self.probes()
        self.add(
            f'[[thermometer]]\nname = "probes"\ndriver = "modbus-rtu"\nport = "{line.port}"\n'
            f'parity = "N"\nchannels = [{names}]\ninterval_s = 0.1\n{settings}'
        )

    def probes(self) -> None:
        """Let each cone of the rig have a probe of its name."""
        for cone in "AB":
            head, tail = self.rig.split(f'name = "{cone}"\n', 1)
            self.rig = f'{head}name = "{cone}"\n' + tail.replace(
                'probe = ""', f'probe = "{cone}"', 1
            )

    def trigger_unit(self, *outputs: str) -> None:
        """A pulse bus, and heads that wait for their line."""
        unit = PulseBus("unit", outputs, lambda _: None)
        self._start(unit)
        self.by_line(unit.address[1])

    def by_line(self, port: int) -> None:
        self.change('driver = "software"', f'driver = "pulse-bus"\nport = {port}\ntimeout_s = 0.2')
        self.change("loop = true", 'loop = true\ntrigger_source = "line"\ninterval_s = 0.2')

    def _start(self, device: Any) -> None:
        device.start()
        self.closing.append(device.close)


def _state(_gps_ns: int) -> ReceiverState:
    return ReceiverState(48.0, 11.0, 1500.0, (60.0, 0.0, 0.0), 0.0, 0.0, 0.0)


class ThreadChild:
    """Replaces `daemon.onboard.service.processes.ChildProcess`: the same target, in a thread."""

    pause_s = 0.0

    def __init__(
        self, name: str, target: str, arguments: tuple[Any, ...], _environment: Mapping[str, str]
    ) -> None:
        self.name = name
        self.connection, theirs = multiprocessing.Pipe(duplex=True)
        module, _, function = target.partition(":")
        main = getattr(importlib.import_module(module), function)

        def run() -> None:
            try:
                with suppress(ServiceDisconnectedError):
                    main(ServiceConnection(theirs), *arguments)
            finally:
                theirs.close()

        self.thread = threading.Thread(target=run, name=name, daemon=True)
        self.thread.start()

    def receive(self) -> Iterator[object]:
        while self.connection.poll():
            yield self.connection.recv()

    def send(self, message: object) -> None:
        self.connection.send(message)

    def try_send(self, message: object) -> bool:
        self.connection.send(message)
        return True

    def end(self, timeout_s: float) -> None:
        self.thread.join(timeout_s)
        self.connection.close()


@dataclass
class Reported:
    """Output of one of the two commands: its exit status and every sentence."""

    status: int
    failing: frozenset[str] = frozenset()
    waiting: frozenset[str] = frozenset()
    has_flown: bool = False
    devices: frozenset[str] = frozenset()
    """What the faults are of."""
    events: tuple[str, ...] = field(default=(), compare=False)


def in_threads(planted: Planted) -> None:
    """Let `check` and `run` start threads in the place of processes, and make no images."""
    patch = planted.monkeypatch.setattr
    patch(supervisor, "_child_process", ThreadChild)
    patch(Processor, "warm_up", lambda _processor: None)
    patch(numba, "threading_layer", lambda: "omp")
    patch(worker, "configure_threads", lambda: None)
    patch(worker, "make_products", _no_products)
    patch(prerequisites, "PACE_NBYTES_MIN", 4_000_000)
    patch(system_check, "DATA_TIMEOUT_S", 2.5)
    patch(supervisor, "END_TIMEOUT_S", 1.0)
    patch(system_check, "BIND_TIMEOUT_S", 8.0)
    patch(system_check, "KERNELS_TIMEOUT_S", 8.0)


def check(planted: Planted, *, fire: bool = False) -> Reported:
    """What `syntopic check` finds."""
    try:
        configuration, rig = load(planted.config)
        found = collect_results(configuration, rig, planted.config, fire=fire)
    except ConfigurationError as error:
        return Reported(2, frozenset(error.problems))
    except DaemonError as error:
        return Reported(1, frozenset({str(error)}))
    status = {CheckOutcome.PASS: 0, CheckOutcome.FAIL: 1, CheckOutcome.WAITING: 3}[
        worst_outcome(found)
    ]
    failing = frozenset(one.name for one in found if one.outcome is CheckOutcome.FAIL)
    sentences = _of(found, CheckOutcome.FAIL), _of(found, CheckOutcome.WAITING)
    return Reported(status, *sentences, devices=failing)


def run(planted: Planted, agreed: Callable[[Reported], bool]) -> Reported:
    """Output of `syntopic run` until it ends, or until the awaited output."""
    try:
        configuration, rig = load(planted.config)
    except ConfigurationError as error:
        return Reported(2, frozenset(error.problems))
    events: list[Mapping[str, Any]] = []
    service = Service(configuration, rig, planted.config, events.append)

    def so_far(status: int) -> Reported:
        faults = [event for event in events if event.get("fault") or event["event"] == "fault"]
        faults += [event for event in events if event.get("differences")]
        names = {event["event"] for event in events}
        missing_prerequisites = (
            service.preflight.missing_prerequisites() if "mission" in names else ()
        )
        accepted = [event["sentence"] for event in events if event["event"] == "override"]
        return Reported(
            status,
            frozenset(str(event["sentence"]) for event in faults),
            frozenset([*map(str, missing_prerequisites), *accepted]),
            # A frame that is faster than the answer of its trigger belongs to nothing, and came.
            bool(names & {"stored", "frame"}),
            frozenset(str(event.get("device", "service")) for event in faults),
            tuple(f"{event['event']} {event.get('name', '')}" for event in events),
        )

    async def fly() -> int:
        flying = asyncio.create_task(service.run())
        deadline = time.monotonic() + AGREED_WITHIN_S
        while not flying.done() and time.monotonic() < deadline and not agreed(so_far(0)):
            await asyncio.wait({flying}, timeout=0.05)
        service.stopping.set()
        return await flying

    try:
        return so_far(asyncio.run(fly()))
    except DaemonError as error:
        return Reported(1, frozenset({str(error)}))


def _of(found: list[CheckResult], outcome: CheckOutcome) -> frozenset[str]:
    return frozenset(one.sentence for one in found if one.outcome is outcome)


def _no_products(*_: Any, **__: Any) -> Any:
    raise ValueError("no images are made here")
