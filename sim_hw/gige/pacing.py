"""The send rate of a head at which an ordinary receiver on this machine loses no packet.

Computation only; `stream` waits.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
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

    def available(self, now_ns: int) -> float:
        """Bytes that may go now; negative while a debt is worked off."""
        rate = self._pacing.rate_bytes_per_s
        with self._lock:
            gained = max(0, now_ns - self._last_ns) * rate / _NS_PER_S
            self._tokens = min(self._tokens + gained, float(self._pacing.burst_bytes))
            self._last_ns = now_ns
            return self._tokens

    def spend(self, sent_bytes: int) -> None:
        with self._lock:
            self._tokens -= sent_bytes


WIRE_OVERHEAD = 38
"""Header, check sequence, preamble and gap of an Ethernet frame, outside the packet size."""


class PacketTimer:
    """When the next packet of a frame may go: GevSCPD and DeviceLinkThroughputLimit.

    A packet begins `packet_delay_ns` after the end of the one before. The end follows from the rate
    of the head's own link. The throughput limit spaces the beginnings. A sender that wakes up late
    does not catch up: the pause is the shortest that the receiver ever sees.

    Args:
        link_bytes_per_s: rate of the head's own link.
        packet_delay_ns: pause after each packet.
        limit_bytes_per_s: throughput limit; infinite where there is none.
    """

    def __init__(
        self, link_bytes_per_s: float, packet_delay_ns: int, limit_bytes_per_s: float
    ) -> None:
        self._link = link_bytes_per_s
        self._delay_ns = packet_delay_ns
        self._limit = limit_bytes_per_s
        self._due_ns = 0.0

    @property
    def is_limiting(self) -> bool:
        """Whether anything but the link's rate holds packets back."""
        return self._delay_ns > 0 or self._limit < self._link

    def start(self, now_ns: int) -> None:
        """A frame begins: its first packet is due, unless the last pause still runs."""
        self._due_ns = max(self._due_ns, float(now_ns))

    def wait_ns(self, now_ns: int) -> float:
        """Time until the next packet is due; zero or less if it may go."""
        return self._due_ns - now_ns

    def sent(self, size: int, now_ns: int) -> None:
        """A packet of this IP size goes now; the next one is due after it and its pause."""
        self._due_ns = max(self._due_ns, float(now_ns)) + self._spacing_ns(size)

    def charge(self, sizes: Sequence[int]) -> None:
        """Packets that were sent again: what they take delays the frame on its way."""
        if self.is_limiting:
            self._due_ns += sum(map(self._spacing_ns, sizes))

    def _spacing_ns(self, size: int) -> float:
        wire = size + WIRE_OVERHEAD
        taken_ns = wire / self._link * _NS_PER_S + self._delay_ns
        return max(taken_ns, wire / self._limit * _NS_PER_S)
