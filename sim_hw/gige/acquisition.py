"""From trigger to frame: which pulses become exposures, and the frame each of them becomes.

The sensor is behind `expose`; the way out is `stream`. One thread takes the exposures in turn.
"""

from __future__ import annotations

import heapq
import itertools
import queue
import struct
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_hw.faults.channel import Channel
from sim_hw.gige import features as at
from sim_hw.gige.gvcp import Status
from sim_hw.gige.gvsp import Destination, FrameHeader, FramePackets, chunk_data
from sim_hw.gige.head_faults import ExposedFrame, HeadClock, WireFaults
from sim_hw.gige.packing import wire_pixels
from sim_hw.gige.registers import FrameSize, RegisterMemory
from sim_hw.gige.stream import StreamChannel

NO_PULSE = 0
"""`pulse_count` of an exposure that no pulse of the bus started (software, free-running)."""

PENDING_EXPOSURES_MAX = 16

_CHUNK_BYTES = 16
_IMAGE_CHUNK_BYTES = 8
_FORMAT_NAMES = {code: name for name, code in at.PIXEL_FORMATS.items()}
_BLOCK_ID_MAX = 65_535
_POLL_S = 0.2
_FAULT_POLL_S = 0.02
"""How often a head with faults looks after them."""
_NS_PER_US = 1_000
_NS_PER_S = 1_000_000_000


@dataclass(frozen=True)
class ExposureRequest:
    """One exposure: what the head was set to when it started, and which pulse started it.

    `counter` counts the head's exposures since AcquisitionStart, from 1. `pulse_count` is
    `NO_PULSE` for software triggers and free-running exposures.
    """

    counter: int
    start_mono_ns: int
    exposure_time_us: float
    gain_db: float
    tdi_shifts: int
    pulse_count: int


@dataclass(frozen=True)
class _Pending:
    """An exposure that has started, with the settings as they stood then."""

    acquisition: int
    request: ExposureRequest
    pixel_format: int
    chunks: tuple[str, ...]

    @property
    def end_mono_ns(self) -> int:
        return self.request.start_mono_ns + round(self.request.exposure_time_us * _NS_PER_US)


