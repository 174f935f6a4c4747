"""Questions of our own to a GigE Vision head: is it alive, is it held, and for how long.

Aravis needs 2.5 s to find that a head does not answer, and opens a head that someone else holds
without saying so; reading a register beforehand tells both in a moment. Everything else about a
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
HEARTBEAT_TIMEOUT: Final = 0x0938
DEFAULT_HEARTBEAT_S: Final = 3.0
KEY: Final = 0x42
ACK_REQUIRED: Final = 0x01
REQUEST_ID: Final = 1
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


def control_privilege(address: str, *, timeout_s: float) -> int | None:
    """The head's control channel privilege: 0 is free; None where it does not answer in time.

    Never raises for what the head or the network does. Some heads take any reading of this
    register for their controller's heartbeat, so it must not be polled while a hold is waited out.
    """
    answer = _read_register(address, CONTROL_CHANNEL_PRIVILEGE, timeout_s)
    if answer is None:
        return None
    status, value = answer
    if status == ACCESS_DENIED:
        return EXCLUSIVE
    return value & PRIVILEGED if status == 0 else None


def heartbeat_timeout_s(address: str, *, timeout_s: float) -> float:
    """How long after its last word a head lets go of a controller; the standard's 3 s if unsaid."""
    answer = _read_register(address, HEARTBEAT_TIMEOUT, timeout_s)
    if answer is None or answer[0] != 0:
        return DEFAULT_HEARTBEAT_S
    return min(max(answer[1] * 1e-3, 0.5), 30.0)


def _read_register(address: str, register: int, timeout_s: float) -> tuple[int, int] | None:
    """Status and value of a register; None where no fitting answer came."""
    question = struct.pack(">BBHHHI", KEY, ACK_REQUIRED, READREG_CMD, 4, REQUEST_ID, register)
    try:
        # A fresh port for every question: an answer to an older one cannot be mistaken for it.
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
    if command != READREG_ACK or answered_id != REQUEST_ID:
        return None
    value = struct.unpack_from(">I", answer, 8)[0] if len(answer) >= 12 else 0
    return (status, value) if status != 0 or len(answer) >= 12 else None
