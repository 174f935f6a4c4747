"""The operator's page over a thin link: delays of verdict, thumbnail and coverage, rate, bytes.

Two TUN devices in two network namespaces are joined by a forwarder that delays each packet and
drops some. The page's process is behind one, Chromium before the other. Run as root: `python -m
benchmarks.page_link`. With `--bulk-s` it times one TCP stream over the same link instead.
"""

from __future__ import annotations

import argparse
import ctypes
import fcntl
import heapq
import importlib
import json
import os
import random
import select
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, Final

TUNSETIFF: Final = 0x400454CA
IFF_TUN_NO_PI: Final = 0x1001
CLONE_NEWNET: Final = 0x40000000
SERVER, CLIENT = "10.9.0.1", "10.9.0.2"
INTERVAL_S: Final = 2.0
GUIDANCE_S: Final = 0.2
BULK_PORT: Final = 8471
CONGESTION: Final = Path("/proc/sys/net/ipv4/tcp_congestion_control")
"""Of the present network namespace; it decides what a lossy link carries."""
LOAD_TIMEOUT_S: Final = 180.0
QUEUE_MAX: Final = 2000
PROBE: Final = """
window.log = { verdict: {}, thumbnail: {}, coverage: [], guidance: [] };
const Plain = window.WebSocket;
window.WebSocket = class extends Plain {
  constructor(...given) {
    super(...given);
    if (String(given[0]).includes('/guidance')) this.addEventListener('message', (message) => {
      const frame = JSON.parse(message.data);
      window.log.guidance.push([Date.now() / 1000, frame.age_s, frame.rtt_s]);
    });
  }
};
setInterval(() => {
  const now = Date.now() / 1000;
  const number = document.querySelector('#verdict .which')?.textContent.match(/\\d+/)?.[0];
  if (number && !(number in window.log.verdict)) window.log.verdict[number] = now;
  for (const one of document.querySelectorAll('#strip .thumb')) {
    const name = one.querySelector('.t-mark')?.textContent.match(/\\d+/)?.[0];
    const isSeen = one.querySelector('img')?.naturalWidth > 0;
    if (name && isSeen && !(name in window.log.thumbnail)) window.log.thumbnail[name] = now;
  }
  const text = document.querySelector('#coverage')?.textContent;
  if (text && window.log.coverage.at(-1)?.[1] !== text) window.log.coverage.push([now, text]);
}, 25);
"""


def open_tun(name: str, address: str) -> int:
    """A TUN device in the present network namespace."""
    descriptor = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(descriptor, TUNSETIFF, struct.pack("16sH", name.encode(), IFF_TUN_NO_PI))
    for command in (
        f"ip addr add {address}/24 dev {name}",
        f"ip link set {name} up mtu 1500",
        "ip link set lo up",
    ):
        subprocess.run(command.split(), check=True)
    return descriptor


def forward(first: int, second: int, delay_s: float, loss: float, counts: str) -> None:
    """Carry packets both ways, each delayed, some dropped, until the process is ended."""
    chance, waiting = random.Random(7), list[tuple[float, int, int, bytes]]()
    order, carried, saved_s = 0, {first: [0, 0], second: [0, 0]}, 0.0
    while True:
        now_s = time.monotonic()
        while waiting and waiting[0][0] <= now_s:
            _, _, target, packet = heapq.heappop(waiting)
            os.write(target, packet)
        if now_s - saved_s > 0.5:
            saved_s = now_s
            written = Path(f"{counts}.part")
            written.write_text(json.dumps([carried[first], carried[second]]))
            written.replace(counts)
        pause_s = min(waiting[0][0] - now_s, 0.2) if waiting else 0.2
        for source in select.select([first, second], [], [], max(pause_s, 0.0))[0]:
            packet = os.read(source, 2048)
            carried[source][0] += len(packet)
            carried[source][1] += 1
            if chance.random() >= loss and len(waiting) < QUEUE_MAX:
                order += 1
                target = second if source == first else first
                heapq.heappush(waiting, (time.monotonic() + delay_s, order, target, packet))


def join(congestion: str) -> tuple[int, int, int]:
    """Make the namespace of the client, then that of the server, in which the process is then.

    Args:
        congestion: TCP congestion control of both; empty leaves that of the system.

    Returns:
        Descriptors of the client's namespace and of both TUN devices, client and server.
    """
    libc, devices, spaces = ctypes.CDLL(None, use_errno=True), [], []
    for name, address in (("link0", CLIENT), ("link1", SERVER)):
        assert libc.unshare(CLONE_NEWNET) == 0
        spaces.append(os.open("/proc/self/ns/net", os.O_RDONLY))
        devices.append(open_tun(name, address))
        if congestion:
            CONGESTION.write_text(congestion)
    return spaces[0], devices[0], devices[1]


