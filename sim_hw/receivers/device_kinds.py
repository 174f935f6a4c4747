"""The receivers and probes of an emulated rig, by kind, and the line of each.

The messages of each kind are in its own file.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sim_hw.devices.ascii_probe import AsciiProbe
from sim_hw.devices.device_loop import LineDevice
from sim_hw.devices.modbus_probe import ModbusProbe
from sim_hw.devices.network_line import UdpLine
from sim_hw.devices.pseudo_terminal import PseudoTerminal
from sim_hw.receivers.applanix_receiver import ApplanixReceiver
from sim_hw.receivers.emulated_receiver import EmulatedReceiver, ReceiverState
from sim_hw.receivers.gsof_receiver import GsofReceiver
from sim_hw.receivers.mavlink_autopilot import MavlinkAutopilot
from sim_hw.receivers.nmea_receiver import NmeaReceiver
from sim_hw.receivers.novatel_receiver import NovatelReceiver
from sim_hw.receivers.sbg_receiver import SbgReceiver
from sim_hw.receivers.septentrio_receiver import SeptentrioReceiver
from sim_hw.receivers.ublox_receiver import UbloxReceiver
from sim_hw.receivers.vectornav_receiver import VectornavReceiver
from sim_hw.receivers.xsens_receiver import XsensReceiver
from sim_hw.world.world_clock import WorldClock

BAUDRATE = 115_200
PROBE_BAUDRATES = {"modbus": 19_200, "ascii": 9_600}
PROBE_UNIT = 1
PROBE_FIRST_REGISTER = 0
_ON_A_SERIAL_LINE: dict[str, type[EmulatedReceiver]] = {
    "ublox": UbloxReceiver,
    "novatel": NovatelReceiver,
    "septentrio": SeptentrioReceiver,
    "sbg": SbgReceiver,
    "vectornav": VectornavReceiver,
    "xsens": XsensReceiver,
    "applanix": ApplanixReceiver,
    "gsof": GsofReceiver,
    "nmea": NmeaReceiver,
}
RECEIVERS = (*_ON_A_SERIAL_LINE, "mavlink")
PROBES = tuple(PROBE_BAUDRATES)

Reading = Callable[[], float | None]


@dataclass(frozen=True)
class EmulatedDevice:
    """A device, its cable where it has one to pull, and the settings a driver needs for it."""

    device: Any
    cable: PseudoTerminal | None
    settings: dict[str, Any]


def receiver(
    kind: str, clock: WorldClock, state: Callable[[int], ReceiverState], port: Path
) -> EmulatedDevice:
    """A receiver of one of `RECEIVERS`; on a pseudo-terminal at `port`, the autopilot on UDP."""
    if kind == "mavlink":
        autopilot = MavlinkAutopilot(clock, state, line=UdpLine(("127.0.0.1", _free_udp_port())))
        return EmulatedDevice(autopilot, None, {"port": autopilot.port})
    line = PseudoTerminal(port)
    device = _ON_A_SERIAL_LINE[kind](clock, state, line=line)
    return EmulatedDevice(device, line, {"port": device.port, "baudrate": BAUDRATE})


def probes(kind: str, channels: dict[str, Reading], port: Path) -> EmulatedDevice:
    """An instrument of one of `PROBES` on a pseudo-terminal, with a channel for every name."""
    line = PseudoTerminal(port)
    settings: dict[str, Any] = {
        "port": line.port,
        "baudrate": PROBE_BAUDRATES[kind],
        "channels": list(channels),
    }
    device: LineDevice
    if kind == "modbus":
        device = ModbusProbe(
            list(channels.values()),
            unit=PROBE_UNIT,
            first_register=PROBE_FIRST_REGISTER,
            line=line,
        )
        settings |= {"unit": PROBE_UNIT, "first_register": PROBE_FIRST_REGISTER}
    else:
        device = AsciiProbe(list(channels.values()), [_line_of(channels)], line=line)
        settings |= {"pattern": _pattern_of(channels)}
    return EmulatedDevice(device, line, settings)


def _line_of(names: Sequence[str] | dict[str, Reading]) -> str:
    return " ".join(f"T{n}={{{n}}}" for n in range(len(names)))


def _pattern_of(names: Sequence[str] | dict[str, Reading]) -> str:
    return "^" + " ".join(rf"T{n}=(?P<t{n}>\S+)" for n in range(len(names))) + "$"


def _free_udp_port() -> int:
    """A port of this moment; the host that listens there comes later."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
