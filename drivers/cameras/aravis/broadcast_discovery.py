"""Discovery of GigE Vision heads on one interface, in any subnet, and FORCEIP; without Aravis.

Answers are read below the network stack where this is permitted: the reverse-path filter and the
firewall of this computer drop those from another subnet.

Source: GigE Vision 2.0, sections 14.1 (DISCOVERY) and 14.2 (FORCEIP).
"""

from __future__ import annotations

import contextlib
import ipaddress
import re
import secrets
import select
import socket
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from drivers.cameras.aravis.gvcp import ACK_REQUIRED, GVCP_PORT, KEY, REQUEST_IDS
from drivers.contract import DeviceError

DISCOVERY_CMD: Final = 0x0002
DISCOVERY_ACK: Final = 0x0003
FORCEIP_CMD: Final = 0x0004
ALLOW_BROADCAST_ACK: Final = 0x10
DISCOVERY_NBYTES: Final = 0xF8
BROADCAST: Final = "255.255.255.255"
ETHERTYPE_IPV4: Final = 0x0800
DISCOVERY_TIMEOUT_S: Final = 0.6
FORCE_TIMEOUT_S: Final = 6.0
MAC: Final = re.compile(r"(?:[0-9a-f]{2}:){5}[0-9a-f]{2}")


@dataclass(frozen=True)
class BroadcastHead:
    """A discovery answer; any host on the network can forge one."""

    interface: str
    mac: str
    address: str
    mask: str
    gateway: str
    vendor: str
    model: str
    serial: str
    user_name: str


def discover(interface: str, *, timeout_s: float = DISCOVERY_TIMEOUT_S) -> list[BroadcastHead]:
    """Every head that answers a broadcast on an interface.

    Args:
        interface: name of the interface of this computer.
        timeout_s: time to wait for answers.

    Returns:
        The answers, one for each MAC address, in its order.

    Raises:
        DeviceError: the interface cannot be used.
    """
    request_id = 1 + secrets.randbelow(REQUEST_IDS)
    found: dict[str, BroadcastHead] = {}
    flags = ACK_REQUIRED | ALLOW_BROADCAST_ACK
    with (
        _broadcast_socket(interface) as channel,
        contextlib.closing(_Answers(interface, channel)) as answers,
    ):
        _send(channel, interface, struct.pack(">BBHHH", KEY, flags, DISCOVERY_CMD, 0, request_id))
        for packet in answers.until(time.monotonic() + timeout_s):
            head = _parse(packet, interface, request_id)
            if head is not None:
                found[head.mac] = head
    return sorted(found.values(), key=lambda head: head.mac)


def force_address(
    interface: str, mac: str, address: str, mask: str, gateway: str = "0.0.0.0"
) -> BroadcastHead:
    """Give a head an address until it is switched off, and wait until it answers there.

    Args:
        interface: name of the interface of this computer that the head is connected to.
        mac: MAC address of the head, six hexadecimal bytes with colons.
        address: new IPv4 address.
        mask: mask of its subnet.
        gateway: gateway of its subnet.

    Returns:
        The head with its new address.

    Raises:
        DeviceError: an argument is none, the head does not answer, or it keeps its address.
    """
    if MAC.fullmatch(mac.lower()) is None:
        raise DeviceError(f"{mac!r} is no MAC address; give one such as 00:11:22:33:44:55")
    try:
        fields = [ipaddress.IPv4Address(part).packed for part in (address, mask, gateway)]
        network = ipaddress.IPv4Network((address, mask), strict=False)
    except ValueError as error:
        raise DeviceError(f"{error}; give an IPv4 address and a mask of a subnet") from None
    if fields[0] in (network.network_address.packed, network.broadcast_address.packed):
        raise DeviceError(f"{address} is no address of a host in {network}; choose another one")
    number = bytes.fromhex(mac.replace(":", ""))
    body = struct.pack(">H6s12x4s12x4s12x4s", 0, number, fields[0], fields[1], fields[2])
    request_id = 1 + secrets.randbelow(REQUEST_IDS)
    flags = ACK_REQUIRED | ALLOW_BROADCAST_ACK
    header = struct.pack(">BBHHH", KEY, flags, FORCEIP_CMD, len(body), request_id)
    with _broadcast_socket(interface) as channel:
        _send(channel, interface, header + body)
    deadline_s = time.monotonic() + FORCE_TIMEOUT_S
    last = None
    while time.monotonic() < deadline_s:
        last = next((h for h in discover(interface) if h.mac == mac.lower()), last)
        if last is not None and last.address == str(ipaddress.IPv4Address(address)):
            return last
    if last is None:
        raise DeviceError(
            f"no head with MAC address {mac} answers on {interface}; check its power, cable and "
            "interface"
        )
    raise DeviceError(
        f"the head {mac} keeps its address {last.address}; end the program that controls it"
    )


