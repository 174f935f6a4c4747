"""Accepting connections for page and API: TLS handshakes bounded in time and number.

What is spoken inside is the business of the protocol that a connection is given to.
"""

from __future__ import annotations

import asyncio
import socket
import ssl
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import Final

HANDSHAKE_TIMEOUT_S: Final = 10.0
"""From the TCP handshake to the end of the TLS handshake; a thin link takes 2 s."""
HANDSHAKES_MAX: Final = 32
"""Begun and not finished. One more takes the place of the oldest of the address that has most."""
PAUSE_S: Final = 0.5
"""After an error of accepting, such as too many open files."""
TLS_RECORD_HANDSHAKE: Final = 0x16
"""First byte of a TLS connection, RFC 8446, section 5.1."""
PLAIN_READ_BYTES: Final = 16_384


class ConnectionListener:
    """Accepts connections and gives each to a protocol of its own.

    Args:
        listening: a listening socket.
        protocol_factory: makes the protocol of a connection.
        context: the TLS context of the next connection; None where TLS is not used at all.
    """

    def __init__(
        self,
        listening: socket.socket,
        protocol_factory: Callable[[], asyncio.Protocol],
        context: Callable[[], ssl.SSLContext] | None,
    ) -> None:
        self._listening = listening
        self._protocol_factory = protocol_factory
        self._context = context
        self._handshakes: dict[asyncio.Task[None], str] = {}
        listening.setblocking(False)
        self._accepting = asyncio.create_task(self._accept())

    def close(self) -> None:
        """Accept no more, and end handshakes."""
        for task in (self._accepting, *self._handshakes):
            task.cancel()
        self._listening.close()

    async def _accept(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                connection, address = await loop.sock_accept(self._listening)
            except ConnectionError:
                continue  # it is gone already, or was refused
            except OSError:
                await asyncio.sleep(PAUSE_S)
                continue
            if len(self._handshakes) >= HANDSHAKES_MAX:
                self._cancel_one_handshake()
            task = asyncio.create_task(self._admit(connection))
            self._handshakes[task] = str(address[0])
            task.add_done_callback(self._forget)
            # Many that wait are accepted without a pause: each one's task runs before the next,
            # or those that need no handshake would be counted as unfinished.
            await asyncio.sleep(0)

    def _forget(self, task: asyncio.Task[None]) -> None:
        self._handshakes.pop(task, None)

    def _cancel_one_handshake(self) -> None:
        count = Counter(self._handshakes.values())
        _, busiest = max((count[address], address) for address in count)
        oldest = next(task for task, address in self._handshakes.items() if address == busiest)
        oldest.cancel()
        self._forget(oldest)

    async def _admit(self, connection: socket.socket) -> None:
        try:
            async with asyncio.timeout(HANDSHAKE_TIMEOUT_S):
                await self._hand_over(connection)
        except (OSError, TimeoutError):
            connection.close()  # it stalled, disconnected, or supports no common TLS version
        except asyncio.CancelledError:
            connection.close()
            raise

    async def _hand_over(self, connection: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        context = None
        if self._context is not None:
            await _readable(connection)
            first = connection.recv(1, socket.MSG_PEEK)
            if first != bytes([TLS_RECORD_HANDSHAKE]):
                await _reject_plain_http(connection)
                return
            context = self._context()
        await loop.connect_accepted_socket(
            self._protocol_factory,
            connection,
            ssl=context,
            ssl_handshake_timeout=HANDSHAKE_TIMEOUT_S if context else None,
            ssl_shutdown_timeout=1.0 if context else None,
        )


async def _readable(connection: socket.socket) -> None:
    loop = asyncio.get_running_loop()
    is_readable = loop.create_future()

    def note() -> None:
        if not is_readable.done():
            is_readable.set_result(None)

    loop.add_reader(connection, note)
    try:
        await is_readable
    finally:
        loop.remove_reader(connection)


async def _reject_plain_http(connection: socket.socket) -> None:
    """Answer a client without TLS with the https address, and close.

    Nothing of the request is repeated in the answer.
    """
    loop = asyncio.get_running_loop()
    host, port = connection.getsockname()[:2]
    address = f"[{host}]" if ":" in host else host
    text = f"This port requires TLS: use https://{address}:{port}/\n".encode()
    head = (
        "HTTP/1.1 400 Bad Request\r\nContent-Type: text/plain; charset=utf-8\r\n"
        f"Content-Length: {len(text)}\r\nConnection: close\r\nX-Content-Type-Options: nosniff\r\n"
        "\r\n"
    )
    await loop.sock_recv(connection, PLAIN_READ_BYTES)
    await loop.sock_sendall(connection, head.encode() + text)
    with suppress(OSError):
        connection.shutdown(socket.SHUT_WR)
        # Closed with unread bytes, the kernel would take the answer back.
        await loop.sock_recv(connection, PLAIN_READ_BYTES)
    connection.close()
