"""The stream channel of a head: sends frames at the paced rate and packets again on request.

One thread per head, asleep between bursts; a frame is sent whole before the next one.
"""

from __future__ import annotations

import contextlib
import queue
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim_hw.gige.gvcp import ResendRequest
from sim_hw.gige.gvsp import (
    UDP_OVERHEAD,
    Destination,
    FramePackets,
    PacketBatch,
    send,
    unavailable_packet,
)
from sim_hw.gige.head_faults import WireFaults
from sim_hw.gige.pacing import Pacing, PacketTimer, TokenBucket

RETAINED_FRAMES = 2
"""Frames whose packets can be asked for again: the one on its way and the one before."""

FRAMES_WAITING_MAX = 2
SEND_BUFFER_BYTES = 4 << 20

FIRST_LEADER_AHEAD_S = 0.005
"""The first leader of a stream goes alone: a receiver may enlarge its socket only when it comes."""

_UNAVAILABLE_ANSWERS_MAX = 16
_POLL_S = 0.2
_NS_PER_S = 1_000_000_000
_IP_MTU_DISCOVER = 10
_IP_PMTUDISC_DONT, _IP_PMTUDISC_DO = 0, 2


@dataclass
class _Outgoing:
    frame: FramePackets
    is_requested: Callable[[], bool]
    sent_packets: int = 0
    share: float = 1.0

    @property
    def packets(self) -> int:
        """How many of its packets there are to be sent."""
        return self.frame.count if self.share >= 1.0 else round(self.frame.count * self.share)

    @property
    def opens_the_stream(self) -> bool:
        return self.frame.block_id == 1


