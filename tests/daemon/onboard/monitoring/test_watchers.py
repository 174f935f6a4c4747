"""Fifty clients, ten of them stalled: the others receive everything, and memory is constant."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from daemon.configuration.model import WatchSection
from daemon.onboard.monitoring.monitoring_process import PING_S, PONG_TIMEOUT_S
from daemon.onboard.service.messages import ServiceEvent, Stop
from daemon.onboard.service.processes import ChildProcess
from tests.daemon.onboard.monitoring import flight_events

pytestmark = pytest.mark.realtime


WATCHERS, STALLED, EXPOSURES = 50, 10, 60
GROWTH_MAX_KB = 60_000
LET_GO_WITHIN_S = PING_S + PONG_TIMEOUT_S + 2.0


@pytest.fixture
def watch(tmp_path: Path) -> Iterator[tuple[ChildProcess, int]]:
    (tmp_path / "L0").mkdir()
    child = ChildProcess(
        "watch",
        "daemon.onboard.monitoring.monitoring_process:main",
        (WatchSection(port=0, announce=False),),
        {},
    )
    assert child.connection.poll(60)
    port = child.connection.recv().event["port"]
    yield child, port
    child.send(Stop())
    child.end(10.0)


def resident_kb(pid: int) -> int:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1])
    return 0


async def follow(port: int, until: int) -> set[int]:
    """Numbers of the exposures whose verdict this client received."""
    from websockets.asyncio.client import connect

    seen: set[int] = set()
    address = f"ws://127.0.0.1:{port}/api/v1/telemetry?form=json"
    async with connect(address, max_size=None, open_timeout=90) as link:
        while len(seen) < until:
            record = json.loads(await asyncio.wait_for(link.recv(), 90))
            seen |= {one["number"] for one in record.get("exposures", []) if "verdict" in one}
    return seen


async def stall(port: int, release: asyncio.Event) -> None:
    """Connect, and take nothing; in the end find oneself let go."""
    narrow = socket.socket()
    narrow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    narrow.connect(("127.0.0.1", port))
    connected_s = time.monotonic()
    reader, writer = await asyncio.open_connection(sock=narrow, limit=1024)
    writer.write(
        b"GET /api/v1/telemetry?form=json HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\n"
        b"Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        b"Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n"
    )
    await release.wait()
    await asyncio.sleep(max(0.0, connected_s + LET_GO_WITHIN_S - time.monotonic()))
    # Pending records arrive, then the end; an open link would receive one every second.
    with suppress(ConnectionError):
        async with asyncio.timeout(PING_S):
            while await reader.read(65536):
                pass
    writer.close()


def test_stalled_clients_do_not_delay_the_others(watch: tuple[ChildProcess, int]) -> None:
    child, port = watch
    assert child.try_send(ServiceEvent(flight_events.mission()))
    before_kb = resident_kb(child.process.pid or 0)
    dropped = 0

    def fly() -> None:
        nonlocal dropped
        for number in range(1, EXPOSURES + 1):
            for event in (*flight_events.exposure(number), flight_events.status(triggers=number)):
                while not child.try_send(ServiceEvent(event)):
                    dropped += 1
                    time.sleep(0.02)
            time.sleep(0.05)

    async def look() -> list[set[int]]:
        release = asyncio.Event()
        stalled = [asyncio.create_task(stall(port, release)) for _ in range(STALLED)]
        following = [follow(port, EXPOSURES) for _ in range(WATCHERS - STALLED)]
        flying = threading.Thread(target=fly)
        flying.start()
        seen = await asyncio.gather(*following)
        flying.join()
        release.set()
        await asyncio.gather(*stalled)
        return seen

    for seen in asyncio.run(look()):
        assert seen == set(range(1, EXPOSURES + 1))
    assert resident_kb(child.process.pid or 0) - before_kb < GROWTH_MAX_KB


def test_clients_are_served_until_the_service_stops_whichever_process_is_signalled(
    watch: tuple[ChildProcess, int],
) -> None:
    """Ctrl-C and systemd signal the whole group; the service has exposures to seal."""
    child, port = watch

    async def look() -> set[int]:
        following = asyncio.create_task(follow(port, 20))
        for number in range(1, 21):
            for event in flight_events.exposure(number):
                assert child.try_send(ServiceEvent(event))
            await asyncio.sleep(0.05)
            if number == 5:
                os.kill(child.process.pid or 0, signal.SIGTERM)
                os.kill(child.process.pid or 0, signal.SIGINT)
        return await following

    assert asyncio.run(look()) == set(range(1, 21))
