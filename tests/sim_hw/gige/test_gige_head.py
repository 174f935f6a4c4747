"""An emulated head over real sockets, read by a small receiver written from the standard."""

from __future__ import annotations

import itertools
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_hw.gige import features as at
from sim_hw.gige.gige_head import (
    NO_PULSE,
    RESET_S,
    ExposureRequest,
    FrameSize,
    GigeHead,
    HeadIdentity,
    Pacing,
    WireFaults,
)
from sim_hw.gige.registers import RegisterMemory
from sim_hw.world.world_clock import FreeRunningClock

pytestmark = pytest.mark.realtime


SIZE = FrameSize(320, 200)
IDENTITY = HeadIdentity("127.77.1.1", "T-0001", "Head", "Maker", "SU00")
ADDRESS_OF = RegisterMemory(IDENTITY, SIZE).address_of
CLOCK = FreeRunningClock(offset_ns=5_000_000_000, drift_ppm=12.5)
PACKET_SIZE = 1400
PATTERN = np.random.default_rng(4).integers(0, 4096, (200, 320), dtype=np.uint16)
TIMEOUT_S = 5.0
SO_RCVBUFFORCE = 33
"""Of Linux (asm-generic/socket.h); Python does not name it."""
STREAM_BUFFER_BYTES = 8_000_000


@dataclass
class ReceivedFrame:
    """One block, put together from its packets."""

    block_id: int = 0
    leader: bytes = b""
    trailer: bytes = b""
    data: dict[int, bytes] = field(default_factory=dict)
    resent: set[int] = field(default_factory=set)
    unavailable: set[int] = field(default_factory=set)

    @property
    def payload(self) -> bytes:
        return b"".join(self.data[packet] for packet in sorted(self.data))

    def image(self) -> NDArray[np.uint16]:
        return np.frombuffer(self.payload, "<u2", SIZE.width_px * SIZE.height_px).reshape(200, 320)

    def chunks(self) -> dict[int, bytes]:
        """Chunk data by id, read from the end as the standard lays it."""
        rest, found = self.payload, {}
        while rest:
            chunk_id, length = struct.unpack(">II", rest[-8:])
            found[chunk_id] = rest[-8 - length : -8]
            rest = rest[: -8 - length]
        return found


class Controller:
    """A host with one control socket and one stream socket."""

    def __init__(self, head: GigeHead) -> None:
        self.head = head
        self.control = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.control.bind(("127.0.0.1", 0))
        self.control.settimeout(TIMEOUT_S)
        self.stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.stream.bind(("127.0.0.1", 0))
        # Several frames, which on a busy machine are sent before this host has a core to read them.
        with suppress(PermissionError):
            self.stream.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, STREAM_BUFFER_BYTES)
        self.stream.settimeout(TIMEOUT_S)
        self._request_ids = itertools.count(1)

    def close(self) -> None:
        self.control.close()
        self.stream.close()

    def ask(self, code: int, body: bytes, *, flags: int = 1) -> tuple[int, bytes]:
        packet = struct.pack(">BBHHH", 0x42, flags, code, len(body), next(self._request_ids))
        self.control.sendto(packet + body, (self.head.address, 3956))
        if not flags & 1:
            return 0, b""
        answer = self.control.recv(1000)
        return struct.unpack(">H", answer[:2])[0], answer[8:]

    def write(self, register: str | int, value: int) -> None:
        address = register if isinstance(register, int) else ADDRESS_OF(register)
        status, _ = self.ask(0x82, struct.pack(">II", address, value))
        assert status == 0

    def write_double(self, feature: str, value: float) -> None:
        assert self.ask(0x86, struct.pack(">Id", ADDRESS_OF(feature), value))[0] == 0

    def read(self, register: str | int) -> int:
        address = register if isinstance(register, int) else ADDRESS_OF(register)
        status, body = self.ask(0x80, struct.pack(">I", address))
        assert status == 0
        return int(struct.unpack(">I", body)[0])

    def read_memory(self, address: int, length: int) -> bytes:
        status, body = self.ask(0x84, struct.pack(">IHH", address, 0, length))
        assert status == 0
        return body[4:]

    def open(self, *, source: str = "Line1", chunks: bool = True) -> None:
        """Take control, open the stream and start a triggered acquisition."""
        self.write(at.CONTROL_PRIVILEGE, at.CONTROL_ACCESS)
        self.write(at.STREAM_DESTINATION, int.from_bytes(socket.inet_aton("127.0.0.1")))
        self.write(at.STREAM_PACKET_SIZE, PACKET_SIZE)
        self.write(at.STREAM_PORT, self.stream.getsockname()[1])
        self.write("TriggerMode", 1)
        self.write("TriggerSource", at.TRIGGER_SOURCES[source])
        self.write("ChunkModeActive", int(chunks))
        self.write("AcquisitionStart", 1)

    def receive_packet(self, frame: ReceivedFrame) -> int:
        """Receive one packet into a frame. Returns its format: 1 leader, 2 trailer, 3 data."""
        packet = self.stream.recv(65_536)
        assert len(packet) <= PACKET_SIZE - 28
        status, block_id, packet_word = struct.unpack(">HHI", packet[:8])
        kind, number = packet_word >> 24, packet_word & 0xFF_FFFF
        if status == 0x800C:
            frame.unavailable.add(number)
            return kind
        frame.block_id = block_id
        if status == 0x0100:
            frame.resent.add(number)
        if kind == 1:
            frame.leader = packet[8:]
        elif kind == 2:
            frame.trailer = packet[8:]
        else:
            frame.data[number] = packet[8:]
        return kind

    def receive_frame(self) -> ReceivedFrame:
        frame = ReceivedFrame()
        while self.receive_packet(frame) != 2:
            pass
        return frame


