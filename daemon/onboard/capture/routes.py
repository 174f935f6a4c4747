"""Heads with a network address, and the kernel's IPv4 routes to them."""

from __future__ import annotations

import ipaddress
import socket
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from daemon.configuration.model import Configuration

GATEWAY: Final = 0x0002


@dataclass(frozen=True)
class Route:
    """A line of the kernel's table for IPv4."""

    interface: str
    network: ipaddress.IPv4Network
    is_gateway: bool


def network_heads(configuration: Configuration) -> dict[str, ipaddress.IPv4Address]:
    """Address of each head that is configured by one, by sensor; without the loopback's."""
    return {
        head.sensor: address
        for head in configuration.head
        if (address := _ip_address(head.settings.get("address"))) and not address.is_loopback
    }


def parse_routes(text: str) -> list[Route]:
    """The routes in the text of /proc/net/route."""
    found = []
    for line in text.splitlines()[1:]:
        fields = line.split()
        if len(fields) >= 8:
            network = ipaddress.IPv4Network((_from_hex(fields[1]), _from_hex(fields[7])))
            found.append(Route(fields[0], network, bool(int(fields[3], 16) & GATEWAY)))
    return found


def route_to(address: ipaddress.IPv4Address, table: Sequence[Route]) -> Route | None:
    """The most specific route to an address; None if there is none."""
    fitting = [route for route in table if address in route.network]
    return max(fitting, key=lambda r: r.network.prefixlen) if fitting else None


def _ip_address(value: object) -> ipaddress.IPv4Address | None:
    try:
        return ipaddress.IPv4Address(value) if isinstance(value, str) else None
    except ValueError:
        return None


def _from_hex(text: str) -> str:
    """An address as the kernel prints it: the number in the host's byte order."""
    return socket.inet_ntoa(struct.pack("=I", int(text, 16)))
