"""Discovery of GigE Vision and USB3 Vision heads on the local networks and ports."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from typing import Any

from drivers.cameras.aravis.gvcp import is_ip_address
from drivers.cameras.aravis.library import OPENING, aravis

# A datagram of a busy head or network is lost now and then.
PASSES = 2


@dataclass(frozen=True)
class FoundHead:
    """A discovery reply of a head; any host on the network can forge one.

    `address` is the value for the driver's setting. Unprintable characters are replaced by "?".
    """

    address: str
    vendor: str
    model: str
    serial: str
    protocol: str


def heads() -> list[FoundHead]:
    """Discover heads in two passes; takes about two seconds.

    Returns:
        Every head that answers Aravis' discovery in one of them, sorted by address.

    Raises:
        DeviceError: Aravis is not installed.
    """
    library = aravis()
    found: dict[FoundHead, None] = {}
    with OPENING:
        for _ in range(PASSES):
            library.update_device_list()
            for index in range(library.get_n_devices()):
                head = _head(library, index)
                if head.protocol != "Fake":
                    found[head] = None
    return sorted(found, key=_by_address)


def _head(library: Any, index: int) -> FoundHead:
    protocol = str(library.get_device_protocol(index) or "")
    # USB heads have no persistent address; they are opened by their name.
    name = library.get_device_id(index)
    address = library.get_device_address(index) if protocol == "GigEVision" else name
    return FoundHead(
        _printable(address or name),
        _printable(library.get_device_vendor(index)),
        _printable(library.get_device_model(index)),
        _printable(library.get_device_serial_nbr(index)),
        protocol,
    )


def _printable(text: str | None) -> str:
    return "".join(c if c.isprintable() else "?" for c in text or "")


def _by_address(head: FoundHead) -> tuple[bool, int, str]:
    is_number = is_ip_address(head.address)
    number = int(ipaddress.IPv4Address(head.address)) if is_number else 0
    return (not is_number, number, head.address)