class Sensor:
    """What the head exposes with: a pattern, marked with the exposure's counter and pulse."""

    def __init__(self) -> None:
        self.requests: list[ExposureRequest] = []
        self.may_finish = threading.Event()
        self.may_finish.set()

    def expose(self, request: ExposureRequest) -> NDArray[np.uint16]:
        self.requests.append(request)
        assert self.may_finish.wait(TIMEOUT_S)
        image = PATTERN.copy()
        image[0, :2] = request.counter, request.pulse_count
        return image


@dataclass
class Bench:
    head: GigeHead
    host: Controller
    sensor: Sensor

    def wait_for(self, counter: str, value: int) -> None:
        """Wait until a counter of the head has reached a value."""
        deadline = time.monotonic() + TIMEOUT_S
        while self.head.statistics()[counter] < value:
            if time.monotonic() > deadline:
                pytest.fail(f"{counter} stayed at {self.head.statistics()[counter]}, not {value}")
            time.sleep(0.005)


def make_bench(faults: WireFaults | None = None) -> Bench:
    sensor = Sensor()
    head = GigeHead(
        IDENTITY,
        SIZE,
        sensor.expose,
        lambda _mono_ns: 41.25,
        CLOCK,
        faults or WireFaults(),
        Pacing.for_receive_buffer(212_992),
    )
    head.start()
    return Bench(head, Controller(head), sensor)


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = make_bench()
    yield bench
    bench.host.close()
    bench.head.close()


