"""A PTP clock that follows a master on the network: an ordinary clock, slave only.

Written from IEEE 1588-2008: UDP over IPv4 (annex D), end-to-end delay (11.3), two-step and one-step
masters, best master by data set comparison (9.3.4). Time stamps are the kernel's for packets that
arrive and the process's for packets that leave, so offsets scatter by tens of microseconds.
"""

from __future__ import annotations

import contextlib
import select
import socket
import struct
import threading
import time
from collections import Counter
from dataclasses import dataclass, field

NS_PER_S = 1_000_000_000
EVENT_PORT, GENERAL_PORT = 319, 320
PRIMARY_MULTICAST = "224.0.1.129"
SYNC, DELAY_REQUEST, FOLLOW_UP, DELAY_RESPONSE, ANNOUNCE = 0x0, 0x1, 0x8, 0x9, 0xB
TWO_STEP = 0x0200
PTP_TIMESCALE = 0x0008
HEADER = struct.Struct(">BBHBBHqI8sHHBb")
STAMP = struct.Struct(">HII")
ANNOUNCE_BODY = struct.Struct(">HIIhxBBBHB8sHB")
ANNOUNCE_TIMEOUT_S = 6.0
"""Three intervals of 2 s, the defaults of annex J.3."""
STEP_NS = 1_000_000
DELAY_INTERVAL_S = 0.25
CORRECTION_SHARE, RATE_SHARE = 0.5, 0.1
SCM_TIMESTAMPNS = 35
SO_TIMESTAMPNS = 35
LOCK_SAMPLES = 3


@dataclass(frozen=True)
class MasterData:
    """What a master announces."""

    grandmaster: int
    parent: bytes
    rank: tuple[int, int, int, int, int, int, int]
    """Priority, class, accuracy, variance, second priority, identity, steps: the smaller is
    better."""
    utc_offset_s: int
    is_ptp_timescale: bool

    @property
    def parent_identity(self) -> int:
        """The identity of the master itself, 64 bits."""
        return int.from_bytes(self.parent[:8], "big")


@dataclass
class _Master:
    data: MasterData
    announced_ns: int
    syncs: dict[int, tuple[int, int]] = field(default_factory=dict)
    """Arrival on the local clock and correction, by sequence number, until the follow-up."""


