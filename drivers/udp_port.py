"""Datagrams that read and write like a serial port.

For autopilots and receivers that send over UDP; which devices use it is said by their `port`:
"udpin://host:port" listens there, "udpout://host:port" speaks to that address.
"""

from __future__ import annotations

import socket
from typing import Final

from drivers.contract import DeviceError
from drivers.tcp_port import host_and_number

LISTEN_SCHEME: Final = "udpin://"
SPEAK_SCHEME: Final = "udpout://"
DATAGRAM_NBYTES: Final = 65_536


class UdpPort:
    """One UDP socket; the port `drivers.serial_device.SerialLine` reads from.

    Where it listens, whoever speaks first is its peer until it is closed: others are not heard, so
    that two senders cannot tear each other's messages apart.
    """

    def __init__(self, udp: socket.socket, peer: tuple[str, int] | None) -> None:
        self._socket = udp
        self._peer = peer
        self._buffer = b""
        self.timeout: float = 0.0

    @property
    def in_waiting(self) -> int:
        """Bytes that `read` has without waiting."""
        return len(self._buffer)

    def read(self, size: int = 1) -> bytes:
        """At most `size` bytes, empty where none comes in `timeout` seconds; OSError: refused."""
        if not self._buffer:
            self._socket.settimeout(max(self.timeout, 1e-3))
            try:
                data, sender = self._socket.recvfrom(DATAGRAM_NBYTES)
            except TimeoutError:
                return b""
            self._peer = self._peer or sender
            if sender == self._peer:
                self._buffer = data
        data, self._buffer = self._buffer[:size], self._buffer[size:]
        return data

    def write(self, data: bytes, /) -> int:
        """Send one datagram; nothing is sent while nobody has spoken yet."""
        return self._socket.sendto(data, self._peer) if self._peer else 0

    def close(self) -> None:
        self._socket.close()


def open_udp_port(address: str) -> UdpPort:
    """Open "udpin://host:port" or "udpout://host:port".

    Raises:
        DeviceError: the address is wrong or taken; the sentence names the cure.
    """
    place = host_and_number(address)
    if place is None:
        raise DeviceError(
            f"port {address} is no address; write udpin://host:port, such as udpin://0.0.0.0:14550"
        )
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        if address.startswith(LISTEN_SCHEME):
            udp.bind(place)
            return UdpPort(udp, None)
        udp.connect(place)
        peer = udp.getpeername()
        return UdpPort(udp, (peer[0], peer[1]))
    except (OSError, UnicodeError) as error:
        udp.close()
        raise DeviceError(
            f"port {address} cannot be opened: {error or type(error).__name__}; check the address, "
            "and that no other program listens there"
        ) from error
