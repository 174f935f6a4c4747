"""GVCP on the wire: commands in, acknowledgements out (GigE Vision 2.0, section 13 to 18).

Encoding only; `control` checks the privileges.
"""

from __future__ import annotations

import enum
import socket
import struct
from dataclasses import dataclass

PORT = 3956
KEY = 0x42
HEADER_LENGTH = 8
READ_MAX = 536
ACK_REQUIRED = 0x01
ALLOW_BROADCAST_ACK = 0x10
"""DISCOVERY and FORCEIP: a head in another subnet than the asker answers by broadcast."""
SCHEDULED = 0x80
"""An action command with its scheduled time."""

_HEADER = struct.Struct(">BBHHH")
_ACK_HEADER = struct.Struct(">HHHH")


class Status(enum.IntEnum):
    SUCCESS = 0x0000
    PACKET_RESEND = 0x0100
    NOT_IMPLEMENTED = 0x8001
    INVALID_PARAMETER = 0x8002
    INVALID_ADDRESS = 0x8003
    WRITE_PROTECT = 0x8004
    BAD_ALIGNMENT = 0x8005
    ACCESS_DENIED = 0x8006
    BUSY = 0x8007
    PACKET_UNAVAILABLE = 0x800C
    INVALID_HEADER = 0x800E
    OVERFLOW = 0x8015
    ACTION_LATE = 0x8016


class CommandCode(enum.IntEnum):
    """Commands; the acknowledgement of one is its code plus one."""

    DISCOVERY = 0x0002
    FORCEIP = 0x0004
    PACKETRESEND = 0x0040
    READREG = 0x0080
    WRITEREG = 0x0082
    READMEM = 0x0084
    WRITEMEM = 0x0086
    ACTION = 0x0100


@dataclass(frozen=True)
class GvcpCommand:
    code: int
    flags: int
    request_id: int
    body: bytes

    @property
    def wants_acknowledgement(self) -> bool:
        return bool(self.flags & ACK_REQUIRED)


@dataclass(frozen=True)
class ResendRequest:
    """Packets `first` to `last` of a block, both included."""

    block_id: int
    first: int
    last: int


@dataclass(frozen=True)
class ActionRequest:
    """Who is meant by an action command, and when on the device's clock; None is at once."""

    device_key: int
    group_key: int
    group_mask: int
    device_ns: int | None


@dataclass(frozen=True)
class ForceIpRequest:
    """The head that is meant, by its MAC address, and its new address."""

    mac: bytes
    address: str
    mask: str
    gateway: str


def parse_force_ip(command: GvcpCommand) -> ForceIpRequest | None:
    """The request in a FORCEIP command; None where it makes no sense."""
    if len(command.body) != 56:
        return None
    mac, *parts = struct.unpack(">2x6s12x4s12x4s12x4s", command.body)
    address, mask, gateway = (socket.inet_ntoa(part) for part in parts)
    return ForceIpRequest(mac, address, mask, gateway)


def parse_action(command: GvcpCommand) -> ActionRequest | None:
    """The request in an ACTION command; None where it makes no sense."""
    is_scheduled = bool(command.flags & SCHEDULED)
    if len(command.body) != (20 if is_scheduled else 12):
        return None
    device_key, group_key, group_mask = struct.unpack_from(">III", command.body)
    at_ns = struct.unpack_from(">Q", command.body, 12)[0] if is_scheduled else None
    return ActionRequest(device_key, group_key, group_mask, at_ns)


def parse_command(packet: bytes) -> GvcpCommand | None:
    """The command in a datagram; None for anything that is not one."""
    if len(packet) < HEADER_LENGTH:
        return None
    key, flags, code, length, request_id = _HEADER.unpack_from(packet)
    is_command = code % 2 == 0  # an odd code is an acknowledgement
    if key != KEY or not is_command or request_id == 0:
        return None
    if length != len(packet) - HEADER_LENGTH:
        return None
    return GvcpCommand(code, flags, request_id, packet[HEADER_LENGTH:])


def acknowledgement(
    command: GvcpCommand, body: bytes = b"", status: Status = Status.SUCCESS
) -> bytes:
    """The answer to a command."""
    return _ACK_HEADER.pack(status, command.code + 1, len(body), command.request_id) + body


def parse_resend(body: bytes) -> ResendRequest | None:
    """The request in a PACKETRESEND command with 16-bit block ids; None where it makes no sense."""
    if len(body) < 12:
        return None
    _channel, block_id, first, last = struct.unpack_from(">HHII", body)
    first, last = first & 0xFF_FFFF, last & 0xFF_FFFF
    if block_id == 0 or last < first:
        return None
    return ResendRequest(block_id, first, last)