class PtpSlave:
    """One clock; `start()` opens the ports 319 and 320 on `address`, `close()` ends it.

    Args:
        address: IPv4 address of the interface.
        identity: of the clock, 64 bits.
        drift_ppm: rate error of its oscillator.
    """

    def __init__(self, address: str, identity: int, *, drift_ppm: float = 0.0) -> None:
        self._address = address
        self._identity = struct.pack(">QH", identity, 1)
        self._rate = 1.0 + drift_ppm * 1e-6
        self._base_mono_ns = time.monotonic_ns()
        self._base_ns = 0
        self._lock = threading.RLock()
        self._masters: dict[bytes, _Master] = {}
        self._selected: bytes | None = None
        self._samples = 0
        self._delay_ns = 0
        self._requests: dict[int, int] = {}
        self._sequence = 0
        self._last_sync: tuple[int, int] | None = None
        self.offset_ns = 0
        self.counts: Counter[str] = Counter()
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self._sockets: list[socket.socket] = []

    def start(self) -> None:
        """Begin to follow. OSError: a port is in use, or not permitted."""
        if self._thread is not None:
            return
        self._ending.clear()
        self._sockets = [self._opened(EVENT_PORT), self._opened(GENERAL_PORT)]
        self._thread = threading.Thread(target=self._run, name="ptp-slave", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop following; the clock runs on. May be called twice."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join(5)
            self._thread = None
        for each in self._sockets:
            each.close()
        self._sockets = []
        with self._lock:
            self._masters.clear()
            self._lose()

    @property
    def status(self) -> str:
        """The state of the port, as SFNC names it."""
        if self._thread is None:
            return "Disabled"
        with self._lock:
            if self._selected is None:
                return "Listening"
            return "Slave" if self._samples >= LOCK_SAMPLES else "Uncalibrated"

    @property
    def master(self) -> MasterData | None:
        """The selected master."""
        with self._lock:
            return None if self._selected is None else self._masters[self._selected].data

    def clock_ns(self, mono_ns: int) -> int:
        """What the clock shows at a monotonic time."""
        with self._lock:
            return self._base_ns + round((mono_ns - self._base_mono_ns) * self._rate)

    def _opened(self, port: int) -> socket.socket:
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        opened.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        opened.bind(("", port))
        membership = socket.inet_aton(PRIMARY_MULTICAST) + socket.inet_aton(self._address)
        opened.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        interface = socket.inet_aton(self._address)
        opened.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, interface)
        opened.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 0)
        opened.setblocking(False)
        return opened

    def _run(self) -> None:
        next_request_ns = time.monotonic_ns()
        while not self._ending.is_set():
            ready, _, _ = select.select(self._sockets, [], [], 0.05)
            for each in ready:
                with contextlib.suppress(BlockingIOError):
                    self._receive(each)
            now_ns = time.monotonic_ns()
            with self._lock:
                self._expire(now_ns)
                if self._selected is not None and now_ns >= next_request_ns:
                    self._request_delay()
                    next_request_ns = now_ns + round(DELAY_INTERVAL_S * NS_PER_S)

    def _receive(self, source: socket.socket) -> None:
        packet, ancillary, _, _ = source.recvmsg(1500, 128)
        mono_ns = time.monotonic_ns()
        for level, kind, data in ancillary:
            if level == socket.SOL_SOCKET and kind == SCM_TIMESTAMPNS:
                seconds, nanoseconds = struct.unpack("qq", data[:16])
                age_ns = time.time_ns() - (seconds * NS_PER_S + nanoseconds)
                # The kernel's stamp, unless the wall clock was set in between.
                mono_ns -= age_ns if 0 <= age_ns < NS_PER_S else 0
        with self._lock:
            if not self._take(packet, mono_ns):
                self.counts["ptp_garbage"] += 1

    def _take(self, packet: bytes, mono_ns: int) -> bool:
        if len(packet) < HEADER.size + STAMP.size:
            return False
        kind, version, length, _domain, _, flags, correction, _, identity, port, sequence, _, _ = (
            HEADER.unpack_from(packet)
        )
        if version & 0xF != 2 or length > len(packet) or _domain != 0:
            return False
        source, message = struct.pack(">8sH", identity, port), kind & 0xF
        stamp = _stamp(packet, HEADER.size)
        correction_ns = correction >> 16
        if message == ANNOUNCE and len(packet) >= HEADER.size + ANNOUNCE_BODY.size:
            self._announced(packet, flags, source, mono_ns)
        elif source == self._selected:
            master = self._masters[source]
            if message == SYNC:
                arrival = self.clock_ns(mono_ns)
                if flags & TWO_STEP:
                    master.syncs = {sequence: (arrival, correction_ns)}
                else:
                    self._synchronise(stamp + correction_ns, arrival)
            elif message == FOLLOW_UP and sequence in master.syncs:
                arrival, before_ns = master.syncs.pop(sequence)
                self._synchronise(stamp + correction_ns + before_ns, arrival)
            elif message == DELAY_RESPONSE:
                self._answered(packet, sequence, stamp - correction_ns)
        return True

    def _announced(self, packet: bytes, flags: int, source: bytes, mono_ns: int) -> None:
        body = ANNOUNCE_BODY.unpack_from(packet, HEADER.size)
        utc_offset_s, priority1, clock_class, accuracy, variance, priority2 = body[3:9]
        identity, steps = int.from_bytes(body[9], "big"), body[10]
        rank = (priority1, clock_class, accuracy, variance, priority2, identity, steps)
        data = MasterData(identity, source, rank, utc_offset_s, bool(flags & PTP_TIMESCALE))
        if source in self._masters:
            self._masters[source].data = data
            self._masters[source].announced_ns = mono_ns
        else:
            self._masters[source] = _Master(data, mono_ns)
        self._select()

    def _select(self) -> None:
        best = min(self._masters, key=lambda each: self._masters[each].data.rank, default=None)
        if best != self._selected:
            self._lose()
            self._selected = best
            self.counts["ptp_masters_selected"] += best is not None

    def _lose(self) -> None:
        self._selected, self._samples, self._delay_ns = None, 0, 0
        self._last_sync = None
        self._requests.clear()

    def _expire(self, now_ns: int) -> None:
        limit_ns = now_ns - round(ANNOUNCE_TIMEOUT_S * NS_PER_S)
        silent = [each for each, master in self._masters.items() if master.announced_ns < limit_ns]
        for each in silent:
            del self._masters[each]
        if silent:
            self._select()

    def _synchronise(self, sent_ns: int, arrival_ns: int) -> None:
        """A sync message: the servo steps far errors and steers near ones."""
        self.counts["ptp_syncs"] += 1
        offset_ns = arrival_ns - sent_ns - self._delay_ns
        self._last_sync = (sent_ns, arrival_ns)
        now_ns = time.monotonic_ns()
        shown_ns = self.clock_ns(now_ns)
        self.offset_ns = offset_ns
        if abs(offset_ns) > STEP_NS:
            self.counts["ptp_steps"] += 1
            self._samples = 0
            self._requests.clear()
            self._last_sync = None
            correction_ns = offset_ns
        else:
            correction_ns = round(CORRECTION_SHARE * offset_ns)
            self._rate -= RATE_SHARE * offset_ns / NS_PER_S
            self._samples += self._delay_ns > 0
            if self._last_sync is not None:
                self._last_sync = (sent_ns, arrival_ns - correction_ns)
        self._base_mono_ns, self._base_ns = now_ns, shown_ns - correction_ns

    def _request_delay(self) -> None:
        self._sequence = (self._sequence + 1) & 0xFFFF
        header = HEADER.pack(
            *(DELAY_REQUEST, 2, HEADER.size + STAMP.size, 0, 0, 0, 0, 0),
            *(self._identity[:8], 1, self._sequence, 1, 0x7F),
        )
        packet = header + STAMP.pack(0, 0, 0)
        try:
            before_ns = time.monotonic_ns()
            self._sockets[0].sendto(packet, (PRIMARY_MULTICAST, EVENT_PORT))
            after_ns = time.monotonic_ns()
        except OSError:
            self.counts["ptp_send_failures"] += 1
            return
        self._requests = {self._sequence: self.clock_ns((before_ns + after_ns) // 2)}

    def _answered(self, packet: bytes, sequence: int, received_ns: int) -> None:
        """The master's answer: the mean of both ways is the delay (11.3.1)."""
        place = HEADER.size + STAMP.size
        if packet[place : place + 10] != self._identity or self._last_sync is None:
            return
        sent_ns = self._requests.pop(sequence, None)
        if sent_ns is None:
            return
        master_ns, arrival_ns = self._last_sync
        delay_ns = ((arrival_ns - master_ns) + (received_ns - sent_ns)) // 2
        if 0 <= delay_ns < STEP_NS:
            self.counts["ptp_delays"] += 1
            share = 0.2 if self._delay_ns else 1.0
            self._delay_ns += round(share * (delay_ns - self._delay_ns))


def _stamp(packet: bytes, at: int) -> int:
    high, seconds, nanoseconds = STAMP.unpack_from(packet, at)
    return int((high << 32 | seconds) * NS_PER_S + nanoseconds)
