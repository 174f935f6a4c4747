"""A TCP connection that reads and writes like a serial port.

For receivers on the camera's network and for terminal servers. A device uses it if its `port` is
"tcp://host:port".
"""

from __future__ import annotations

import contextlib
import socket
from typing import Final
from urllib.parse import urlsplit

from drivers.contract import DeviceError

SCHEME: Final = "tcp://"
CONNECT_TIMEOUT_S: Final = 1.5
"""Shorter than the limit for closing a device."""
WRITE_TIMEOUT_S: Final = 1.0
CHUNK_NBYTES: Final = 65_536


class TcpPort:
    """One connection; a port of `drivers.transport.serial_device.SerialLine`."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._buffer = b""
        self.timeout: float = 0.0

    @property
    def in_waiting(self) -> int:
        """Number of bytes that `read` returns without waiting."""
        return len(self._buffer)

    def read(self, size: int = 1) -> bytes:
        """Read received bytes.

        Args:
            size: largest number of bytes.

        Returns:
            At most `size` bytes; empty if none is received within `timeout` seconds.

        Raises:
            OSError: the other end closed or the connection broke.
        """
        if not self._buffer:
            # Quirk: a time-out of 0 makes a socket non-blocking, with another exception.
            # Upstream: manual: Python, socket, section Notes on socket timeouts.
            self._connection.settimeout(max(self.timeout, 1e-3))
            try:
                self._buffer = self._connection.recv(CHUNK_NBYTES)
            except TimeoutError:
                return b""
            if not self._buffer:
                raise OSError("the other end closed the connection")
        data, self._buffer = self._buffer[:size], self._buffer[size:]
        return data

    def write(self, data: bytes, /) -> int:
        """Send all bytes within a second.

        Args:
            data: bytes to send.

        Returns:
            Number of bytes sent, all.

        Raises:
            OSError: the connection broke or accepts nothing.
        """
        self._connection.settimeout(WRITE_TIMEOUT_S)
        self._connection.sendall(data)
        return len(data)

    def close(self) -> None:
        """End the connection; a pending `read` raises OSError."""
        # The other end has reset the connection: there is nothing left to shut down.
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)
        self._connection.close()


def open_tcp_port(address: str) -> TcpPort:
    """Connect to an address.

    Args:
        address: "tcp://host:port".

    Returns:
        The connection, with TCP keep-alive.

    Raises:
        DeviceError: the address is wrong or does not answer; the message contains the remedy.
    """
    place = host_and_number(address)
    if place is None:
        raise DeviceError(
            f"port {address} is no address; write tcp://host:port, such as tcp://10.0.0.5:3001"
        )
    try:
        connection = socket.create_connection(place, timeout=CONNECT_TIMEOUT_S)
    except (OSError, UnicodeError) as error:
        raise DeviceError(
            f"port {address} cannot be opened: {error or type(error).__name__}; check that the "
            "device is on the network and serves this port"
        ) from error
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    return TcpPort(connection)


def host_and_number(address: str) -> tuple[str, int] | None:
    """Host and port number of an address.

    Args:
        address: "scheme://host:port".

    Returns:
        Host and port number; None for any other text.

    Example:
        >>> host_and_number("tcp://10.0.0.5:3001")
        ('10.0.0.5', 3001)
    """
    try:
        parts = urlsplit(address)
        host, number = parts.hostname, parts.port
    except ValueError:
        return None
    return (host, number) if host and number else None
