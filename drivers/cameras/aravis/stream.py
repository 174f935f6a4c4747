"""Frames of one head, received into the slots of a `FrameMemory`.

This module pairs slots with Aravis' buffers; `drivers.cameras.aravis.aravis_head` creates and
closes streams.
"""

from __future__ import annotations

import gc
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from drivers.cameras.aravis.byte_order import bits_of, is_swapped
from drivers.cameras.aravis.camera import AravisCamera
from drivers.cameras.aravis.head_thermometer import is_plausible
from drivers.cameras.aravis.library import aravis, aravis_error
from drivers.cameras.aravis.packet_filter import (
    StreamSocketFilter,
    filter_packet_sockets,
    interface_towards,
    socket_inodes,
)
from drivers.cameras.aravis.settings import AravisSettings
from drivers.cameras.pixels import Packing, bytes_at, packed_nbytes, unpack, words_at
from drivers.contract import DeviceError, FrameMemory

# Quirk: Aravis counts an underrun for every packet that finds no buffer. Underruns in frames are
# computed from the number of packets of a frame.
# Upstream: no report known (2026-11-23); _find_frame_data in src/arvgvstream.c.
STATISTIC_NAMES: Final = {
    "n_underruns": "underrun_packets",
    "n_resend_requests": "resend_requests",
    "n_resent_packets": "resent_packets",
    "n_missing_packets": "missing_packets",
    "n_missing_frames": "missing_frames",
    "n_received_packets": "received_packets",
    "n_ignored_packets": "ignored_packets",
    "n_error_packets": "error_packets",
    "n_transferred_bytes": "bytes",
}
"""Aravis' statistics and their names here."""
ALIGNMENT: Final = 8
GVSP_OVERHEAD_NBYTES: Final = 36
"""IP, UDP and GVSP headers, which are part of the packet size."""


@dataclass(frozen=True)
class ReceivedFrame:
    """A buffer that Aravis has returned, and the slot of its pixels.

    `reason` is Aravis' name of its status; the other values are None if no leader was received.
    """

    slot: int
    reason: str
    frame_id: int
    leader_ns: int
    width_px: int | None
    height_px: int | None
    pixel_format_code: int | None
    chunk_timestamp: int | None
    chunk_exposure_us: float | None
    chunk_counter: int | None
    chunk_gain: float | None
    chunk_temperature_c: float | None
    chunk_frame_id: int | None

    @property
    def has_chunk_data(self) -> bool:
        """Whether at least one value behind the pixels could be read."""
        values = (
            *(self.chunk_timestamp, self.chunk_exposure_us, self.chunk_counter),
            *(self.chunk_gain, self.chunk_temperature_c, self.chunk_frame_id),
        )
        return any(value is not None for value in values)


