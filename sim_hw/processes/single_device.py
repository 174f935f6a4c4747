"""One emulated device in its own process: `python -m sim_hw.processes.single_device KIND`.

For trying a driver, or a fault, without a rig. It moves straight north, is strobed once a second
(unless `--no-strobe`), prints "ready" as a JSON line, and ends with a signal or with its parent.
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from sim_hw.devices.device_loop import LineDevice
from sim_hw.devices.pseudo_terminal import PseudoTerminal
from sim_hw.faults.catalogue import HEAD, RECEIVER, THERMOMETER, TRIGGER, DeviceKind
from sim_hw.faults.channel import BytesDamage, Channel
from sim_hw.faults.faulty_line import FaultyWire, FaultyWorldClock
from sim_hw.faults.plan import FaultPlanError, PlannedFault, read_plan
from sim_hw.processes.parent_death import terminate_with_parent
from sim_hw.receivers.emulated_receiver import ReceiverState
from sim_hw.world.world_clock import NS_PER_S, WorldClock

SPEED_MPS = 60.0
METRES_PER_DEGREE = 111_200.0
FIRST_LATITUDE_DEG = 48.0
WIDTH_PX, HEIGHT_PX = 128, 96
STROBE_EVERY_S = 1.0
OUTPUTS = ("0", "1")

RECEIVERS: Mapping[str, tuple[str, str]] = {
    "ublox": ("ublox_receiver", "UbloxReceiver"),
    "nmea": ("nmea_receiver", "NmeaReceiver"),
    "novatel": ("novatel_receiver", "NovatelReceiver"),
    "septentrio": ("septentrio_receiver", "SeptentrioReceiver"),
    "sbg": ("sbg_receiver", "SbgReceiver"),
    "vectornav": ("vectornav_receiver", "VectornavReceiver"),
    "xsens": ("xsens_receiver", "XsensReceiver"),
    "applanix": ("applanix_receiver", "ApplanixReceiver"),
    "gsof": ("gsof_receiver", "GsofReceiver"),
    "mavlink": ("mavlink_autopilot", "MavlinkAutopilot"),
}
"""Module in `sim_hw.receivers` and class, by kind."""

KINDS: Mapping[str, DeviceKind] = {
    **dict.fromkeys(RECEIVERS, RECEIVER),
    "modbus": THERMOMETER,
    "ascii": THERMOMETER,
    "head": HEAD,
    "trigger": TRIGGER,
}


class _StartableDevice(Protocol):
    def start(self) -> None: ...

    def close(self) -> None: ...


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m sim_hw.processes.single_device", description=__doc__
    )
    add = parser.add_argument
    add("kind", choices=tuple(KINDS))
    add(
        "--at",
        required=True,
        help="where it is found: a name for its serial port, the address of a head, HOST:PORT of a "
        "trigger unit",
    )
    add("--no-strobe", action="store_true", help="no strobe, as without a trigger cable")
    add("--fault", action="append", default=[], metavar="NAME@TIME[,DURATION]")
    add("--scenario", type=Path, help="a file with faults")
    given = parser.parse_args(arguments)
    try:
        planned = read_plan(given.fault, given.scenario, {given.kind: KINDS[given.kind]})
    except FaultPlanError as error:
        for problem in error.problems:
            print(f"sim_hw.processes.single_device: {problem}", file=sys.stderr)
        return 2
    stopping = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopping.set())
    terminate_with_parent()
    world = WorldClock.from_wall_clock()
    device, begin, on_strobe = _create_device(given.kind, given.at, planned, world)
    try:
        device.start()
    except OSError as error:
        print(f"sim_hw.processes.single_device: {error}", file=sys.stderr)
        return 1
    begin(time.monotonic_ns())
    print(json.dumps({"event": "ready", "kind": given.kind, "at": given.at}), flush=True)
    while not stopping.wait(STROBE_EVERY_S):
        if not given.no_strobe:
            on_strobe()
    device.close()
    return 0


def _create_device(
    kind: str, at: str, planned: Sequence[PlannedFault], world: WorldClock
) -> tuple[_StartableDevice, Callable[[int], None], Callable[[], None]]:
    """The device, how its faults begin, and what a strobe does to it."""
    if kind == "head":
        return _head(at, planned)
    channel = Channel(planned, BytesDamage(), seed=kind)
    if kind == "trigger":
        from sim_hw.devices.pulse_bus import PulseBus

        host, _, port = at.rpartition(":")
        bus = PulseBus("single", OUTPUTS, lambda _: None, (host, int(port)), faults=channel)
        return bus, channel.begin, lambda: None
    line = PseudoTerminal(Path(at).absolute())
    emulated = _line_device(kind, line, channel, FaultyWorldClock(world, channel))
    emulated.byte_filter = FaultyWire(emulated, channel, line)
    mark = getattr(emulated, "mark", None)

    def on_strobe() -> None:
        if mark is not None:
            mark(FaultyWorldClock(world, channel).gps_ns(time.monotonic_ns()))

    return emulated, channel.begin, on_strobe


def _line_device(
    kind: str, line: PseudoTerminal, channel: Channel[bytes], clock: FaultyWorldClock
) -> LineDevice:
    def value_c() -> float | None:
        return None if channel.sensor_is_open(time.monotonic_ns()) else 21.5

    def state(own_gps_ns: int) -> ReceiverState:
        return _state(clock.world_gps_ns(own_gps_ns) - clock.gps_ns_at_start)

    if kind in RECEIVERS:
        # Imported one by one: a device comes up as fast as it can, and needs no other.
        module, name = RECEIVERS[kind]
        receiver: LineDevice = getattr(import_module(f"sim_hw.receivers.{module}"), name)(
            clock, state, line=line
        )
        return receiver
    if kind == "modbus":
        from sim_hw.devices.modbus_probe import ModbusProbe

        return ModbusProbe([value_c, value_c], line=line)
    from sim_hw.devices.ascii_probe import AsciiProbe

    lines = ["CH1 = {0}", "CH2 = {1}"]
    return AsciiProbe([value_c, value_c], lines, interval_s=0.5, line=line)


def _state(since_start_ns: int) -> ReceiverState:
    north_m = SPEED_MPS * since_start_ns / NS_PER_S
    return ReceiverState(
        latitude_deg=FIRST_LATITUDE_DEG + math.fmod(north_m / METRES_PER_DEGREE, 30.0),
        longitude_deg=11.0,
        height_m=1500.0,
        velocity_ned_mps=(SPEED_MPS, 0.0, 0.0),
        roll_deg=0.0,
        pitch_deg=0.0,
        heading_deg=0.0,
    )


def _head(
    address: str, planned: Sequence[PlannedFault]
) -> tuple[_StartableDevice, Callable[[int], None], Callable[[], None]]:
    import numpy as np
    from numpy.typing import NDArray

    from sim_hw.gige.gige_head import ExposureRequest, FrameSize, GigeHead, HeadIdentity, WireFaults
    from sim_hw.world.world_clock import FreeRunningClock

    def expose(request: ExposureRequest) -> NDArray[np.uint16]:
        pixels: NDArray[Any] = np.full((HEIGHT_PX, WIDTH_PX), request.counter % 4096, np.uint16)
        return pixels

    head = GigeHead(
        HeadIdentity(address, f"single-{address}", "single head", "Syntopic emulator", "single"),
        FrameSize(WIDTH_PX, HEIGHT_PX),
        expose,
        lambda _: 30.0,
        FreeRunningClock(),
        faults=WireFaults(planned=tuple(planned)),
    )
    return head, head.channel.begin, lambda: None


if __name__ == "__main__":
    sys.exit(main())