class _Answers:
    """Datagrams to the port of a socket, below the network stack where this is permitted."""

    def __init__(self, interface: str, channel: socket.socket) -> None:
        self._channel = channel
        self._port = channel.getsockname()[1]
        self._raw: socket.socket | None = None
        with contextlib.suppress(PermissionError):
            self._raw = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, 0)
            self._raw.bind((interface, ETHERTYPE_IPV4))

    def until(self, deadline_s: float) -> Iterator[bytes]:
        sources = [self._channel] + ([self._raw] if self._raw is not None else [])
        while (left_s := deadline_s - time.monotonic()) > 0:
            for ready in select.select(sources, [], [], left_s)[0]:
                with contextlib.suppress(OSError):
                    packet = ready.recv(2048, socket.MSG_DONTWAIT)
                    if ready is self._raw:
                        packet = self._datagram(packet)
                    if packet:
                        yield packet

    def close(self) -> None:
        if self._raw is not None:
            self._raw.close()

    def _datagram(self, packet: bytes) -> bytes:
        """The content of a UDP datagram to our port from a head's; empty for all others."""
        start = (packet[0] & 0x0F) * 4 if packet else 0
        if len(packet) < start + 8 or start < 20 or packet[9] != socket.IPPROTO_UDP:
            return b""
        source, target = struct.unpack_from(">HH", packet, start)
        return packet[start + 8 :] if (source, target) == (GVCP_PORT, self._port) else b""


def _broadcast_socket(interface: str) -> socket.socket:
    channel = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        channel.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        channel.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, interface.encode())
        channel.bind(("", 0))
    except OSError as error:
        channel.close()
        raise DeviceError(
            f"interface {interface} cannot be used ({error.strerror}); check its name with: ip link"
        ) from None
    return channel


def _send(channel: socket.socket, interface: str, packet: bytes) -> None:
    try:
        channel.sendto(packet, (BROADCAST, GVCP_PORT))
    except OSError as error:
        raise DeviceError(
            f"no broadcast leaves on {interface} ({error.strerror}); give it an address and check "
            "its cable"
        ) from None


def _parse(packet: bytes, interface: str, request_id: int) -> BroadcastHead | None:
    if len(packet) < 8 + DISCOVERY_NBYTES:
        return None
    status, code, _, answered = struct.unpack_from(">HHHH", packet)
    if (status, code, answered) != (0, DISCOVERY_ACK, request_id):
        return None
    body = packet[8:]

    def address(start: int) -> str:
        return socket.inet_ntoa(body[start : start + 4])

    def text(start: int, length: int) -> str:
        raw = body[start : start + length].partition(b"\0")[0].decode("utf-8", "replace")
        return "".join(c if c.isprintable() else "?" for c in raw)

    return BroadcastHead(
        interface,
        ":".join(f"{byte:02x}" for byte in body[0x0A:0x10]),
        address(0x24),
        address(0x34),
        address(0x44),
        text(0x48, 32),
        text(0x68, 32),
        text(0xD8, 16),
        text(0xE8, 16),
    )