class StreamChannel:
    """The GVSP socket of a head and the thread behind it."""

    def __init__(
        self,
        address: str,
        pacing: Pacing,
        faults: WireFaults,
        seed: int,
        is_connected: Callable[[], bool] = lambda: True,
    ) -> None:
        self._is_connected = is_connected
        self._address = address
        self._pacing = pacing
        self._loss = faults.packet_loss
        self._random = np.random.default_rng(seed)
        self._waiting: queue.Queue[_Outgoing | None] = queue.Queue(FRAMES_WAITING_MAX)
        self._retained: deque[_Outgoing] = deque(maxlen=RETAINED_FRAMES)
        self._bucket = TokenBucket(pacing, time.monotonic_ns())
        self._timer: PacketTimer | None = None
        self._timer_pauses: tuple[int, float] | None = None
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._counting = threading.Lock()
        self._socket: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self.counts: Counter[str] = Counter()

    def start(self) -> int:
        """Open the socket and start sending. Returns the source port."""
        self._socket = self._open(self._address)
        self._thread = threading.Thread(target=self._run, name=f"gvsp-{self._address}", daemon=True)
        self._thread.start()
        return int(self._socket.getsockname()[1])

    def move_to(self, address: str) -> int:
        """Send from another address from now on. Returns the source port."""
        moved = self._open(address)
        old, self._socket, self._address = self._socket, moved, address
        if old is not None:
            old.close()
        return int(moved.getsockname()[1])

    def _open(self, address: str) -> socket.socket:
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        opened.bind((address, 0))
        return opened

    def close(self) -> None:
        self._stop.set()
        with contextlib.suppress(queue.Full):
            self._waiting.put_nowait(None)  # wakes the thread up
        if self._thread is not None:
            self._thread.join(timeout=5.0)
        if self._socket is not None:
            self._socket.close()

    def put(self, frame: FramePackets, share: float, is_requested: Callable[[], bool]) -> bool:
        """Queue a frame; waits while two are queued. False where it is not wanted any more.

        Only the first `share` of its packets is sent, also on request. `is_requested` is asked
        again and again while the frame is being sent.
        """
        while is_requested() and not self._stop.is_set():
            try:
                self._waiting.put(_Outgoing(frame, is_requested, share=share), timeout=_POLL_S)
            except queue.Full:
                continue
            return True
        return False

    def resend(self, request: ResendRequest) -> None:
        """Send packets again at once; what they take is saved from the frame on its way."""
        with self._lock:
            outgoing = next(
                (o for o in self._retained if o.frame.block_id == request.block_id), None
            )
        if outgoing is None:
            self._answer_unavailable(request)
            return
        frame = outgoing.frame
        # What was not sent yet comes by itself.
        last = min(request.last, outgoing.sent_packets - 1)
        packets = np.arange(request.first, last + 1, dtype=np.intp)
        fits = np.searchsorted(np.cumsum(frame.sizes[packets]), self._pacing.burst_bytes, "right")
        packets = packets[: max(int(fits), 1)]
        retained = packets[self._random.random(len(packets)) >= self._loss]
        self._count("packets_lost_by_fault", len(packets) - len(retained))
        if len(retained):
            self._count("packets_resent", self._send(frame.resent(retained)))
            self._bucket.spend(int(frame.sizes[retained].sum()))
            if self._timer is not None:
                self._timer.charge(frame.sizes[retained].tolist())

    def fire_test_packet(self, destination: Destination, *, may_fragment: bool) -> None:
        """Send one packet of the size asked for, so that the receiver learns whether it passes."""
        if self._socket is None:
            return
        self._socket.setsockopt(
            socket.IPPROTO_IP,
            _IP_MTU_DISCOVER,
            _IP_PMTUDISC_DONT if may_fragment else _IP_PMTUDISC_DO,
        )
        try:
            self._socket.sendto(
                bytes(destination.packet_size - UDP_OVERHEAD),
                (destination.address, destination.port),
            )
        except OSError:
            self._count("send_errors", 1)

    def discard_retained(self) -> None:
        """Let go of the frames kept for resending."""
        with self._lock:
            self._retained.clear()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                outgoing = self._waiting.get(timeout=_POLL_S)
            except queue.Empty:
                continue
            if outgoing is None:
                continue
            with self._lock:
                self._retained.append(outgoing)
            frame_count = self._transmit(outgoing)
            self._count("frames_sent" if frame_count else "frames_aborted", 1)

    def _transmit(self, outgoing: _Outgoing) -> bool:
        frame = outgoing.frame
        ends = np.cumsum(frame.sizes)[: max(outgoing.packets, 1)]
        total = int(ends[-1])
        to = frame.destination
        timer = self._timer_of(to)
        if to.transfer_delay_ns:
            self._stop.wait(to.transfer_delay_ns / _NS_PER_S)
        timer.start(time.monotonic_ns())
        rate = self._pacing.rate_bytes_per_s
        done = 0
        if outgoing.opens_the_stream:
            self._send_first_time(frame, 0, 0)
            outgoing.sent_packets, done = 1, int(ends[0])
            self._stop.wait(FIRST_LEADER_AHEAD_S)
        while done < total:
            if self._stop.is_set() or not outgoing.is_requested():
                return False
            first = outgoing.sent_packets
            if timer.is_limiting:
                now_ns = time.monotonic_ns()
                if (wait_ns := timer.wait_ns(now_ns)) > 0:
                    time.sleep(min(wait_ns / _NS_PER_S, _POLL_S))
                    continue
                self._send_first_time(frame, first, first)
                timer.sent(int(frame.sizes[first]), now_ns)
                outgoing.sent_packets, done = first + 1, int(ends[first])
                continue
            available = self._bucket.available(time.monotonic_ns())
            # Half a burst at a time: few wake-ups, and room left to catch up after a late one.
            enough = min(self._pacing.burst_bytes / 2, total - done)
            if available < enough:
                self._stop.wait((enough - available) / rate)
                continue
            fits = int(np.searchsorted(ends, done + available, "right"))
            last = min(max(fits, first + 1), len(ends)) - 1
            self._send_first_time(frame, first, last)
            self._bucket.spend(int(ends[last]) - done)
            done = int(ends[last])
            outgoing.sent_packets = last + 1
        return True

    def _timer_of(self, to: Destination) -> PacketTimer:
        """The timer with the pauses of a destination; it goes on as long as they are the same."""
        pauses = (to.packet_delay_ns, to.throughput_limit_bytes_per_s)
        if self._timer is None or self._timer_pauses != pauses:
            self._timer = PacketTimer(self._pacing.rate_bytes_per_s, *pauses)
            self._timer_pauses = pauses
        return self._timer

    def _send_first_time(self, frame: FramePackets, first: int, last: int) -> None:
        if not self._loss:
            self._count("packets_sent", self._send(frame.batch(first, last)))
            return
        packets = np.arange(first, last + 1, dtype=np.intp)
        retained = packets[self._random.random(len(packets)) >= self._loss]
        self._count("packets_lost_by_fault", len(packets) - len(retained))
        if len(retained):
            self._count("packets_sent", self._send(frame.only(retained)))

    def _send(self, batch: PacketBatch) -> int:
        if self._socket is None or not self._is_connected():
            self._count("packets_lost_by_fault", len(batch))
            return 0
        taken, refused = send(self._socket.fileno(), batch)
        self._count("send_errors", refused)
        return taken

    def _count(self, name: str, number: int) -> None:
        # First sending and resending are two threads, and += is not atomic.
        with self._counting:
            self.counts[name] += number

    def _answer_unavailable(self, request: ResendRequest) -> None:
        with self._lock:
            newest = self._retained[-1] if self._retained else None
        self._count("resends_unavailable", 1)
        if newest is None or self._socket is None or not self._is_connected():
            return
        to = (newest.frame.destination.address, newest.frame.destination.port)
        last = min(request.last, request.first + _UNAVAILABLE_ANSWERS_MAX - 1)
        for packet in range(request.first, last + 1):
            try:
                self._socket.sendto(unavailable_packet(request.block_id, packet), to)
            except OSError:
                self._count("send_errors", 1)
