"""`python -m benchmarks.map_link`: the orthomosaic in flight over a thin link. Run as root.

A rendered block is flown once, and its events and tiles are recorded. They are then replayed at the
frame interval to the process of the page, behind a link of two TUN devices that passes so many
bytes a second, delays each packet and drops some. A client asks as the page does: for the tiles
newer than a version, then for these, four at a time, coarse ones first. Measured is the time from
the event of an exposure until all its tiles are at the client.
"""

from __future__ import annotations

import argparse
import ctypes
import heapq
import http.client
import json
import os
import random
import select
import signal
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.page_link import CLIENT, CLONE_NEWNET, SERVER, open_tun
from daemon.cli.benchmark.measurement import machine
from daemon.configuration.model import WatchSection
from daemon.mission.layout import Mission
from daemon.onboard.live_orthomosaic.map_layout import FOLDER, tile_file
from daemon.onboard.live_orthomosaic.mission_map import MissionMap
from daemon.onboard.service.messages import ServiceEvent
from daemon.onboard.service.processes import ChildProcess
from daemon.onboard.triangulation.mission_triangulation import MissionTriangulation
from daemon.orientation.exterior_orientation import sealed_exposures
from tests.daemon.flown_block import flown_block

PORT: Final = 8470
AT_ONCE: Final = 4
QUEUE_BYTES: Final = 100_000
"""Of a direction of the link; what comes when it is full is dropped."""
TIMEOUT_S: Final = 60.0

Recorded = list[tuple[dict[str, Any], dict[tuple[int, int, int], bytes]]]


def recorded(folder: Path, each: int, lines: int, gsd_m: float) -> Recorded:
    """Events of the map of a flown block, each with the pictures that it announces."""
    flown = flown_block(folder, each, lines)
    mission = Mission.open(flown.mission)
    done = MissionTriangulation(mission)
    found: Recorded = []

    def emit(event: dict[str, Any]) -> None:
        tiles = [(z, x, y) for z, x, y, *_ in event["tiles"]]
        pictures = {tile: tile_file(growing.folder, tile).read_bytes() for tile in tiles}
        found.append((event, pictures))

    growing = MissionMap(done, emit, gsd_m)
    read = sealed_exposures(mission).results
    for number in sorted(read):
        blocks = done.block_count
        done.add(read[number])
        if done.block_count != blocks:
            growing.block_adjusted()
    return found


def padded(events: Recorded, nbytes: int) -> Recorded:
    """The events with pictures as large as the limit of an exposure allows."""
    result: Recorded = []
    for event, pictures in events:
        share = nbytes // max(len(pictures), 1)
        larger = {tile: data.ljust(share, b"\0") for tile, data in pictures.items()}
        tiles = [[*tile[:4], len(larger[tile[0], tile[1], tile[2]])] for tile in event["tiles"]]
        result.append((event | {"tiles": tiles}, larger))
    return result


def forward(first: int, second: int, delay_s: float, loss: float, rate: float) -> None:
    """Carry packets both ways until the process is ended: at a rate, delayed, some dropped."""
    chance, waiting = random.Random(7), list[tuple[float, int, int, bytes]]()
    order, free_s = 0, {first: 0.0, second: 0.0}
    while True:
        now_s = time.monotonic()
        while waiting and waiting[0][0] <= now_s:
            _, _, target, packet = heapq.heappop(waiting)
            os.write(target, packet)
        pause_s = min(waiting[0][0] - now_s, 0.1) if waiting else 0.1
        for source in select.select([first, second], [], [], max(pause_s, 0.0))[0]:
            packet = os.read(source, 2048)
            now_s = time.monotonic()
            begins_s = max(now_s, free_s[source])
            if chance.random() < loss or (begins_s - now_s) * rate > QUEUE_BYTES:
                continue
            free_s[source] = begins_s + len(packet) / rate
            order += 1
            target = second if source == first else first
            heapq.heappush(waiting, (free_s[source] + delay_s, order, target, packet))


class Client:
    """Asks as `live_map.js` does; notes when it has each version of a tile."""

    def __init__(self) -> None:
        self.received_s: dict[tuple[int, int, int, int], float] = {}
        self.nbytes = 0
        self._version = 0
        self._own = threading.local()

    def update(self, pool: ThreadPoolExecutor) -> None:
        """One look for newer tiles."""
        found = json.loads(self._get(f"/api/v1/orthomosaic?after={self._version}"))
        if not found or found["version"] == self._version:
            return
        self._version = found["version"]
        list(pool.map(self._fetch, found["tiles"]))

    def _fetch(self, tile: list[int]) -> None:
        zoom, x, y, version, _ = tile
        self._get(f"/api/v1/orthomosaic/{zoom}/{x}/{y}")
        self.received_s[zoom, x, y, version] = time.monotonic()

    def _get(self, path: str) -> bytes:
        """The answer, over the connection of this thread."""
        for _ in range(3):
            if getattr(self._own, "connection", None) is None:
                self._own.connection = http.client.HTTPConnection(SERVER, PORT, timeout=TIMEOUT_S)
            try:
                self._own.connection.request("GET", path)
                data: bytes = self._own.connection.getresponse().read()
            except (OSError, http.client.HTTPException):
                self._own.connection.close()
                self._own.connection = None
                continue
            self.nbytes += len(data)
            return data
        raise TimeoutError(f"no answer to {path}")


