"""Test packets of a head: which sizes reach this computer on the path of the stream.

Source: GigE Vision 2.0, section 28 (stream channel packet size: fire test packet, do not fragment).
"""

from __future__ import annotations

import contextlib
import enum
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from drivers.cameras.aravis.gvcp_channel import GvcpChannel, HeadBusyError
from drivers.contract import DeviceError

STREAM_PORT: Final = 0x0D00
PACKET_SIZE: Final = 0x0D04
STREAM_DESTINATION: Final = 0x0D18
FIRE_TEST_PACKET: Final = 1 << 31
DO_NOT_FRAGMENT: Final = 1 << 30
SIZE_BITS: Final = 0xFFFF
IP_UDP_NBYTES: Final = 28
SMALLEST: Final = 576
STEP: Final = 8
"""Packet sizes of heads are multiples of 4, of some of 8."""
ATTEMPTS: Final = 3
WAIT_S: Final = 0.1


class PathState(enum.StrEnum):
    """How far a head is reached."""

    OPEN = "open"
    """Control and test packets pass."""
    NO_STREAM = "no stream"
    """Control passes, no test packet does."""
    NO_CONTROL = "no control"
    """Nothing answers."""
    BUSY = "busy"
    """Another program controls the head; nothing was tried."""


@dataclass(frozen=True)
class PathProbe:
    """What passes from a head to this computer.

    `largest` is the largest packet that arrived, in bytes of the IP packet; 0 if none did.
    """

    state: PathState
    wanted: int
    largest: int
    local_address: str = ""


def probe_path(address: str, wanted: int) -> PathProbe:
    """Let the head send test packets of the wanted size, and of smaller ones if it is lost.

    Takes control of the head for at most some seconds, and restores its packet size.

    Args:
        address: of the head.
        wanted: size of the IP packet in bytes.

    Returns:
        How far the head is reached, and the largest packet that arrived.
    """
    try:
        with (
            GvcpChannel(address) as channel,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stream,
        ):
            local = channel.local_address
            stream.bind((local, 0))
            before = channel.read(PACKET_SIZE) & SIZE_BITS
            channel.write(STREAM_DESTINATION, int.from_bytes(socket.inet_aton(local), "big"))
            channel.write(STREAM_PORT, stream.getsockname()[1])
            try:
                largest = _largest(lambda size: _passes(channel, stream, size), wanted)
            finally:
                with contextlib.suppress(DeviceError):
                    channel.write(PACKET_SIZE, before)
                    channel.write(STREAM_PORT, 0)
    except HeadBusyError:
        return PathProbe(PathState.BUSY, wanted, 0)
    except (DeviceError, OSError):
        return PathProbe(PathState.NO_CONTROL, wanted, 0)
    return PathProbe(PathState.OPEN if largest else PathState.NO_STREAM, wanted, largest, local)


def _largest(passes: Callable[[int], bool], wanted: int) -> int:
    """The largest size up to `wanted` that passes, found by bisection; 0: not even the smallest."""
    if passes(wanted):
        return wanted
    if wanted <= SMALLEST or not passes(SMALLEST):
        return 0
    low, high = SMALLEST // STEP, -(-wanted // STEP)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if passes(middle * STEP) else (low, middle)
    return low * STEP


def _passes(channel: GvcpChannel, stream: socket.socket, size: int) -> bool:
    for _ in range(ATTEMPTS):
        try:
            channel.write(PACKET_SIZE, FIRE_TEST_PACKET | DO_NOT_FRAGMENT | size)
        except DeviceError:
            return False
        until_s = time.monotonic() + WAIT_S
        while (left_s := until_s - time.monotonic()) > 0:
            stream.settimeout(left_s)
            try:
                nbytes = len(stream.recv(1 << 16))
            except OSError:
                break
            if nbytes + IP_UDP_NBYTES == size:
                return True
    return False
