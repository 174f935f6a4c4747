"""Discovery of GigE Vision and USB3 Vision heads on the local networks and ports."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass

from drivers.cameras.aravis.gvcp import is_ip_address
from drivers.cameras.aravis.library import OPENING, aravis


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
    """Discover heads; takes about a second.

    Returns:
        Every head that answers Aravis' discovery, sorted by address.

    Raises:
        DeviceError: Aravis is not installed.
    """
    library = aravis()
    found = []
    with OPENING:
        library.update_device_list()
        for index in range(library.get_n_devices()):
            protocol = str(library.get_device_protocol(index) or "")
            if protocol == "Fake":
                continue
            # USB heads have no persistent address; they are opened by their name.
            name = library.get_device_id(index)
            address = library.get_device_address(index) if protocol == "GigEVision" else name
            found.append(
                FoundHead(
                    _printable(address or name),
                    _printable(library.get_device_vendor(index)),
                    _printable(library.get_device_model(index)),
                    _printable(library.get_device_serial_nbr(index)),
                    protocol,
                )
            )
    return sorted(found, key=_by_address)


def _printable(text: str | None) -> str:
    return "".join(c if c.isprintable() else "?" for c in text or "")


def _by_address(head: FoundHead) -> tuple[bool, int, str]:
    is_number = is_ip_address(head.address)
    number = int(ipaddress.IPv4Address(head.address)) if is_number else 0
    return (not is_number, number, head.address)
