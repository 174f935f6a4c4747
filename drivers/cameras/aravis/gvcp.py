"""GVCP requests without Aravis: presence, control privilege, heartbeat and action commands.

All other access to a head uses Aravis.

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
"""Maximum total wait for a head that sends PENDING_ACK, however often it sends it."""
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
    """Whether a head is configured by its IPv4 address; USB3 Vision heads are not.

    Args:
        address: the setting `address`.

    Returns:
        True for four decimal numbers.
    """
    try:
        ipaddress.IPv4Address(address)
    except ValueError:
        return False
    return True


def control_privilege(address: str, *, timeout_s: float) -> int | None:
    """The head's control channel privilege.

    Faults of the head or network never raise. The register must not be polled while waiting for
    another controller.

    Args:
        address: IPv4 address of the head.
        timeout_s: longest wait for the answer, s.

    Returns:
        0 if nobody has control, else the bits of exclusive and control access; None if the head
        does not answer in time.

    Source: GigE Vision 2.0, sections 14.3.1 and 28.1.
    """
    # Quirk: Aravis needs 2.5 s to detect that a head does not answer. This answers in `timeout_s`.
    # Upstream: AravisProject/aravis#459.
    # Quirk: Aravis reports no error if another controller has control. It is asked for here before
    # a head is opened. Upstream: AravisProject/aravis#382, AravisProject/aravis#1012.
    # Quirk: some heads, Aravis' fake camera among them, take any read of this register for a
    # heartbeat of their controller. Upstream: no report known (2026-11-23).
    answer = _read_register(address, CONTROL_CHANNEL_PRIVILEGE, timeout_s)
    if answer is None:
        return None
    status, value = answer
    if status == ACCESS_DENIED:
        return EXCLUSIVE
    return value & PRIVILEGED if status == 0 else None


def heartbeat_timeout_s(address: str, *, timeout_s: float) -> float:
    """The head's heartbeat time-out.

    Args:
        address: IPv4 address of the head.
        timeout_s: longest wait for the answer, s.

    Returns:
        Time-out limited to 0.5 to 30 s; the standard's 3 s if the head does not report one.
    """
    answer = _read_register(address, HEARTBEAT_TIMEOUT, timeout_s)
    if answer is None or answer[0] != 0:
        return DEFAULT_HEARTBEAT_S
    return min(max(answer[1] * 1e-3, 0.5), 30.0)


@dataclass(frozen=True)
class ActionKeys:
    """The addressees of an action command: heads with both keys and a common bit of the masks."""

    device_key: int
    group_key: int
    group_mask: int


def send_action(
    address: str, keys: ActionKeys, *, device_ns: int | None, timeout_s: float
) -> int | None:
    """Send an action command.

    The command is never repeated, since a second one might cause a second exposure.

    Args:
        address: IPv4 address of the head.
        keys: its addressees.
        device_ns: time of exposure on the head's clock, ns; None for an immediate command.
        timeout_s: longest wait for the answer, s.

    Returns:
        The head's status; None if it did not answer in time.

    Source: GigE Vision 2.0, section 14.5.
    """
    # Quirk: Aravis 0.8 has no action commands. Upstream: AravisProject/aravis#184.
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
    """Status and body of the answer to a command; None if the head does not answer.

    Only the head's own answer is accepted: the kernel drops datagrams of other senders, and the
    answer must contain the random number of the request.
    """
    request_id = 1 + secrets.randbelow(REQUEST_IDS)
    now_s = time.monotonic()
    until_s, latest_s = now_s + timeout_s, now_s + timeout_s + PENDING_MAX_S
    try:
        # A new port for every request, so that a late answer to an older one is not accepted.
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
    """Status and value of a register; None if no matching answer came."""
    answer = _request(address, READREG_CMD, struct.pack(">I", register), timeout_s=timeout_s)
    if answer is None:
        return None
    status, body = answer
    if len(body) < 4:
        return (status, 0) if status != 0 else None
    return status, int(struct.unpack_from(">I", body)[0])
