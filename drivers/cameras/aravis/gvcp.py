"""Questions of our own to a GigE Vision head: is it alive, is it held, and for how long.

Aravis needs 2.5 s to find that a head does not answer, and opens a head that someone else holds
without saying so; reading a register beforehand tells both in a moment. Everything else about a
head goes through Aravis.

Action commands are ours, too: Aravis 0.8 has none.

Source: GigE Vision 2.0, sections 14.3.1 (READREG), 14.5 (ACTION) and 28.1 (control channel
privilege).
"""

from __future__ import annotations

import ipaddress
import secrets
import socket
import struct
import time
from dataclasses import dataclass
from typing import Final

GVCP_PORT: Final = 3956
CONTROL_CHANNEL_PRIVILEGE: Final = 0x0A00
HEARTBEAT_TIMEOUT: Final = 0x0938
DEFAULT_HEARTBEAT_S: Final = 3.0
KEY: Final = 0x42
ACK_REQUIRED: Final = 0x01
REQUEST_IDS: Final = 0xFFFF
PENDING_ACK: Final = 0x0089
PENDING_MAX_S: Final = 2.0
"""How long a head that says that it needs more time is waited for, however often it says so."""
READREG_CMD: Final = 0x0080
ACTION_CMD: Final = 0x0100
SCHEDULED: Final = 0x80
SUCCESS: Final = 0x0000
ACTION_LATE: Final = 0x8016
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


@dataclass(frozen=True)
class ActionKeys:
    """Whom an action command means: heads with both keys and a common bit of the masks."""

    device_key: int
    group_key: int
    group_mask: int


def send_action(
    address: str, keys: ActionKeys, *, device_ns: int | None, timeout_s: float
) -> int | None:
    """Give an action command; the head's status, None where it did not answer in time.

    `device_ns` is when, on the head's clock; None is at once. Sent once: a second one might be a
    second exposure.
    """
    body = struct.pack(">III", keys.device_key, keys.group_key, keys.group_mask)
    flags = ACK_REQUIRED
    if device_ns is not None:
        flags |= SCHEDULED
        body += struct.pack(">Q", device_ns)
    answer = _request(address, ACTION_CMD, body, flags=flags, timeout_s=timeout_s)
    return None if answer is None else answer[0]


def _request(
    address: str, command: int, body: bytes, *, timeout_s: float, flags: int = ACK_REQUIRED
) -> tuple[int, bytes] | None:
    """Status and body of the answer to a command; None for silence or an unreachable head.

    Only the head's own answer counts: the kernel drops what comes from elsewhere, and the answer
    has to carry the number of the request, which nobody else can know.
    """
    request_id = 1 + secrets.randbelow(REQUEST_IDS)
    now_s = time.monotonic()
    until_s, latest_s = now_s + timeout_s, now_s + timeout_s + PENDING_MAX_S
    try:
        # A fresh port for every question: an answer to an older one cannot be mistaken for it.
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as channel:
            channel.connect((address, GVCP_PORT))
            channel.send(struct.pack(">BBHHH", KEY, flags, command, len(body), request_id) + body)
            while (left_s := until_s - time.monotonic()) > 0:
                channel.settimeout(left_s)
                answer = channel.recv(576)
                if len(answer) < 8:
                    continue
                status, acknowledged, _, answered_id = struct.unpack_from(">HHHH", answer)
                if answered_id != request_id:
                    continue
                if acknowledged == command + 1:
                    return int(status), answer[8:]
                if acknowledged == PENDING_ACK and len(answer) >= 12:
                    (more_ms,) = struct.unpack_from(">H", answer, 10)
                    until_s = min(time.monotonic() + more_ms * 1e-3, latest_s)
    except OSError:
        return None
    return None


def _read_register(address: str, register: int, timeout_s: float) -> tuple[int, int] | None:
    """Status and value of a register; None where no fitting answer came."""
    answer = _request(address, READREG_CMD, struct.pack(">I", register), timeout_s=timeout_s)
    if answer is None:
        return None
    status, body = answer
    if len(body) < 4:
        return (status, 0) if status != 0 else None
    return status, int(struct.unpack_from(">I", body)[0])
