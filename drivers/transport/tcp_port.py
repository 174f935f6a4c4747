"""A TCP connection that reads and writes like a serial port.

For receivers on the camera's network and for terminal servers; which devices use it is said by
their `port`, "tcp://host:port".
"""

from __future__ import annotations

import contextlib
import socket
from typing import Final
from urllib.parse import urlsplit

from drivers.contract import DeviceError

SCHEME: Final = "tcp://"
CONNECT_TIMEOUT_S: Final = 1.5
"""Less than what closing a device may take."""
WRITE_TIMEOUT_S: Final = 1.0
CHUNK_NBYTES: Final = 65_536


class TcpPort:
    """One connection; the port `drivers.transport.serial_device.SerialLine` reads from."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._buffer = b""
        self.timeout: float = 0.0

    @property
    def in_waiting(self) -> int:
        """Bytes that `read` has without waiting."""
        return len(self._buffer)

    def read(self, size: int = 1) -> bytes:
        """At most `size` bytes, empty where none comes in `timeout` seconds.

        Raises:
            OSError: the other end closed or the connection broke.
        """
        if not self._buffer:
            # A time-out of 0 would mean "non-blocking" to a socket, with another exception.
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
        """Send all of it within a second; OSError where that fails."""
        self._connection.settimeout(WRITE_TIMEOUT_S)
        self._connection.sendall(data)
        return len(data)

    def close(self) -> None:
        # Already reset by the other end: there is nothing left to shut down.
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)
        self._connection.close()


def open_tcp_port(address: str) -> TcpPort:
    """Connect to "tcp://host:port".

    Raises:
        DeviceError: the address is wrong or nobody answers there; the sentence names the cure.
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
    """Host and port number of "scheme://host:port"; None where it is none.

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
