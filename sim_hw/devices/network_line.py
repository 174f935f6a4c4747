"""The device's end of a network connection: a TCP server, or a UDP sender that receives answers.

They replace a pseudo-terminal, see `sim_hw.devices.device_loop.DeviceLine`.
"""

from __future__ import annotations

import selectors
import socket
import time

_READ_BYTES = 65_536
_DATAGRAM_BYTES = 1200


class TcpLine:
    """Serves every host that connects; all of them receive the same bytes."""

    def __init__(self, host: str = "127.0.0.1", port: int = 0) -> None:
        self._server = socket.create_server((host, port))
        self._server.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._server, selectors.EVENT_READ)
        self._hosts: list[socket.socket] = []
        bound_host, bound_port = self._server.getsockname()[:2]
        self.port = f"tcp://{bound_host}:{bound_port}"

    @property
    def is_open_by_a_host(self) -> bool:
        return bool(self._hosts)

    def write(self, data: bytes) -> int:
        """Send to every host; the number of bytes that the slowest of them took."""
        least = len(data) if self._hosts else 0
        for host in list(self._hosts):
            try:
                least = min(least, host.send(data))
            except BlockingIOError:
                least = 0
            except OSError:
                self._drop_host(host)
        return least

    def read(self, timeout_s: float) -> bytes:
        deadline = time.monotonic() + timeout_s
        received = b""
        while not received and (left_s := deadline - time.monotonic()) > 0:
            for key, _ in self._selector.select(left_s):
                if key.fileobj is self._server:
                    self._accept_host()
                elif isinstance(key.fileobj, socket.socket):
                    received += self._read_from(key.fileobj)
        return received

    def close(self) -> None:
        """Hang up. May be called twice."""
        for host in list(self._hosts):
            self._drop_host(host)
        self._selector.close()
        self._server.close()

    def _accept_host(self) -> None:
        try:
            host, _ = self._server.accept()
        except OSError:
            return
        host.setblocking(False)
        self._hosts.append(host)
        self._selector.register(host, selectors.EVENT_READ)

    def _read_from(self, host: socket.socket) -> bytes:
        try:
            data = host.recv(_READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._drop_host(host)
        return data

    def _drop_host(self, host: socket.socket) -> None:
        self._hosts.remove(host)
        self._selector.unregister(host)
        host.close()


class UdpLine:
    """Sends datagrams to one address, as an autopilot does to its ground station.

    A host that writes from another address becomes the receiver. `port` is what the host has to
    listen at.
    """

    def __init__(self, to: tuple[str, int], host: str = "127.0.0.1") -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((host, 0))
        self._to = to
        self.port = f"udpin://{to[0]}:{to[1]}"

    @property
    def is_open_by_a_host(self) -> bool:
        """Nobody can know over UDP."""
        return True

    def write(self, data: bytes) -> int:
        sent = 0
        while sent < len(data):
            piece = data[sent : sent + _DATAGRAM_BYTES]
            try:
                self._socket.sendto(piece, self._to)
            except OSError:
                # An earlier datagram was refused, or the buffer is full: these are lost.
                break
            sent += len(piece)
        return sent

    def read(self, timeout_s: float) -> bytes:
        self._socket.settimeout(max(timeout_s, 1e-4))
        try:
            data, self._to = self._socket.recvfrom(_READ_BYTES)
        except OSError:
            return b""
        return data

    def close(self) -> None:
        self._socket.close()