def measure(
    events: Recorded, delay_s: float, loss: float, rate: float, interval_s: float
) -> dict[str, Any]:
    """Replay over the link; delays of the exposures."""
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.unshare(CLONE_NEWNET) == 0
    own = os.open("/proc/self/ns/net", os.O_RDONLY)
    client_end = open_tun("link0", CLIENT)
    assert libc.unshare(CLONE_NEWNET) == 0
    server_end = open_tun("link1", SERVER)
    mission = Path(tempfile.mkdtemp(prefix="map-link")) / "mission"
    (mission / "L0").mkdir(parents=True)
    settings = WatchSection(host=SERVER, port=PORT, announce=False)
    entry = "daemon.onboard.monitoring.monitoring_process:main"
    child = ChildProcess("watch", entry, (settings,), {})
    assert libc.setns(own, CLONE_NEWNET) == 0
    given = [str(v) for v in (client_end, server_end, delay_s, loss, rate)]
    forwarder = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.map_link", "--forward", *given],
        pass_fds=(client_end, server_end),
    )

    emitted: dict[int, tuple[float, list[list[int]]]] = {}

    def emit(event: dict[str, Any]) -> None:
        while not child.try_send(ServiceEvent(event)):
            time.sleep(0.01)

    def fly() -> None:
        next_s = time.monotonic()
        for event, pictures in events:
            if "number" in event:
                time.sleep(max(next_s - time.monotonic(), 0.0))
                next_s += interval_s
            for tile, data in pictures.items():
                path = tile_file(mission / "export" / FOLDER, tile)
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(data)
            if "number" in event:
                emitted[event["number"]] = (time.monotonic(), event["tiles"])
            emit(event)

    emit({"event": "mission", "id": "m", "path": str(mission), "rig": "r", "simulated": True,
          "resumed": False, "recovery": [], "mono_ns": "1"})  # fmt: skip
    client = Client()
    try:
        with ThreadPoolExecutor(AT_ONCE) as pool:
            _until_served(client, pool)
            begun = time.monotonic()
            flight = threading.Thread(target=fly)
            flight.start()
            while flight.is_alive() or not _has_all(client, emitted):
                if time.monotonic() > begun + len(events) * interval_s + TIMEOUT_S:
                    break
                client.update(pool)
            flight.join()
            flown_s = time.monotonic() - begun
    finally:
        forwarder.send_signal(signal.SIGKILL)
        child.end(1.0)
    delays, sizes = [], []
    for at, tiles in emitted.values():
        there = [_received(client, tile) for tile in tiles]
        delays.append(max(there, default=at) - at)
        sizes.append(sum(tile[4] for tile in tiles))
    return {
        "exposures": len(emitted),
        "delay_s": _spread(np.array(delays)),
        "bytes_of_an_exposure": _spread(np.array(sizes)),
        "kbytes": client.nbytes / 1000.0,
        "seconds": flown_s,
    }


def _until_served(client: Client, pool: ThreadPoolExecutor) -> None:
    for _ in range(30):
        try:
            client.update(pool)
        except TimeoutError:
            time.sleep(1.0)
        else:
            return
    raise TimeoutError("the page is not served")


def _received(client: Client, tile: list[int]) -> float:
    """When a tile, or a newer version of it, was there; infinite if it was not."""
    zoom, x, y, version, _ = tile
    known = [
        at for (z, c, r, v), at in list(client.received_s.items())
        if (z, c, r) == (zoom, x, y) and v >= version
    ]  # fmt: skip
    return min(known, default=float("inf"))


def _has_all(client: Client, emitted: dict[int, tuple[float, list[list[int]]]]) -> bool:
    return all(
        np.isfinite(_received(client, tile))
        for _, tiles in list(emitted.values())
        for tile in tiles
    )


def _spread(values: Any) -> dict[str, float]:
    return {
        "median": float(np.median(values)),
        "95": float(np.percentile(values, 95)),
        "max": float(values.max()),
    }


def main() -> None:
    if sys.argv[1:2] == ["--forward"]:
        first, second, delay_s, loss, rate = sys.argv[2:]
        forward(int(first), int(second), float(delay_s), float(loss), float(rate))
    parser = argparse.ArgumentParser(prog="python -m benchmarks.map_link", description=__doc__)
    parser.add_argument("--delay-ms", type=float, default=150.0, help="each way")
    parser.add_argument("--loss", type=float, default=0.05, help="each way")
    parser.add_argument("--rate", type=float, default=100_000.0, help="bytes a second, each way")
    parser.add_argument("--interval", type=float, default=1.35, help="s between exposures")
    parser.add_argument("--exposures", type=int, default=8, help="of each line")
    parser.add_argument("--lines", type=int, default=2)
    parser.add_argument("--gsd", type=float, default=0.8, help="of the map, m")
    parser.add_argument("--pad-to", type=int, default=0, help="bytes of each exposure at least")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="syntopic-bench-") as temporary:
        events = recorded(Path(temporary), given.exposures, given.lines, given.gsd)
    if given.pad_to:
        events = padded(events, given.pad_to)
    found = measure(events, given.delay_ms / 1000, given.loss, given.rate, given.interval)
    print(json.dumps({"machine": machine(), "figures": found}, indent=1))


if __name__ == "__main__":
    main()
