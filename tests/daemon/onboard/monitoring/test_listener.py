"""A client that stalls a TLS handshake, or uses no TLS, blocks no other client."""

from __future__ import annotations

import asyncio
import socket
import ssl
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from daemon.onboard.monitoring.access.certificate_authority import issue_certificate
from daemon.onboard.monitoring.access.certificates import server_context
from daemon.onboard.monitoring.web import listener as listener_module
from daemon.onboard.monitoring.web.listener import HANDSHAKES_MAX, ConnectionListener

pytestmark = pytest.mark.trust
WITHIN_S = 30.0


class Echo(asyncio.Protocol):
    """Sends back what it receives."""

    made = 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        Echo.made += 1
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        assert isinstance(self._transport, asyncio.Transport)
        self._transport.write(data)


@pytest.fixture(scope="module")
def tls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tls")
    issue_certificate(folder)
    return folder


@asynccontextmanager
async def listening(tls: Path) -> AsyncIterator[tuple[ConnectionListener, int]]:
    context = server_context(tls / "server.pem", tls / "server.key")
    plain = socket.create_server(("127.0.0.1", 0), backlog=256)
    port = plain.getsockname()[1]
    listener = ConnectionListener(plain, Echo, lambda: context)
    try:
        async with asyncio.timeout(WITHIN_S):
            yield listener, port
    finally:
        listener.close()


async def is_served(port: int, tls: Path) -> bool:
    client = ssl.create_default_context(cafile=str(tls / "authority.pem"))
    reader, writer = await asyncio.open_connection("127.0.0.1", port, ssl=client)
    writer.write(b"hello")
    answer = await reader.readexactly(5)
    writer.close()
    return answer == b"hello"


@pytest.mark.parametrize("sent", [b"", b"\x16", b"\x16\x03\x01\x02\x00\x01"])
def test_stalled_handshakes_are_bounded_and_others_are_served(tls: Path, sent: bytes) -> None:
    async def attack() -> None:
        async with listening(tls) as (listener, port):
            stalled = [await asyncio.open_connection("127.0.0.1", port) for _ in range(200)]
            for _, writer in stalled:
                writer.write(sent)
            begun = time.monotonic()
            assert await is_served(port, tls)
            assert len(listener._handshakes) <= HANDSHAKES_MAX
            print(f"served after {time.monotonic() - begun:.3f} s")
            # The others were closed: 200 less those that are still allowed.
            ended = [reader for reader, _ in stalled[: 200 - HANDSHAKES_MAX]]
            assert await asyncio.gather(*(_until_end(reader) for reader in ended))

    asyncio.run(attack())


async def _until_end(reader: asyncio.StreamReader) -> bool:
    try:
        return await reader.read() == b""
    except ConnectionError:
        return True


@pytest.mark.parametrize("sent", [b"", b"\x16\x03\x01\x02\x00\x01"])
def test_a_handshake_has_its_time(tls: Path, sent: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listener_module, "HANDSHAKE_TIMEOUT_S", 0.2)

    async def stall() -> None:
        async with listening(tls) as (listener, port):
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(sent)
            assert await _until_end(reader)
            while listener._handshakes:
                await asyncio.wait(list(listener._handshakes))

    asyncio.run(stall())


def test_plain_http_is_answered_with_where_to_go(tls: Path) -> None:
    async def request() -> bytes:
        async with listening(tls) as (_, port):
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(b"GET /<script>?token=syn_secret HTTP/1.1\r\nHost: evil.example\r\n\r\n")
            answer = await reader.read()
            writer.close()
            assert f"use https://127.0.0.1:{port}/".encode() in answer
            return answer

    made = Echo.made
    answer = asyncio.run(request())
    assert answer.startswith(b"HTTP/1.1 400 ")
    assert b"evil" not in answer and b"script" not in answer and b"secret" not in answer
    assert Echo.made == made, "the application receives nothing"


def test_noise_instead_of_tls_is_closed(tls: Path) -> None:
    async def attack() -> None:
        async with listening(tls) as (_, port):
            for sent in (b"\x16" + bytes(range(256)) * 8, b"\x16\x03\x01\xff\xff" + b"x" * 70_000):
                reader, writer = await asyncio.open_connection("127.0.0.1", port)
                writer.write(sent)
                writer.write_eof()
                await _drained(reader)
                writer.close()
            assert await is_served(port, tls)

    asyncio.run(attack())


async def _drained(reader: asyncio.StreamReader) -> None:
    try:
        while await reader.read(4096):
            pass
    except ConnectionError:
        pass


def test_many_that_connect_at_once_without_tls_are_all_served() -> None:
    """A ground station that starts again: all its pages connect before the first is accepted."""
    count = 2 * HANDSHAKES_MAX

    async def meet() -> list[bytes]:
        plain = socket.create_server(("127.0.0.1", 0), backlog=256)
        waiting = [socket.create_connection(plain.getsockname()) for _ in range(count)]
        listener = ConnectionListener(plain, Echo, None)
        try:
            async with asyncio.timeout(WITHIN_S):
                links = [await asyncio.open_connection(sock=one) for one in waiting]
                for _, writer in links:
                    writer.write(b"here")
                received = [await reader.read(4) for reader, _ in links]
            for _, writer in links:
                writer.close()
            return received
        finally:
            listener.close()

    assert asyncio.run(meet()) == [b"here"] * count
