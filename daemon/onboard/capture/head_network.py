"""Check whether other computers share the network of the heads and could forge their frames."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from daemon.configuration.model import Configuration
from daemon.onboard.capture.routes import network_heads, parse_routes, route_to
from daemon.onboard.preflight.check_results import CheckResult, passed
from processing.rig import Rig

ROUTES: Final = Path("/proc/net/route")
NEIGHBOURS: Final = Path("/proc/net/arp")
COMPLETE: Final = 0x2
NAMED_MAX: Final = 3


def head_network(configuration: Configuration, _rig: Rig) -> Iterator[CheckResult]:
    """A caution for each network that heads share with others; it does not prevent a flight."""
    heads = network_heads(configuration)
    if not heads:
        return
    try:
        routes, neighbours = ROUTES.read_text("ascii"), NEIGHBOURS.read_text("ascii")
    except OSError:
        return
    cautions = cautions_of(heads, routes, neighbours)
    for interface, sentence in cautions.items():
        yield passed("network", interface, f"caution: {sentence}")
    if not cautions:
        yield passed("network", "heads", "no other computer was seen on the network of the heads")


def cautions_of(
    heads: Mapping[str, ipaddress.IPv4Address], routes: str, neighbours: str
) -> dict[str, str]:
    """What is wrong with the network of each interface that leads to heads.

    Args:
        heads: address by sensor.
        routes: text of /proc/net/route.
        neighbours: text of /proc/net/arp.
    """
    table = parse_routes(routes)
    seen = _neighbours(neighbours)
    by_interface: dict[str, list[str]] = {}
    beyond: set[str] = set()
    for sensor, address in heads.items():
        route = route_to(address, table)
        if route is None:
            continue
        by_interface.setdefault(route.interface, []).append(sensor)
        if route.is_gateway:
            beyond.add(route.interface)
    found = {}
    for interface, sensors in by_interface.items():
        others = sorted(seen.get(interface, set()) - set(heads.values()))
        why = [str(address) for address in others[:NAMED_MAX]]
        if len(others) > NAMED_MAX:
            why.append(f"{len(others) - NAMED_MAX} more")
        if interface in beyond:
            why.insert(0, "a router lies in between")
        elif any(r.interface == interface and r.network.prefixlen == 0 for r in table):
            why.insert(0, "the default route leads there")
        if why:
            found[interface] = (
                f"{_listed(sensors)} on a network shared with others ({', '.join(why)}): a "
                "computer that forges a head's address there can alter its frames. Give the "
                "heads a separate interface"
            )
    return found


def _listed(sensors: list[str]) -> str:
    if len(sensors) == 1:
        return f"head {sensors[0]} is"
    return f"{len(sensors)} heads ({sensors[0]} to {sensors[-1]}) are"


def _neighbours(text: str) -> dict[str, set[ipaddress.IPv4Address]]:
    """Addresses that have answered, by interface."""
    found: dict[str, set[ipaddress.IPv4Address]] = {}
    for line in text.splitlines()[1:]:
        fields = line.split()
        if len(fields) >= 6 and int(fields[2], 16) & COMPLETE:
            found.setdefault(fields[5], set()).add(ipaddress.IPv4Address(fields[0]))
    return found