def test_a_line_pulse_becomes_a_frame_with_the_right_pixels_and_leader(bench: Bench) -> None:
    bench.host.open(chunks=False)
    start_ns = time.monotonic_ns()
    bench.head.line(start_ns, 77)
    frame = bench.host.receive_frame()
    assert np.array_equal(frame.image()[1:], PATTERN[1:])
    assert frame.image()[0, :2].tolist() == [1, 77]
    _, kind, timestamp, pixel_format, width, height = struct.unpack(">HHQIII", frame.leader[:24])
    assert (kind, pixel_format, width, height) == (1, 0x0110_0007, 320, 200)
    assert timestamp == CLOCK.device_ns(start_ns)
    assert struct.unpack(">HHI", frame.trailer) == (0, 1, 200)
    assert frame.block_id == 1
    assert sorted(frame.data) == list(range(1, 1 + -(-320 * 200 * 2 // (PACKET_SIZE - 36))))


def test_the_exposure_is_taken_with_the_settings_of_its_pulse(bench: Bench) -> None:
    bench.host.open()
    bench.host.write_double("ExposureTime", 2500.0)
    bench.host.write_double("Gain", 6.0)
    bench.host.write("TdiShifts", 12)
    bench.sensor.may_finish.clear()
    start_ns = time.monotonic_ns()
    bench.head.line(start_ns, 3)
    bench.host.write("TdiShifts", 20)
    bench.sensor.may_finish.set()
    bench.host.receive_frame()
    assert bench.sensor.requests == [ExposureRequest(1, start_ns, 2500.0, 6.0, 12, 3)]


def test_chunk_data_hold_time_exposure_counter_and_temperature(bench: Bench) -> None:
    bench.host.open()
    start_ns = time.monotonic_ns()
    bench.head.line(start_ns, 1)
    frame = bench.host.receive_frame()
    chunks = frame.chunks()
    assert chunks[0x0001][4:] == PATTERN.tobytes()[4:]
    assert struct.unpack(">Q", chunks[0x1001])[0] == CLOCK.device_ns(start_ns)
    assert struct.unpack(">d", chunks[0x1002])[0] == 5000.0
    assert struct.unpack(">Q", chunks[0x1003])[0] == 1
    assert struct.unpack(">d", chunks[0x1004])[0] == 41.25
    assert len(frame.payload) == bench.host.read("PayloadSize")
    assert struct.unpack(">H", frame.leader[2:4])[0] == 0x4001


def test_chunks_can_be_left_out_one_by_one(bench: Bench) -> None:
    bench.host.write(at.CONTROL_PRIVILEGE, at.CONTROL_ACCESS)
    bench.host.write(ADDRESS_OF("ChunkEnable") + 4 * at.CHUNKS["ExposureTime"], 0)
    bench.host.open()
    bench.head.line(time.monotonic_ns(), 1)
    left = [0x0001, 0x1001, 0x1003, 0x1004, 0x1005, 0x1006]
    assert sorted(bench.host.receive_frame().chunks()) == left


def test_mono8_keeps_the_eight_high_bits_of_twelve(bench: Bench) -> None:
    bench.host.write(at.CONTROL_PRIVILEGE, at.CONTROL_ACCESS)
    bench.host.write("PixelFormat", at.PIXEL_FORMATS["Mono8"])
    bench.host.open(chunks=False)
    assert bench.host.read("PayloadSize") == 320 * 200
    bench.head.line(time.monotonic_ns(), 1)
    image = np.frombuffer(bench.host.receive_frame().payload, np.uint8).reshape(200, 320)
    assert np.array_equal(image[1:], PATTERN[1:] // 16)


def test_a_software_trigger_exposes_now_and_has_no_pulse(bench: Bench) -> None:
    bench.host.open(source="Software")
    before_ns = time.monotonic_ns()
    bench.host.write("TriggerSoftware", 1)
    after_ns = time.monotonic_ns()
    bench.host.receive_frame()
    (request,) = bench.sensor.requests
    assert request.pulse_count == NO_PULSE
    assert before_ns <= request.start_mono_ns <= after_ns


def test_a_free_running_head_keeps_its_frame_rate(bench: Bench) -> None:
    bench.host.write(at.CONTROL_PRIVILEGE, at.CONTROL_ACCESS)
    bench.host.write_double("AcquisitionFrameRate", 10.0)
    bench.host.open()
    bench.host.write("AcquisitionStop", 1)
    bench.host.write("TriggerMode", 0)
    bench.host.write("AcquisitionStart", 1)
    for _ in range(4):
        bench.host.receive_frame()
    starts = [request.start_mono_ns for request in bench.sensor.requests[:4]]
    assert (starts[3] - starts[0]) / 1e9 == pytest.approx(0.3, abs=0.08)


def test_single_frame_mode_takes_one_frame(bench: Bench) -> None:
    bench.host.write(at.CONTROL_PRIVILEGE, at.CONTROL_ACCESS)
    bench.host.write("AcquisitionMode", at.ACQUISITION_MODES["SingleFrame"])
    bench.host.open()
    for pulse in (1, 2, 3):
        bench.head.line(time.monotonic_ns(), pulse)
    bench.host.receive_frame()
    assert bench.head.statistics()["frames_exposed"] == 1
    assert bench.head.statistics()["pulses_ignored"] == 2


def test_a_frame_dropped_by_fault_is_counted_by_the_head_and_seen_in_the_counter() -> None:
    bench = make_bench(WireFaults(drop_frame=frozenset({2})))
    try:
        bench.host.open()
        pulse_ns = time.monotonic_ns() - 100_000_000
        for pulse in (1, 2, 3):
            bench.head.line(pulse_ns + pulse * 10_000_000, pulse)
        frames = [bench.host.receive_frame(), bench.host.receive_frame()]
        counters = [struct.unpack(">Q", frame.chunks()[0x1003])[0] for frame in frames]
        assert counters == [1, 3]
        assert [int(frame.image()[0, 1]) for frame in frames] == [1, 3]
        assert [frame.block_id for frame in frames] == [1, 2]
        statistics = bench.head.statistics()
        assert statistics["frames_exposed"] == 3
        assert statistics["frames_dropped_by_fault"] == 1
    finally:
        bench.host.close()
        bench.head.close()


def test_a_pulse_during_an_exposure_is_overtriggered(bench: Bench) -> None:
    bench.host.open()
    start_ns = time.monotonic_ns()
    bench.head.line(start_ns, 1)
    bench.head.line(start_ns + 4_999_000, 2)
    bench.head.line(start_ns + 5_000_000, 3)
    frames = [bench.host.receive_frame(), bench.host.receive_frame()]
    assert [int(frame.image()[0, 1]) for frame in frames] == [1, 3]
    assert bench.head.statistics()["overtriggered"] == 1


def test_the_frame_never_leaves_before_its_exposure_ends(bench: Bench) -> None:
    bench.host.open()
    start_ns = time.monotonic_ns() + 150_000_000
    bench.head.line(start_ns, 1)
    bench.host.receive_frame()
    assert time.monotonic_ns() >= start_ns + 5_000_000


def test_control_answers_while_an_exposure_takes_its_time(bench: Bench) -> None:
    bench.host.open()
    bench.sensor.may_finish.clear()
    bench.head.line(time.monotonic_ns(), 1)
    answered_s = []
    for _ in range(20):
        begun = time.monotonic()
        bench.host.read(at.CONTROL_PRIVILEGE)
        answered_s.append(time.monotonic() - begun)
    bench.sensor.may_finish.set()
    bench.host.receive_frame()
    assert sorted(answered_s)[10] < 0.02


def test_packets_are_sent_again_on_request_and_marked_so(bench: Bench) -> None:
    bench.host.open(chunks=False)
    bench.head.line(time.monotonic_ns(), 1)
    first = bench.host.receive_frame()
    bench.wait_for("frames_sent", 1)
    bench.host.ask(0x40, struct.pack(">HHII", 0, 1, 5, 9), flags=0)
    again = ReceivedFrame()
    for _ in range(5):
        bench.host.receive_packet(again)
    assert again.resent == {5, 6, 7, 8, 9}
    assert all(again.data[number] == first.data[number] for number in range(5, 10))
    bench.wait_for("packets_resent", 5)


def test_packets_of_a_frame_long_gone_are_reported_as_unavailable(bench: Bench) -> None:
    bench.host.open()
    for pulse in (1, 2, 3):
        bench.head.line(time.monotonic_ns(), pulse)
        bench.host.receive_frame()
    bench.host.ask(0x40, struct.pack(">HHII", 0, 1, 5, 6), flags=0)
    answer = ReceivedFrame()
    bench.host.receive_packet(answer)
    bench.host.receive_packet(answer)
    assert answer.unavailable == {5, 6}
    assert bench.head.statistics()["resends_unavailable"] == 1


def test_lost_packets_are_as_many_as_the_fault_states() -> None:
    bench = make_bench(WireFaults(packet_loss=0.25))
    try:
        bench.host.open()
        for pulse in range(1, 21):
            bench.head.line(time.monotonic_ns(), pulse)
            bench.wait_for("frames_sent", pulse)
        statistics = bench.head.statistics()
        total = statistics["packets_sent"] + statistics["packets_lost_by_fault"]
        assert total == 20 * (2 + -(-(320 * 200 * 2 + 8 + 4 * 16) // (PACKET_SIZE - 36)))
        # Binomial: 1920 packets, sigma 19.
        assert statistics["packets_lost_by_fault"] == pytest.approx(0.25 * total, abs=5 * 19)
    finally:
        bench.host.close()
        bench.head.close()


def test_the_timestamp_latch_reads_the_devices_clock(bench: Bench) -> None:
    bench.host.write(at.CONTROL_PRIVILEGE, at.CONTROL_ACCESS)
    before_ns = CLOCK.device_ns(time.monotonic_ns())
    bench.host.write(at.TIMESTAMP_CONTROL, at.TIMESTAMP_LATCH)
    after_ns = CLOCK.device_ns(time.monotonic_ns())
    (latched_ns,) = struct.unpack(">Q", bench.host.read_memory(at.TIMESTAMP_VALUE, 8))
    assert before_ns <= latched_ns <= after_ns


def test_the_temperature_is_read_as_a_double(bench: Bench) -> None:
    data = bench.host.read_memory(ADDRESS_OF("DeviceTemperature"), 8)
    assert struct.unpack(">d", data)[0] == 41.25


def test_a_test_packet_has_the_size_requested(bench: Bench) -> None:
    bench.host.open()
    bench.host.write("AcquisitionStop", 1)
    packet_word = at.FIRE_TEST_PACKET | at.DO_NOT_FRAGMENT | 9000
    bench.host.write(at.STREAM_PACKET_SIZE, packet_word)
    assert len(bench.host.stream.recv(65_536)) == 9000 - 28
    assert bench.host.read(at.STREAM_PACKET_SIZE) == at.DO_NOT_FRAGMENT | 9000


def test_a_head_whose_controller_died_stops_and_lets_the_next_one_in(bench: Bench) -> None:
    bench.host.open()
    bench.host.write("GevHeartbeatTimeout", 500)
    bench.host.close()
    successor = Controller(bench.head)
    try:
        body = struct.pack(">II", at.CONTROL_PRIVILEGE, at.CONTROL_ACCESS)
        assert successor.ask(0x82, body)[0] == 0x8006
        bench.wait_for("heartbeats_lost", 1)
        bench.head.line(time.monotonic_ns(), 1)
        assert bench.head.statistics()["pulses_ignored"] == 1
        successor.open()
        bench.head.line(time.monotonic_ns(), 2)
        frame = successor.receive_frame()
        assert int(frame.image()[0, 1]) == 2
        assert frame.block_id == 1
    finally:
        successor.close()


def test_a_reset_forgets_settings_and_controller(bench: Bench) -> None:
    bench.host.open()
    bench.host.write("TdiShifts", 9)
    bench.host.write("DeviceReset", 1)
    bench.host.control.settimeout(RESET_S / 5)
    with pytest.raises(TimeoutError):
        bench.host.read("TdiShifts")
    bench.host.control.settimeout(TIMEOUT_S)
    time.sleep(RESET_S)
    assert bench.host.read("TdiShifts") == 0
    assert bench.host.read(at.CONTROL_PRIVILEGE) == 0


def test_two_heads_cannot_have_one_address(bench: Bench) -> None:
    second = GigeHead(IDENTITY, SIZE, bench.sensor.expose, lambda _: 0.0, CLOCK)
    with pytest.raises(OSError, match=r"127\.77\.1\.1:3956 cannot be used"):
        second.start()
    second.close()


def test_garbage_on_the_wire_leaves_the_head_answering(bench: Bench) -> None:
    for packet in (b"", b"\x00" * 2000, b"\x42" * 8, bytes(range(256))):
        bench.host.control.sendto(packet, (bench.head.address, 3956))
    assert bench.host.read(at.VERSION) == 0x0002_0000
    assert bench.head.statistics()["garbage_packets"] == 4
