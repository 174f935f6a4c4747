"""A head that is given by the GenICam description of a real camera.

It has the camera's registers, selectors, enumerations, availability and locks, and sends a test
pattern of the configured size and format for every trigger. It proves names, order of writing and
decoding, not the behaviour of the hardware.
"""

from __future__ import annotations

import re
import struct
import threading
import time
import zlib
from collections import Counter
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sim_hw.gige import features as at
from sim_hw.gige.control import ControlChannel, HeadActions
from sim_hw.gige.described_registers import DescribedRegisters, SparseMemory
from sim_hw.gige.genicam.description_file import read_description
from sim_hw.gige.genicam.node_map import NodeError, NodeMap
from sim_hw.gige.genicam.power_on_state import InitialState, features_of
from sim_hw.gige.gvcp import Status
from sim_hw.gige.gvsp import Destination, FrameHeader, FramePackets, chunk_data
from sim_hw.gige.head_faults import NO_FAULTS
from sim_hw.gige.pacing import Pacing
from sim_hw.gige.packing import wire_pixels
from sim_hw.gige.registers import HeadIdentity
from sim_hw.gige.server import ControlServer
from sim_hw.gige.stream import StreamChannel

_LATCHES = ("TimestampLatch", "GevTimestampControlLatch", "TimestampControlLatch")
_CLOCKS = ("TimestampLatchValue", "Timestamp", "GevTimestampValue", "GevTimestampControlValue")
_BITS_PER_PIXEL_SHIFT = 16