class Acquisition:
    """Takes exposures while acquiring and hands the frames to the stream channel.

    A pulse during an exposure, or with too many exposures waiting, is not taken: overtriggered, as
    on a real head. Pulses, commands and the exposing thread may come at once.
    """

    def __init__(
        self,
        registers: RegisterMemory,
        stream: StreamChannel,
        size: FrameSize,
        expose: Callable[[ExposureRequest], NDArray[np.uint16]],
        temperature_c: Callable[[int], float],
        clock: HeadClock,
        faults: WireFaults,
        channel: Channel[ExposedFrame],
    ) -> None:
        self._registers = registers
        self._stream = stream
        self._size = size
        self._expose = expose
        self._temperature_c = temperature_c
        self._clock = clock
        self._faults = faults
        self._channel = channel
        self._later: list[tuple[int, int, _Pending, ExposedFrame]] = []
        self._order = itertools.count()
        self._pending: queue.Queue[_Pending | None] = queue.Queue()
        self._lock = threading.Lock()
        self._acquiring = False
        self._acquisition = 0
        self._opened = 0
        self._block_id = 0
        self._counter = 0
        self._frames_left: int | None = None
        self._busy_until_ns = 0
        self._next_free_run_ns = 0
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.counts: Counter[str] = Counter()

    @property
    def is_acquiring(self) -> bool:
        return self._acquiring

    def start(self, name: str) -> None:
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._wake_up()
        if self._thread is not None:
            self._thread.join(timeout=5.0)

    def begin(self) -> None:
        """AcquisitionStart."""
        mode = self._registers.integer("AcquisitionMode")
        with self._lock:
            self._drop_pending()
            self._acquisition += 1
            self._counter = 0
            self._busy_until_ns = 0
            self._next_free_run_ns = time.monotonic_ns()
            self._frames_left = {
                at.ACQUISITION_MODES["SingleFrame"]: 1,
                at.ACQUISITION_MODES["MultiFrame"]: self._registers.integer(
                    "AcquisitionFrameCount"
                ),
            }.get(mode)
            self._acquiring = True
        self._wake_up()

    def end(self) -> None:
        """AcquisitionStop: the frame on its way is finished, waiting exposures are not taken."""
        with self._lock:
            self._acquiring = False
            self._drop_pending()

    def abort(self) -> None:
        """End at once, in the middle of a frame."""
        with self._lock:
            self._acquiring = False
            self._acquisition += 1
            self._drop_pending()

    def stream_opened(self) -> None:
        """The stream's destination port was written: block ids start again at 1."""
        with self._lock:
            self._opened += 1
            self._block_id = 0

    def line_pulse(self, start_mono_ns: int, pulse_count: int) -> None:
        """A pulse on Line1; the exposure starts with it."""
        self.counts["pulses"] += 1
        if not self._is_waiting_for("Line1"):
            self.counts["pulses_ignored"] += 1
            return
        self._start_exposure(start_mono_ns, pulse_count)

    def software_trigger(self) -> None:
        """TriggerSoftware; the exposure starts now."""
        if not self._is_waiting_for("Software"):
            self.counts["software_triggers_ignored"] += 1
            return
        self._start_exposure(time.monotonic_ns(), NO_PULSE)

    def execute_action(self, device_ns: int | None) -> Status:
        """An action command: expose now, or when the head's clock shows `device_ns`.

        A time that has passed triggers immediately, and the return value reports it as late.
        """
        if not self._is_waiting_for("Action1"):
            self.counts["actions_not_waited_for"] += 1
            return Status.SUCCESS
        now_ns = time.monotonic_ns()
        start_ns = now_ns if device_ns is None else self._clock.mono_ns(device_ns)
        if self._pending.qsize() >= PENDING_EXPOSURES_MAX:
            self.counts["overtriggered"] += 1
            return Status.OVERFLOW
        self._start_exposure(max(start_ns, now_ns), NO_PULSE)
        return Status.ACTION_LATE if start_ns < now_ns else Status.SUCCESS

    def payload_bytes(self) -> int:
        """PayloadSize: pixels and chunk data of one frame."""
        pixels = self._size.width_px * self._size.height_px
        chunks = self._enabled_chunks()
        extra = _IMAGE_CHUNK_BYTES + _CHUNK_BYTES * len(chunks) if chunks else 0
        return pixels * self._registers.bits_per_pixel() // 8 + extra

    def destination(self) -> Destination | None:
        """Where frames go, or None while no stream is open."""
        registers = self._registers
        port = registers.register(at.STREAM_PORT) & 0xFFFF
        address = registers.register(at.STREAM_DESTINATION)
        if not port or not address:
            return None
        return Destination(
            address=".".join(str(byte) for byte in struct.pack(">I", address)),
            port=port,
            packet_size=registers.integer("GevSCPSPacketSize"),
            packet_delay_ns=registers.register(at.STREAM_PACKET_DELAY),
            transfer_delay_ns=registers.integer("GevSCFTD"),
            throughput_limit_bytes_per_s=float(registers.integer("DeviceLinkThroughputLimit"))
            if registers.integer("DeviceLinkThroughputLimitMode")
            else float("inf"),
        )

    def _is_waiting_for(self, source: str) -> bool:
        return (
            self._acquiring
            and bool(self._registers.integer("TriggerMode"))
            and self._registers.integer("TriggerSource") == at.TRIGGER_SOURCES[source]
        )

    def _enabled_chunks(self) -> tuple[str, ...]:
        if not self._registers.integer("ChunkModeActive"):
            return ()
        return tuple(name for name in at.CHUNKS if self._registers.chunk_is_enabled(name))

    def _start_exposure(self, start_mono_ns: int, pulse_count: int) -> None:
        registers = self._registers
        with self._lock:
            if not self._acquiring:
                return
            if (
                start_mono_ns < self._busy_until_ns
                or self._pending.qsize() >= PENDING_EXPOSURES_MAX
            ):
                self.counts["overtriggered"] += 1
                return
            if self._channel.counter_restarts(start_mono_ns):
                self._counter = 0
            self._counter += 1
            pending = _Pending(
                acquisition=self._acquisition,
                request=ExposureRequest(
                    counter=self._counter,
                    start_mono_ns=start_mono_ns,
                    exposure_time_us=registers.number("ExposureTime"),
                    gain_db=registers.number("Gain"),
                    tdi_shifts=registers.integer("TdiShifts"),
                    pulse_count=pulse_count,
                ),
                pixel_format=registers.integer("PixelFormat"),
                chunks=self._enabled_chunks(),
            )
            self._busy_until_ns = pending.end_mono_ns
            if self._frames_left is not None:
                self._frames_left -= 1
                self._acquiring = self._frames_left > 0
            self._pending.put_nowait(pending)

    def _wake_up(self) -> None:
        """Let the exposing thread look at what has changed."""
        self._pending.put_nowait(None)

    def _drop_pending(self) -> None:
        while True:
            try:
                dropped = self._pending.get_nowait()
            except queue.Empty:
                return
            self.counts["exposures_cancelled"] += dropped is not None

    def _run(self) -> None:
        while not self._stop.is_set():
            self._free_run()
            self._send_what_is_due()
            try:
                pending = self._pending.get(timeout=self._wait_timeout_s())
            except queue.Empty:
                continue
            if pending is not None:
                self._take(pending)

    def _is_free_running(self) -> bool:
        return self._acquiring and not self._registers.integer("TriggerMode")

    def _wait_timeout_s(self) -> float:
        if not self._is_free_running():
            return _POLL_S if self._channel.is_faultless else _FAULT_POLL_S
        until_next_s = (self._next_free_run_ns - time.monotonic_ns()) / _NS_PER_S
        return min(_POLL_S, max(until_next_s, 0.001))

    def _free_run(self) -> None:
        now_ns = time.monotonic_ns()
        if self._is_free_running() and now_ns >= self._next_free_run_ns:
            period_ns = round(_NS_PER_S / self._registers.number("AcquisitionFrameRate"))
            due_ns = self._next_free_run_ns + period_ns
            self._next_free_run_ns = due_ns if due_ns > now_ns else now_ns + period_ns
            self._start_exposure(max(now_ns, self._busy_until_ns), NO_PULSE)

    def _send_what_is_due(self) -> None:
        now_ns = time.monotonic_ns()
        while self._later and self._later[0][0] <= now_ns:
            _, _, pending, taken = heapq.heappop(self._later)
            self._hand_over(pending, taken)
        if self._acquiring and self._channel.flood_is_due(now_ns):
            self._start_exposure(max(now_ns, self._busy_until_ns), NO_PULSE)

    def _take(self, pending: _Pending) -> None:
        request = pending.request
        image, size = self._expose(request), self._size
        if image.shape != (size.height_px, size.width_px) or image.dtype != np.uint16:
            raise ValueError(
                f"expose gave {image.dtype} of shape {image.shape};"
                f" the sensor is uint16 of shape {(size.height_px, size.width_px)}"
            )
        self.counts["frames_exposed"] += 1
        self._stop.wait(max(0.0, (pending.end_mono_ns - time.monotonic_ns()) / _NS_PER_S))
        if request.pulse_count != NO_PULSE and request.pulse_count in self._faults.drop_frame:
            self.counts["frames_dropped_by_fault"] += 1
            return
        start_ns = self._clock.device_ns(request.start_mono_ns)
        now_ns = time.monotonic_ns()
        sent = self._channel.send(
            ExposedFrame(image, start_ns, request.counter), now_ns, what=str(request.pulse_count)
        )
        self.counts["frames_dropped_by_fault"] += not sent
        for delivery in sent:
            heapq.heappush(
                self._later, (delivery.at_ns, next(self._order), pending, delivery.message)
            )
        self._send_what_is_due()

    def _hand_over(self, pending: _Pending, taken: ExposedFrame) -> None:
        """Pass the frame to the stream, if it has a receiver."""
        destination = self.destination()
        with self._lock:
            if destination is None or pending.acquisition != self._acquisition:
                self.counts["frames_unwanted"] += 1
                return
            self._block_id = self._block_id % _BLOCK_ID_MAX + 1
            block_id, opened = self._block_id, self._opened
        frame = self._frame(pending, taken, block_id, destination)
        self._stream.put(
            frame,
            taken.share,
            lambda: pending.acquisition == self._acquisition and opened == self._opened,
        )

    def _frame(
        self,
        pending: _Pending,
        taken: ExposedFrame,
        block_id: int,
        destination: Destination,
    ) -> FramePackets:
        request, image = pending.request, taken.image
        pixels = wire_pixels(image, _FORMAT_NAMES[pending.pixel_format])
        start_ns = taken.start_ns
        values = {
            "Timestamp": struct.pack(">Q", start_ns & 0xFFFF_FFFF_FFFF_FFFF),
            "ExposureTime": struct.pack(">d", request.exposure_time_us),
            "CounterValue": struct.pack(">Q", taken.counter),
            "Temperature": struct.pack(">d", self._temperature_c(request.start_mono_ns)),
            "Gain": struct.pack(">d", request.gain_db),
            "FrameID": struct.pack(">Q", block_id),
        }
        chunks = b""
        if pending.chunks:
            chunks = chunk_data(
                pixels.nbytes, [(at.CHUNK_IDS[name], values[name]) for name in pending.chunks]
            )
        header = FrameHeader(
            block_id, start_ns, pending.pixel_format, image.shape[1], image.shape[0]
        )
        return FramePackets(header, pixels, chunks, destination)
