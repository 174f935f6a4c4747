"""An emulated pulse per second: the edges a kernel would stamp, on a TCP port.

Each line is an edge, `<sequence> <nanoseconds of CLOCK_REALTIME>`, sent when a whole second of GPS
time has passed; the stamp is late by the interrupt's latency, as the kernel's is.
"""

from __future__ import annotations

import random
import socket
import threading
import time
from collections import Counter
from collections.abc import Mapping

from sim_hw.world.world_clock import NS_PER_S, WorldClock

_ACCEPT_S = 0.2


class PpsSource:
    """The source, from `start()` to `close()`; one host at a time.

    Latencies are gamma distributed about `latency_ns`, with now and then one of an interrupt that
    had to wait. `silence()` and `speak()` are the cable pulled and back.
    """

    def __init__(
        self,
        clock: WorldClock,
        *,
        latency_ns: float = 3_000.0,
        rare_ns: float = 40_000.0,
        seed: int = 0,
    ) -> None:
        self._clock = clock
        self._latency_ns, self._rare_ns = latency_ns, rare_ns
        self._random = random.Random(seed)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.settimeout(_ACCEPT_S)
        self._host: socket.socket | None = None
        self._stop = threading.Event()
        self._silent = threading.Event()
        self._threads = [
            threading.Thread(target=self._accept, name="pps-accept", daemon=True),
            threading.Thread(target=self._run, name="pps", daemon=True),
        ]
        self._counts: Counter[str] = Counter()

    @property
    def device(self) -> str:
        """What a host gives as its device."""
        return f"tcp://127.0.0.1:{self._listener.getsockname()[1]}"

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def suspend(self) -> None:
        self._silent.set()

    def resume(self) -> None:
        self._silent.clear()

    def close(self) -> None:
        """Stop and hang up. May be called twice."""
        self._stop.set()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(timeout=5.0)
        self._listener.close()
        if self._host is not None:
            self._host.close()

    def statistics(self) -> Mapping[str, int]:
        """edges, sent."""
        return {name: self._counts[name] for name in ("edges", "sent")}

    def _accept(self) -> None:
        while not self._stop.is_set():
            try:
                host, _ = self._listener.accept()
            except TimeoutError:
                continue
            except OSError:
                return
            old, self._host = self._host, host
            if old is not None:
                old.close()

    def _run(self) -> None:
        second = self._clock.gps_ns(time.monotonic_ns()) // NS_PER_S + 1
        while True:
            edge_mono_ns = self._clock.mono_ns(second * NS_PER_S)
            wait_ns = edge_mono_ns - time.monotonic_ns()
            if self._stop.wait(max(0.0, wait_ns / NS_PER_S)):
                return
            self._counts["edges"] += 1
            if not self._silent.is_set():
                self._send_edge(edge_mono_ns)
            second += 1

    def _send_edge(self, edge_mono_ns: int) -> None:
        late_ns = self._random.gammavariate(2.0, self._latency_ns / 2)
        if self._random.random() < 0.01:
            late_ns += self._random.expovariate(1.0 / self._rare_ns)
        real_ns = edge_mono_ns + round(late_ns) + _real_less_mono_ns()
        host = self._host
        if host is None:
            return
        try:
            host.sendall(f"{self._counts['edges']} {real_ns}\n".encode("ascii"))
            self._counts["sent"] += 1
        except OSError:
            self._host = None


def _real_less_mono_ns() -> int:
    """CLOCK_REALTIME less CLOCK_MONOTONIC, from the tightest of some readings."""
    best_ns, offset_ns = NS_PER_S, 0
    for _ in range(8):
        before_ns = time.monotonic_ns()
        real_ns = time.time_ns()
        after_ns = time.monotonic_ns()
        if after_ns - before_ns < best_ns:
            best_ns = after_ns - before_ns
            offset_ns = real_ns - (before_ns + after_ns) // 2
    return offset_ns
