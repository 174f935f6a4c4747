"""One question of our own to a GigE Vision head: who controls it, if it is alive at all.

Aravis needs 2.5 s to find that a head does not answer, and opens a head that someone else holds
without saying so; reading one register beforehand tells both in a moment. Everything else about a
head goes through Aravis.

Source: GigE Vision 2.0, sections 14.3.1 (READREG) and 28.1 (control channel privilege).
"""

from __future__ import annotations

import ipaddress
import socket
import struct
from typing import Final

GVCP_PORT: Final = 3956
CONTROL_CHANNEL_PRIVILEGE: Final = 0x0A00
KEY: Final = 0x42
ACK_REQUIRED: Final = 0x01
READREG_CMD: Final = 0x0080
READREG_ACK: Final = 0x0081
ACCESS_DENIED: Final = 0x8006
EXCLUSIVE: Final = 1
PRIVILEGED: Final = 0b11
"""Exclusive or control access."""


def is_ip_address(address: str) -> bool:
    """Whether a head is named by its IPv4 address; USB3 Vision heads are not."""
    try:
        ipaddress.IPv4Address(address)
    except ValueError:
        return False
    return True


def control_privilege(address: str, *, timeout_s: float, request_id: int = 1) -> int | None:
    """The head's control channel privilege: 0 is free; None where it does not answer in time.

    Never raises for what the head or the network does.
    """
    question = struct.pack(
        ">BBHHHI", KEY, ACK_REQUIRED, READREG_CMD, 4, request_id, CONTROL_CHANNEL_PRIVILEGE
    )
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as channel:
            channel.settimeout(timeout_s)
            channel.connect((address, GVCP_PORT))
            channel.send(question)
            answer = channel.recv(576)
    except OSError:
        return None
    if len(answer) < 8:
        return None
    status, command, _, answered_id = struct.unpack_from(">HHHH", answer)
    if command != READREG_ACK or answered_id != request_id:
        return None
    if status == ACCESS_DENIED:
        return EXCLUSIVE
    if status != 0 or len(answer) < 12:
        return None
    privilege: int = struct.unpack_from(">I", answer, 8)[0]
    return privilege & PRIVILEGED