def enter(space: int) -> None:
    """Make a network namespace that of this process."""
    assert ctypes.CDLL(None, use_errno=True).setns(space, CLONE_NEWNET) == 0


def start_forwarder(
    client: int, server: int, delay_s: float, loss: float, counts: Path
) -> subprocess.Popen[bytes]:
    """A process that carries the packets of the link."""
    arguments = [str(client), str(server), str(delay_s), str(loss), str(counts)]
    return subprocess.Popen(
        [sys.executable, "-m", "benchmarks.page_link", "--forward", *arguments],
        pass_fds=(client, server),
    )


def bulk_rate(delay_s: float, loss: float, bulk_s: float, congestion: str) -> dict[str, Any]:
    """Rate of one TCP stream from the server to the client."""
    space, client, server = join(congestion)
    listening = socket.create_server((SERVER, BULK_PORT))
    enter(space)
    folder = Path(tempfile.mkdtemp(prefix="page-link"))
    forwarder = start_forwarder(client, server, delay_s, loss, folder / "counts.json")
    used: list[str] = []

    def send() -> None:
        stream, _ = listening.accept()
        name = stream.getsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, 16)
        used.append(name.rstrip(b"\0").decode())
        with stream:
            while True:
                try:
                    stream.sendall(bytes(65536))
                except OSError:
                    return

    threading.Thread(target=send, daemon=True).start()
    try:
        with socket.create_connection((SERVER, BULK_PORT), timeout=60.0) as stream:
            received, begin_s = 0, time.monotonic()
            while time.monotonic() - begin_s < bulk_s:
                received += len(stream.recv(65536))
            elapsed_s = time.monotonic() - begin_s
    finally:
        forwarder.kill()
        shutil.rmtree(folder, ignore_errors=True)
    rate = round(received / elapsed_s / 1000, 1)
    return {"congestion_control": used[0], "seconds": round(elapsed_s, 1), "kbytes_per_s": rate}


def quantile(values: list[float], share: float) -> float | None:
    """A quantile of the values, s; None without any."""
    ordered = sorted(values)
    return round(ordered[min(len(ordered) - 1, int(share * len(ordered)))], 2) if ordered else None