class DescribedHead:
    """One head at `address`, port 3956, from `start()` to `close()`.

    Args:
        address: IPv4 address of this host.
        description: the camera's description as it stores it.
        state: what its registers hold when it is opened.
        serial: serial number it reports.
        big_endian_words: send pixels of 16 bits with the most significant byte first, as some
            cameras do.

    Raises:
        DescriptionError: it is no description.
    """

    def __init__(
        self,
        address: str,
        description: bytes,
        *,
        state: InitialState = InitialState.FACTORY,
        serial: str = "described",
        big_endian_words: bool = False,
    ) -> None:
        self.description = read_description(description)
        identity = HeadIdentity(
            address, serial, self.description.model[:31], self.description.vendor[:31]
        )
        self.registers = DescribedRegisters(identity, self.description, state)
        self._big_endian_words = big_endian_words
        self._stream = StreamChannel(
            address, Pacing.for_this_host(), NO_FAULTS, seed=zlib.crc32(serial.encode())
        )
        self._control = ControlChannel(
            self.registers,
            HeadActions(
                written=self._written,
                resend=self._stream.resend,
                execute_action=lambda _: Status.NOT_IMPLEMENTED,
                control_lost=self._control_lost,
                is_acquiring=lambda: self.is_acquiring,
            ),
        )
        self._server = ControlServer(address, self._control)
        self.is_acquiring = False
        self._generation = 0
        self._block_id = 0
        self._counter = 0
        self._lock = threading.Lock()
        self.counts: Counter[str] = Counter()
        self.last_image: NDArray[np.uint16] | None = None
        """The pattern of the last frame, right-justified, before it was packed."""

    def start(self) -> None:
        """Open the sockets and answer. OSError: the address is not this host's, or in use."""
        self._server.start()
        port = self._stream.start()
        self.registers.set_register(at.STREAM_SOURCE_PORT, port)
        self._write_payload_size()

    def close(self) -> None:
        """Stop and close the sockets. May be called twice."""
        self._server.close()
        self._stream.close()

    def statistics(self) -> Mapping[str, int]:
        """Counters since creation."""
        return dict(self.counts + self._control.counts + self._stream.counts)

    def line_pulse(self) -> None:
        """A pulse at the trigger input."""
        if self.is_acquiring and self.registers.is_trigger_on("Line"):
            self._expose()
        else:
            self.counts["triggers_ignored"] += 1

    def _written(self, address: int) -> None:
        registers = self.registers
        if registers.is_command_given("AcquisitionStart", address):
            with self._lock:
                self.is_acquiring = True
                self._counter = 0
        elif registers.is_command_given("AcquisitionStop", address):
            self.is_acquiring = False
        if registers.is_command_given("TriggerSoftware", address) and self._is_triggered_by(
            "Software"
        ):
            self._expose()
        if address == at.TIMESTAMP_CONTROL or any(
            registers.is_command_given(name, address) for name in _LATCHES
        ):
            self._latch()
        if address == at.STREAM_PORT:
            with self._lock:
                self._generation += 1
                self._block_id = 0
            self._stream.discard_retained()
        elif address == at.STREAM_PACKET_SIZE:
            self._fire_test_packet()
        self._write_payload_size()

    def _control_lost(self) -> None:
        self.is_acquiring = False
        self.registers.set_register(at.STREAM_PORT, 0)
        self._stream.discard_retained()

    def _latch(self) -> None:
        now_ns = time.monotonic_ns()
        self.registers.memory.write(at.TIMESTAMP_VALUE, struct.pack(">Q", now_ns))
        for name in _CLOCKS:
            self.registers.set_feature(name, now_ns)

    def _fire_test_packet(self) -> None:
        register = self.registers.register(at.STREAM_PACKET_SIZE)
        if not register & at.FIRE_TEST_PACKET:
            return
        self.registers.set_register(at.STREAM_PACKET_SIZE, register & ~at.FIRE_TEST_PACKET)
        destination = self._destination()
        if destination is not None:
            self._stream.fire_test_packet(
                destination, may_fragment=not register & at.DO_NOT_FRAGMENT
            )

    def _destination(self) -> Destination | None:
        registers = self.registers
        port = registers.register(at.STREAM_PORT) & 0xFFFF
        address = registers.register(at.STREAM_DESTINATION)
        if not port or not address:
            return None
        return Destination(
            ".".join(str(byte) for byte in struct.pack(">I", address)),
            port,
            max(registers.register(at.STREAM_PACKET_SIZE) & at.PACKET_SIZE_MASK, 576),
            registers.register(at.STREAM_PACKET_DELAY),
        )

    def _is_triggered_by(self, source: str) -> bool:
        """Whether the camera waits for a frame trigger from this source."""
        registers = self.registers
        if not self.is_acquiring or registers.symbolic_or("TriggerMode", "Off") != "On":
            self.counts["triggers_ignored"] += 1
            return False
        found = registers.symbolic_or("TriggerSource", "").startswith(source)
        self.counts["triggers_ignored"] += not found
        return found

    # Frames

    def size_px(self) -> tuple[int, int]:
        """Width and height of a frame, as configured."""
        return int(self.registers.number_or("Width", 0)), int(self.registers.number_or("Height", 0))

    def _write_payload_size(self) -> None:
        width, height = self.size_px()
        bits = int(self.registers.number_or("PixelFormat", 0)) >> _BITS_PER_PIXEL_SHIFT & 0xFF
        nbytes = width * height * bits // 8 + len(self._chunks(0, 0))
        if not self.registers.set_feature("PayloadSize", nbytes):
            self.registers.set_parts("PayloadSize", nbytes)

    def _expose(self) -> None:
        destination = self._destination()
        name = self.registers.symbolic_or("PixelFormat", "")
        width, height = self.size_px()
        if destination is None or not width or not height:
            self.counts["frames_unwanted"] += 1
            return
        now_ns = time.monotonic_ns()
        with self._lock:
            self._block_id = self._block_id % 65_535 + 1
            self._counter += 1
            block_id, generation = self._block_id, self._generation
        rows, columns = np.indices((height, width), dtype=np.uint32)
        image = ((rows * 31 + columns * 7 + block_id) % 4096).astype(np.uint16)
        self.last_image = image
        monochrome = re.sub(r"^Bayer[RGB]{2}", "Mono", name)
        try:
            pixels = wire_pixels(image, monochrome)
        except KeyError:
            self.counts["formats_unknown"] += 1
            return
        if self._sends_big_endian() and pixels.dtype == np.uint16:
            pixels = pixels.byteswap()
        header = FrameHeader(
            block_id, now_ns, int(self.registers.number_or("PixelFormat", 0)), width, height
        )
        frame = FramePackets(header, pixels, self._chunks(pixels.nbytes, now_ns), destination)
        self._stream.put(frame, 1.0, lambda: generation == self._generation)
        self.counts["frames"] += 1

    def _sends_big_endian(self) -> bool:
        """Whether the most significant byte of a word is sent first."""
        registers = self.registers
        return (
            self._big_endian_words
            or registers.number_or("GevSCPSBigEndian", 0) == 1
            or registers.symbolic_or("DeviceStreamChannelEndianness", "") == "Big"
        )

    def _chunks(self, image_nbytes: int, now_ns: int) -> bytes:
        """The chunk data of a frame; empty while chunk mode is off."""
        registers = self.registers
        if not registers.number_or("ChunkModeActive", 0):
            return b""
        values: dict[str, float] = {
            "Timestamp": now_ns,
            "ExposureTime": self._exposure_time_us(),
            "Gain": registers.number_or("Gain", 0),
            "CounterValue": self._counter,
            "FrameID": self._block_id,
            "Framecounter": self._counter,
            "Width": self.size_px()[0],
            "Height": self.size_px()[1],
            "PixelFormat": registers.number_or("PixelFormat", 0),
        }
        chunks = []
        for chunk_id, names in self._chunk_ports().items():
            memory = SparseMemory()
            nodes = NodeMap(self.description, memory)
            length = 0
            for name in names:
                try:
                    nodes.write(name, values.get(name.removeprefix("Chunk"), 0))
                    register = DescribedRegisters.register_of(nodes, name)
                    length = max(length, nodes.address(register) + nodes.length(register))
                except (NodeError, OverflowError, ValueError):
                    continue
            if 0 < length <= 64:
                chunks.append((chunk_id, memory.read(0, length)))
        return chunk_data(image_nbytes, chunks)

    def _exposure_time_us(self) -> float:
        for name in ("ExposureTime", "ExposureTimeAbs", "ExposureTimeRaw"):
            found = self.registers.number_or(name, -1)
            if found >= 0:
                return found
        return 0.0

    def _chunk_ports(self) -> dict[int, list[str]]:
        """Chunk features by the identifier of their chunk."""
        nodes = self.registers.nodes
        found: dict[int, list[str]] = {}
        for name in features_of(nodes):
            if not name.startswith("Chunk"):
                continue
            try:
                register = DescribedRegisters.register_of(nodes, name)
            except NodeError:
                continue
            port = nodes.nodes.get(nodes.node(register).text("pPort"))
            chunk_id = "" if port is None else port.text("ChunkID")
            if chunk_id:
                found.setdefault(int(chunk_id, 16), []).append(name)
        return found
