"""The connection between the service and the page's process: packets, never pickled objects.

Unknown senders can reach the page's process, so the service trusts nothing it sends. The kernel
preserves packet boundaries (SOCK_SEQPACKET, unix(7)): a packet that is invalid, truncated or too
large is dropped, and the next one is read. The service never waits for the page's process.
"""

from __future__ import annotations

import errno
import select
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

from daemon.onboard.service.messages import InvalidMessages, ServiceEvent
from daemon.onboard.service.page_messages import (
    FROM_PAGE_MAX_BYTES,
    TO_PAGE_MAX_BYTES,
    InvalidMessageError,
    pack_from_page,
    pack_to_page,
    unpack_from_page,
    unpack_to_page,
)
from daemon.onboard.service.processes import ChildProcess, ServiceDisconnectedError

MESSAGES_PER_TURN = 20
"""Messages received before the other processes have their turn."""
BURST, RATE_PER_S = 200.0, 50.0
"""Limits for messages of the page's process; more wait in the socket, then in that process."""
REPORT_EVERY_S = 10.0
"""Invalid messages are reported in one event."""


class PacketReader:
    """Packets of one end of the connection, and how many of them were no message.

    Args:
        limit_bytes: size of the largest message in bytes.
    """

    def __init__(self, connection: socket.socket, limit_bytes: int) -> None:
        self._connection = connection
        self._limit_bytes = limit_bytes
        self.invalid = 0
        self._unreported = 0
        self._problem = ""
        self._reported_s = -REPORT_EVERY_S

    def packet(self) -> bytes | None:
        """The next packet; None where none is there, empty where it was too large.

        File descriptors that came with it are closed by the kernel.

        Raises:
            EOFError: the other end is closed.
        """
        try:
            data, _, flags, _ = self._connection.recvmsg(self._limit_bytes, 0, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return None
        if not data:
            raise EOFError
        if flags & socket.MSG_TRUNC:
            self.count(f"more than {self._limit_bytes} bytes")
            return b""
        return data

    def count(self, problem: str) -> None:
        """A packet was no message."""
        self.invalid += 1
        self._unreported += 1
        self._problem = problem

    def report(self) -> tuple[int, str] | None:
        """How many since the last report, and what is wrong; None where it is not due."""
        now_s = time.monotonic()
        if not self._unreported or now_s - self._reported_s < REPORT_EVERY_S:
            return None
        count, self._unreported, self._reported_s = self._unreported, 0, now_s
        return count, self._problem


class PageConnection:
    """The end of the page's process; `send` may be called from any thread.

    Both ways raise ServiceDisconnectedError once the service is gone.
    """

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._received = PacketReader(connection, TO_PAGE_MAX_BYTES)
        self._lock = threading.Lock()

    def send(self, message: object) -> None:
        data = pack_from_page(message)
        try:
            with self._lock:
                self._connection.send(data)
        except OSError as error:
            raise ServiceDisconnectedError(str(error)) from error

    def fileno(self) -> int:
        """What an event loop waits on."""
        return self._connection.fileno()

    def receive(self, timeout_s: float) -> Any | None:
        """The next message, or None when none came in time. What is none is dropped."""
        ends_s = time.monotonic() + timeout_s
        try:
            while True:
                data = self._received.packet()
                if data is None:
                    left_s = ends_s - time.monotonic()
                    if left_s <= 0 or not select.select([self._connection], [], [], left_s)[0]:
                        return None
                elif data:
                    try:
                        return unpack_to_page(data)
                    except InvalidMessageError as error:
                        self._received.count(str(error))
                if (report := self._received.report()) is not None:
                    sentence = (
                        f"{report[0]} messages of the service to the page's process were invalid "
                        f"({report[1]}) and dropped; they may be missing on the page. Report this"
                    )
                    self.send(
                        ServiceEvent({"event": "page-link", "fault": True, "sentence": sentence})
                    )
        except (EOFError, OSError) as error:
            raise ServiceDisconnectedError(str(error)) from error


class PageProcess(ChildProcess):
    """The service's end."""

    link = PageConnection

    def _ends(self) -> tuple[socket.socket, socket.socket]:
        ours, child_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._received = PacketReader(ours, FROM_PAGE_MAX_BYTES)
        self._allowance, self._allowed_s = BURST, time.monotonic()
        return ours, child_end

    @property
    def invalid(self) -> int:
        """How many packets were no message."""
        return self._received.invalid

    def receive(self) -> Iterator[object]:
        """Some messages that have come; `pause_s` is the wait before the next call.

        Raises:
            EOFError, ConnectionError: the process is gone.
        """
        now_s = time.monotonic()
        self._allowance += (now_s - self._allowed_s) * RATE_PER_S
        self._allowance, self._allowed_s = min(self._allowance, BURST), now_s
        for _ in range(MESSAGES_PER_TURN):
            self.pause_s = max(0.0, (1.0 - self._allowance) / RATE_PER_S)
            if self.pause_s:
                break
            data = self._received.packet()
            if data is None:
                break
            self._allowance -= 1.0
            if not data:
                continue
            try:
                yield unpack_from_page(data)
            except InvalidMessageError as error:
                self._received.count(str(error))
        if (report := self._received.report()) is not None:
            yield InvalidMessages(*report)

    def send(self, message: object) -> None:
        """As `try_send`; a message that does not fit is dropped."""
        self.try_send(message)

    def try_send(self, message: object) -> bool:
        """Send only if that does not wait; False where it was not sent.

        Raises:
            ValueError: a message that can never be sent.
            OSError: the process is gone.
        """
        try:
            data = pack_to_page(message)
        except TypeError as error:
            raise ValueError(str(error)) from error
        try:
            self.connection.send(data, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return False
        except OSError as error:
            if error.errno == errno.EMSGSIZE:
                raise ValueError(f"a message of {len(data)} bytes") from error
            raise
        return True