class FrameStream:
    """The stream of an opened head into `memory`.

    `free` slots are queued immediately, others by `queue_slot`. Aravis writes into a slot from
    `queue_slot` until `pop` returns it; the buffers are referenced here in that time.

    Raises:
        DeviceError: the slots are too small, or the stream cannot be made.
    """

    def __init__(
        self,
        camera: AravisCamera,
        settings: AravisSettings,
        memory: FrameMemory,
        free: Iterable[int],
    ) -> None:
        library = aravis()
        nbytes = camera.geometry.payload_nbytes
        geometry = camera.geometry
        pixel_count = geometry.width_px * geometry.height_px
        self._packing, self._pixel_count = geometry.packing, pixel_count
        self._width_px, self._bits = geometry.width_px, bits_of(geometry.pixel_format)
        needed = max(nbytes, 2 * pixel_count)
        if memory.slot_nbytes < needed:
            raise DeviceError(
                f"{settings.name} at {settings.address}: a frame has {needed} bytes, its slot "
                f"{memory.slot_nbytes}; create slots of the sensor's size plus "
                "CHUNK_ALLOWANCE_NBYTES, and check width_px, height_px and pixel_format"
            )
        self._parser = camera.chunk_parser
        packet_size = int(camera.frame_settings.get("GevSCPSPacketSize", 0))
        # Payload plus leader and trailer; without packets (USB) every underrun is a frame.
        self._packets_per_frame = (
            2 + -(-nbytes // (packet_size - GVSP_OVERHEAD_NBYTES)) if packet_size else 1
        )
        # Packed pixels are received at the end of the slot and unpacked towards its start. So
        # unread bytes are never overwritten, and no additional memory is needed.
        self._offset = 0
        if self._packing is not Packing.WORDS:
            self._offset = (memory.slot_nbytes - nbytes) // ALIGNMENT * ALIGNMENT
        self._memory = memory
        self._buffers = {
            slot: library.Buffer.new(nbytes, memory.address(slot) + self._offset)
            for slot in range(memory.slot_count)
        }
        self._slots = {hash(buffer): slot for slot, buffer in self._buffers.items()}
        self._stream: Any = camera.raw.create_stream(None, None)
        if self._stream is None:
            raise DeviceError(
                f"{settings.name} at {settings.address}: the stream cannot be made; check that no "
                "other program holds the head"
            )
        self._senders: StreamSocketFilter | None = None
        self._ignored = 0
        self._restarts = 0
        self._chunks_unreadable = 0
        self._temperatures_implausible = 0
        self._swapped = 0
        if camera.raw.is_gv_device():
            self._filter_to_head(camera, settings)
            self._tune(settings)
        for slot in free:
            self.queue_slot(slot)

    def queue_slot(self, slot: int) -> None:
        """Queue a slot for Aravis; from any thread.

        Args:
            slot: number of the slot.
        """
        self._stream.push_buffer(self._buffers[slot])

    def pop(self, timeout_s: float) -> ReceivedFrame | None:
        """Wait for a frame. The caller owns its slot until `queue_slot`.

        Args:
            timeout_s: longest wait, s.

        Returns:
            The frame; None if none came in time.
        """
        buffer = self._stream.timeout_pop_buffer(round(timeout_s * 1e6))
        if buffer is None:
            return None
        reason = str(buffer.get_status().value_nick)
        # Quirk: Aravis prints a warning when the size of an aborted frame is read. It is read of
        # complete frames only. Upstream: no report known (2026-11-23).
        is_complete = reason == "success"
        if is_complete:
            self._ignored = self._ignored_packets()
        parser = self._parser if is_complete and buffer.has_chunks() else None
        received = ReceivedFrame(
            slot=self._slots[hash(buffer)],
            reason=reason,
            frame_id=int(buffer.get_frame_id()),
            leader_ns=int(buffer.get_timestamp()),
            width_px=int(buffer.get_image_width()) if is_complete else None,
            height_px=int(buffer.get_image_height()) if is_complete else None,
            pixel_format_code=int(buffer.get_image_pixel_format()) if is_complete else None,
            chunk_timestamp=_chunk(parser, "get_integer_value", buffer, "ChunkTimestamp"),
            chunk_exposure_us=_chunk(parser, "get_float_value", buffer, "ChunkExposureTime"),
            chunk_counter=_chunk(parser, "get_integer_value", buffer, "ChunkCounterValue"),
            chunk_gain=_chunk(parser, "get_float_value", buffer, "ChunkGain"),
            chunk_temperature_c=self._plausible(
                _chunk(parser, "get_float_value", buffer, "ChunkTemperature")
            ),
            chunk_frame_id=_chunk(parser, "get_integer_value", buffer, "ChunkFrameID"),
        )
        if is_complete and self._parser is not None and not received.has_chunk_data:
            self._chunks_unreadable += 1
        return received

    def is_swapped(self, slot: int) -> bool:
        """Whether the words of a complete frame came in the other byte order; after `unpack`.

        Args:
            slot: number of the slot.

        Returns:
            True if their values show it; it is counted.
        """
        if self._packing not in (Packing.WORDS, Packing.WORDS_BIG_ENDIAN):
            return False
        words = words_at(self._memory.address(slot), self._pixel_count)
        found = is_swapped(words.reshape(-1, self._width_px), self._bits)
        self._swapped += found
        return found

    def unpack(self, slot: int) -> None:
        """Convert the received pixels of a slot to right-justified 16-bit words; after `pop`.

        Args:
            slot: number of the slot.
        """
        if self._packing is Packing.WORDS:
            return
        address = self._memory.address(slot)
        packed = bytes_at(address + self._offset, packed_nbytes(self._packing, self._pixel_count))
        unpack(self._packing, packed, words_at(address, self._pixel_count))

    def counted(self) -> Counter[str]:
        """Aravis' statistics of this stream.

        Returns:
            Counts by the names of STATISTIC_NAMES; also `underruns` in frames, `stream_restarts`,
            `chunks_unreadable`, complete frames whose chunk data could not be read,
            `frames_swapped`, whose bytes came in the other order, `temperatures_implausible` in
            chunk data, `other_senders`, dropped datagrams of other senders, and `kernel_drops`,
            datagrams of the head that found the buffer of the socket full.
        """
        found: Counter[str] = Counter()
        for theirs, ours in STATISTIC_NAMES.items():
            found[ours] = self._info(theirs)
        found["underruns"] = -(-found["underrun_packets"] // self._packets_per_frame)
        found["stream_restarts"] = self._restarts
        found["chunks_unreadable"] = self._chunks_unreadable
        found["frames_swapped"] = self._swapped
        found["temperatures_implausible"] = self._temperatures_implausible
        if self._senders is not None:
            found["other_senders"] = self._senders.poll(found["received_packets"])
            found["kernel_drops"] = self._senders.kernel_drops()
        return found

    @property
    def others(self) -> str:
        """The last other sender, and the accepted one."""
        if self._senders is None or not self._senders.last_other:
            return ""
        return f"the last from {self._senders.last_other}; only {self._senders.source} is accepted"

    def restart_if_behind(self) -> bool:
        """Restart the stream if Aravis takes the head's frames for old ones and drops them.

        The sign is a complete frame of ignored packets with no frame delivered since.

        Returns:
            Whether it was restarted.
        """
        # Quirk: Aravis drops up to 100 frames after a block number that was too large, or if the
        # head counts from 1 again. The stream is restarted.
        # Upstream: no report known (2026-11-23); ARV_GV_STREAM_DISCARD_LATE_FRAME_THRESHOLD in
        # src/arvgvstream.c.
        if self._ignored_packets() - self._ignored < self._packets_per_frame:
            return False
        self._stream.stop_thread(False)
        self._stream.start_thread()
        self._ignored = self._ignored_packets()
        self._restarts += 1
        return True

    def close(self) -> None:
        """End the stream. After the return, Aravis no longer writes into any slot."""
        weak = self._stream.weak_ref()
        self._stream = None
        gc.collect()
        # Quirk: the stream's thread ends only with the last reference to the stream. If one were
        # left, it would write into slots that are in use again, so it is stopped explicitly.
        # Upstream: AravisProject/aravis#50, AravisProject/aravis#141.
        left = weak()
        if left is not None:
            left.stop_thread(False)
        if self._senders is not None:
            self._senders.close()
        self._parser = None
        self._buffers.clear()
        self._slots.clear()

    def _plausible(self, temperature_c: float | None) -> float | None:
        """A temperature in chunk data; None, and counted, if no thermometer has it."""
        if temperature_c is None or is_plausible(temperature_c):
            return temperature_c
        self._temperatures_implausible += 1
        return None

    def _info(self, name: str) -> int:
        return int(self._stream.get_info_uint64_by_name(name))

    def _ignored_packets(self) -> int:
        """Packets that Aravis dropped although a buffer was available."""
        return self._info("n_ignored_packets") - self._info("n_underruns")

    def _filter_to_head(self, camera: AravisCamera, settings: AravisSettings) -> None:
        """Accept only the head's datagrams, and discard those that were received before."""
        stream, address = self._stream, camera.ip_address
        stream.stop_thread(False)
        port = int(stream.get_port())
        self._senders = StreamSocketFilter(
            port, address, camera.stream_source_port, camera.fire_test_packet
        )
        known = socket_inodes()
        stream.start_thread()
        if settings.packet_socket:
            source = address, self._senders.source_port
            filter_packet_sockets(known, source, (interface_towards(address), port))

    def _tune(self, settings: AravisSettings) -> None:
        library, stream = aravis(), self._stream
        socket_nbytes = min(settings.socket_buffer_bytes, receive_buffer_limit())
        stream.set_property("socket-buffer", library.GvStreamSocketBuffer.FIXED)
        stream.set_property("socket-buffer-size", socket_nbytes)
        # Quirk: Aravis enlarges its receive buffer only after a first frame has begun, and loses
        # that one. The driver sets the buffer itself.
        # Upstream: no report known (2026-11-23); _update_socket in src/arvgvstream.c.
        if self._senders is not None:
            self._senders.set_receive_buffer(socket_nbytes)
        stream.set_property("packet-resend", library.GvStreamPacketResend.ALWAYS)
        stream.set_property("packet-request-ratio", 1.0)
        stream.set_property("packet-timeout", round(settings.packet_timeout_ms * 1e3))
        stream.set_property("frame-retention", round(settings.frame_retention_ms * 1e3))


def receive_buffer_limit() -> int:
    """The largest socket buffer that the kernel grants.

    Returns:
        net.core.rmem_max, bytes; the kernel's default if it cannot be read.
    """
    try:
        return int(Path("/proc/sys/net/core/rmem_max").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return 212_992


def _chunk(parser: Any, method: str, buffer: Any, name: str) -> Any:
    """The value of a chunk; None if the head does not send it."""
    if parser is None:
        return None
    failed = aravis_error()
    try:
        return getattr(parser, method)(buffer, name)
    except failed:
        return None
