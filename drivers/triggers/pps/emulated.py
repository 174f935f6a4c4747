"""An emulated PPS source behind a TCP port, with the interface of the kernel's source.

Each line is an edge: `<assert sequence> <nanoseconds of CLOCK_REALTIME>`.
"""

from __future__ import annotations

import socket
import time
from typing import Final

from drivers.triggers.pps.binding import CAN_WAIT, CAPTURE_ASSERT, Edges

SCHEME: Final = "tcp://"
CONNECT_TIMEOUT_S: Final = 2.0
LINE_MAX_BYTES: Final = 64


class EmulatedPps:
    """The client of an emulated source. OSError if it does not exist or is lost."""

    def __init__(self, address: str) -> None:
        host, _, port = address.removeprefix(SCHEME).rpartition(":")
        if not port.isdecimal():
            raise OSError(f"{address!r} names no port; write tcp://host:port")
        self._socket = socket.create_connection((host, int(port)), timeout=CONNECT_TIMEOUT_S)
        self._received = b""

    def capabilities(self) -> int:
        """What the source can do.

        Returns:
            It captures assert edges, and a wait for them is possible.
        """
        return CAPTURE_ASSERT | CAN_WAIT

    def mode(self) -> int:
        """The edges that are captured at present.

        Returns:
            Assert edges, always.
        """
        return CAPTURE_ASSERT

    def set_mode(self, mode: int) -> None:
        """No effect: the source captures all its edges.

        Args:
            mode: not used.
        """

    def fetch(self, timeout_s: float) -> Edges | None:
        """The next edge, as from the kernel. Invalid lines are skipped.

        Args:
            timeout_s: longest wait, s.

        Returns:
            The edge as assert edge; None if none is received in time.

        Raises:
            OSError: the source closed the connection.
        """
        deadline = time.monotonic() + timeout_s
        while (left_s := deadline - time.monotonic()) > 0:
            line, separator, rest = self._received.partition(b"\n")
            if separator:
                self._received = rest
                fields = line.split()
                if len(fields) == 2 and all(
                    field.isdigit() and len(field) < 20 for field in fields
                ):
                    return Edges(int(fields[0]), 0, int(fields[1]), 0)
                continue
            self._socket.settimeout(left_s)
            try:
                piece = self._socket.recv(4096)
            except TimeoutError:
                return None
            if not piece:
                raise OSError("the source closed the connection")
            self._received = (self._received + piece)[-4096:]
        return None

    def latest(self) -> Edges | None:
        """Nothing: edges are buffered until they are fetched.

        Returns:
            None.
        """
        return None

    def is_there(self) -> bool:
        """Whether the source exists; `fetch` raises if it closed the connection.

        Returns:
            True.
        """
        return True

    def close(self) -> None:
        """End the connection."""
        self._socket.close()
