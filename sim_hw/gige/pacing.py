"""The send rate of a head at which an ordinary receiver on this machine loses no packet.

Computation only; `stream` waits.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path

RECEIVE_BUFFER_LIMIT = Path("/proc/sys/net/core/rmem_max")
RECEIVE_BUFFER_DEFAULT = 212_992
"""rmem_max of a plain Debian, taken where the file cannot be read."""

DRAIN_LATENCY_S = 0.020
"""How long a receiver may be kept from its socket by the scheduler."""

BURST_PART = 0.25
"""Part of the buffer that may be filled at once, which is what a late sender does to catch up."""

BURST_MAX_BYTES = 512 * 1024
RATE_MAX_BYTES_PER_S = 60e6

_NS_PER_S = 1_000_000_000


@dataclass(frozen=True)
class Pacing:
    """Mean rate and largest burst of one head, bytes on the wire.

    The receiver's socket holds 2 x rmem_max of kernel memory (Linux doubles SO_RCVBUF); a datagram
    takes up to about twice its length there (its slab is rounded up to a power of two), so rmem_max
    bytes of packets fit. What comes while the receiver sleeps must fit:
    burst + rate * latency <= rmem_max. Hence

        burst = min(rmem_max / 4, 512 KiB)
        rate = min((rmem_max - burst) / 20 ms, 60 MB/s)

    8 MB/s per head with 212,992 bytes, 60 MB/s with 4 MiB. The upper bounds keep thirteen heads
    that fire together within what two cores can move from socket to socket.
    """

    rate_bytes_per_s: float
    burst_bytes: int

    @classmethod
    def for_receive_buffer(cls, buffer_bytes: int) -> Pacing:
        """Pacing for receivers whose sockets ask for that many bytes (SO_RCVBUF)."""
        burst = min(int(buffer_bytes * BURST_PART), BURST_MAX_BYTES)
        rate = (buffer_bytes - burst) / DRAIN_LATENCY_S
        return cls(min(rate, RATE_MAX_BYTES_PER_S), burst)

    @classmethod
    def for_this_host(cls) -> Pacing:
        """Pacing for receivers that get this host's rmem_max."""
        try:
            limit = int(RECEIVE_BUFFER_LIMIT.read_text(encoding="ascii"))
        except (OSError, ValueError):
            limit = RECEIVE_BUFFER_DEFAULT
        return cls.for_receive_buffer(limit)


class TokenBucket:
    """Bytes that may be sent now: they come at the pacing's rate and pile up to one burst.

    A packet longer than the burst still goes once the bucket is full. Thread-safe.
    """

    def __init__(self, pacing: Pacing, now_ns: int) -> None:
        self._pacing = pacing
        self._tokens = float(pacing.burst_bytes)
        self._last_ns = now_ns
        self._lock = threading.Lock()

    def available(self, now_ns: int, rate_limit_bytes_per_s: float = float("inf")) -> float:
        """Bytes that may go now; negative while a debt is worked off."""
        rate = min(self._pacing.rate_bytes_per_s, rate_limit_bytes_per_s)
        with self._lock:
            gained = max(0, now_ns - self._last_ns) * rate / _NS_PER_S
            self._tokens = min(self._tokens + gained, float(self._pacing.burst_bytes))
            self._last_ns = now_ns
            return self._tokens

    def spend(self, sent_bytes: int) -> None:
        with self._lock:
            self._tokens -= sent_bytes
