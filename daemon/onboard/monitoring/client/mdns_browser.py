"""Discovery of services by multicast DNS.

Any host on the network can announce anything: results are shown to a person, with texts made
printable, and decides nothing.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Final

from daemon.onboard.monitoring.client.mdns_announcer import SERVICE_TYPE
from daemon.terminal.printable import printable
from drivers.base.extras import require

BROWSE_S: Final = 3.0
QUERY_TIMEOUT_S: Final = 1.0
QUERY_TOTAL_S: Final = 6.0
SERVICES_MAX: Final = 32
TEXT_MAX: Final = 40


@dataclass(frozen=True)
class AnnouncedService:
    """An announced service: its address and its text record."""

    address: str
    text: dict[str, str]


def find_services(within_s: float = BROWSE_S) -> list[AnnouncedService]:
    """Find announced services on this network, 32 at most.

    Args:
        within_s: how long to listen.
    """
    require("watch")
    from zeroconf import ServiceBrowser, ServiceStateChange, Zeroconf

    names: dict[str, None] = {}

    def note(
        zeroconf: Zeroconf, service_type: str, name: str, state_change: ServiceStateChange
    ) -> None:
        if state_change is ServiceStateChange.Added and len(names) < SERVICES_MAX:
            names[name] = None

    zeroconf = Zeroconf()
    try:
        ServiceBrowser(zeroconf, SERVICE_TYPE, handlers=[note])
        time.sleep(within_s)
        deadline_s = time.monotonic() + QUERY_TOTAL_S
        found = []
        for name in sorted(names):
            left_s = min(QUERY_TIMEOUT_S, deadline_s - time.monotonic())
            if left_s <= 0:
                break
            info = zeroconf.get_service_info(SERVICE_TYPE, name, timeout=round(left_s * 1000))
            if info is not None and (announced := parse_announcement(info)) is not None:
                found.append(announced)
        return found
    finally:
        zeroconf.close()


def parse_announcement(info: Any) -> AnnouncedService | None:
    """The service of a zeroconf ServiceInfo; None without address or port."""
    addresses = info.parsed_addresses()
    if not addresses or not isinstance(info.port, int) or not 0 < info.port < 65536:
        return None
    host = f"[{addresses[0]}]" if ":" in addresses[0] else addresses[0]
    text = {
        _text(key): _text(value or b"")
        for key, value in list(info.properties.items())[:SERVICES_MAX]
    }
    return AnnouncedService(f"{host}:{info.port}", text)


def _text(given: bytes) -> str:
    return printable(given.decode("utf-8", "replace"), TEXT_MAX)