def measure(
    delay_s: float, loss: float, exposures: int, before: int, congestion: str
) -> dict[str, Any]:
    """Fly over the link and read what the page noted; it is opened after `before` exposures."""
    from daemon.configuration.model import WatchSection
    from daemon.onboard.service.messages import ServiceEvent
    from daemon.onboard.service.processes import ChildProcess

    # The types of tests are checked on their own.
    browser_of = importlib.import_module("tests.support.browser").Browser
    flight_events = importlib.import_module("tests.daemon.onboard.monitoring.flight_events")
    scene = importlib.import_module("tests.daemon.onboard.monitoring.test_page_guidance")
    space, client, server = join(congestion)
    folder = Path(tempfile.mkdtemp(prefix="page-link"))
    mission = folder / "mission"
    (mission / "L0").mkdir(parents=True)
    scene.write_products(mission)
    for number in range(max(7, before - 40), before + exposures + 1):
        copied, ignored = mission / f"L2/{number:06d}", shutil.ignore_patterns("pan.tif")
        shutil.copytree(mission / "L2/000001", copied, ignore=ignored)
    rig = scene.shipped_rigs()["ultracam-x-mini"].read_bytes()
    (mission / "rig.toml").write_bytes(rig)
    line = {"type": "LineString", "coordinates": [[15.43, 47.07], [15.43, 47.12]]}
    feature = {"type": "Feature", "properties": {"id": "A1", "strip": "S"}, "geometry": line}
    plan = {"type": "FeatureCollection", "features": [feature]}
    (mission / "plan.geojson").write_text(json.dumps(plan))
    (mission / "service.toml").write_text("[plan]\nground_height_m = 395.0\n")
    settings = WatchSection(host=SERVER, port=8470, announce=False)
    entry = "daemon.onboard.monitoring.monitoring_process:main"
    child = ChildProcess("watch", entry, (settings,), {})
    enter(space)
    counts = folder / "counts.json"
    forwarder = start_forwarder(client, server, delay_s, loss, counts)
    used = CONGESTION.read_text().strip()

    def emit(event: dict[str, Any]) -> None:
        while not child.try_send(ServiceEvent(event)):
            time.sleep(0.01)

    emit(flight_events.mission(str(mission)))
    for number in range(1, before + 1):
        for event in flight_events.exposure(number, line="A0", north_m=-60.0 * (number % 500 + 1)):
            emit(event)
    emit(scene.status(before))
    time.sleep(3.0)
    emitted = dict[int, float]()
    try:
        with browser_of(folder / "profile") as browser:
            browser.call("Page.addScriptToEvaluateOnNewDocument", source=PROBE)
            began_s = time.time()
            browser.open(f"http://{SERVER}:8470/")
            connected = "document.body?.dataset.ready !== undefined && "
            connected += "document.querySelector('#link')?.className.includes('good')"
            browser.wait_for(connected, LOAD_TIMEOUT_S)
            loaded_s = time.time() - began_s
            time.sleep(5.0)
            begin, begin_s = json.loads(counts.read_text()), time.time()
            for number in range(before + 1, before + exposures + 1):
                emitted[number] = time.time()
                for event in flight_events.exposure(
                    number, line="A1", north_m=68.0 * (number - before)
                ):
                    emit(event)
                emit(scene.status(number))
                until_s = emitted[number] + INTERVAL_S
                while time.time() < until_s:
                    emit(scene.frame(0.3 + 0.01 * (number % 50)))
                    time.sleep(GUIDANCE_S)
            flown_s = time.time() - begin_s
            end = json.loads(counts.read_text())
            time.sleep(8.0)
            log = browser.evaluate("window.log")
            footprints = browser.evaluate("import('/map.js').then((map) => map.footprintCount())")
    finally:
        forwarder.kill()
        child.end(1.0)

    def delays(part: str) -> list[float]:
        return [log[part][str(k)] - s for k, s in emitted.items() if str(k) in log[part]]

    changes = [at for at, _ in log["coverage"]]
    coverage = [min((c for c in changes if c > s), default=s + 99.0) - s for s in emitted.values()]
    frames = [one for one in log["guidance"] if begin_s <= one[0] <= begin_s + flown_s]
    ages = [age + (rtt or 0.0) / 2 for _, age, rtt in frames]
    result: dict[str, Any] = {"congestion_control": used, "exposures": exposures}
    result["page_loaded_s"] = round(loaded_s, 1)
    if before:
        result["before"] = {"exposures": before, "footprints": footprints}
    for part, values in (("verdict", delays("verdict")), ("thumbnail", delays("thumbnail")),
                         ("coverage", coverage)):  # fmt: skip
        result[part] = {
            "count": len(values),
            "median_s": quantile(values, 0.5),
            "p95_s": quantile(values, 0.95),
        }
    result["guidance"] = {
        "hz": round(len(frames) / flown_s, 2),
        "age_median_s": quantile(ages, 0.5),
        "age_p95_s": quantile(ages, 0.95),
    }
    down, up = end[1][0] - begin[1][0], end[0][0] - begin[0][0]
    result["kbytes_per_min"] = {
        "down": round(down / flown_s * 60 / 1000, 1),
        "up": round(up / flown_s * 60 / 1000, 1),
    }
    return result


def main() -> int:
    """Measure and print JSON."""
    if sys.argv[1:2] == ["--forward"]:
        first, second, delay_s, loss, counts = sys.argv[2:]
        forward(int(first), int(second), float(delay_s), float(loss), counts)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--delay-ms", type=float, default=150.0, help="each way (default: 150)")
    parser.add_argument("--loss", type=float, default=0.05, help="each way (default: 0.05)")
    parser.add_argument("--exposures", type=int, default=30, help="one every 2 s (default: 30)")
    parser.add_argument(
        "--before", type=int, default=0, help="exposures before the page is opened (default: 0)"
    )
    parser.add_argument(
        "--congestion", default="", help="TCP congestion control (default: the system's)"
    )
    parser.add_argument("--bulk-s", type=float, help="time one TCP stream for so many seconds")
    given = parser.parse_args()
    link = given.delay_ms / 1000, given.loss
    if given.bulk_s:
        found = bulk_rate(*link, given.bulk_s, given.congestion)
    else:
        found = measure(*link, given.exposures, given.before, given.congestion)
    print(json.dumps(found, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
