"""Interfaces of this computer with their IPv4 subnets and filters, as the kernel reports them."""

from __future__ import annotations

import fcntl
import ipaddress
import socket
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Final

SIOCGIFADDR: Final = 0x8915
SIOCGIFNETMASK: Final = 0x891B
REVERSE_PATH_FILTERS: Final = Path("/proc/sys/net/ipv4/conf")
STRICT: Final = 1


@dataclass(frozen=True)
class LocalInterface:
    """An interface and its first IPv4 address."""

    name: str
    address: ipaddress.IPv4Interface


def local_interfaces() -> list[LocalInterface]:
    """Every interface with an IPv4 address, without the loopback."""
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as channel:
        for _, name in socket.if_nameindex():
            try:
                address = _ask(channel, SIOCGIFADDR, name)
                mask = _ask(channel, SIOCGIFNETMASK, name)
            except OSError:
                continue
            interface = ipaddress.IPv4Interface(f"{address}/{mask}")
            if not interface.ip.is_loopback:
                found.append(LocalInterface(name, interface))
    return found


def shared_subnets(interfaces: Sequence[LocalInterface]) -> list[tuple[str, str, str]]:
    """Pairs of interfaces in one subnet, and that subnet."""
    return [
        (one.name, other.name, str(one.address.network))
        for one, other in combinations(interfaces, 2)
        if one.address.network.overlaps(other.address.network)
    ]


def has_strict_filter(interface: str) -> bool:
    """Whether the kernel drops packets of an interface whose sender is reached by another one.

    The larger of the values for all interfaces and for this one holds.
    """
    values = []
    for name in ("all", interface):
        try:
            text = (REVERSE_PATH_FILTERS / name / "rp_filter").read_text(encoding="ascii")
            values.append(int(text))
        except (OSError, ValueError):
            continue
    return max(values, default=0) == STRICT


def _ask(channel: socket.socket, request: int, name: str) -> str:
    reply = fcntl.ioctl(channel.fileno(), request, struct.pack("256s", name.encode()[:15]))
    return socket.inet_ntoa(reply[20:24])
