"""The emulated heads against Aravis, which we did not write."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_hw.gige.features import CHUNKS
from sim_hw.gige.gige_head import (
    NO_PULSE,
    ExposureRequest,
    FrameSize,
    GigeHead,
    HeadIdentity,
    Pacing,
    WireFaults,
)
from sim_hw.world.world_clock import FreeRunningClock
from tests.support.stopwatch import slowdown

pytestmark = [pytest.mark.realtime, pytest.mark.peer]

SIZE = FrameSize(1248, 832)
PATTERN = np.random.default_rng(7).integers(0, 4096, (832, 1248), dtype=np.uint16)
FRAMES = 20
PLAIN_DEBIAN_RMEM_MAX = 212_992
POP_TIMEOUT_US = 5_000_000
FRAME_RETENTION_US = 100_000
"""Aravis' own."""


@pytest.fixture(scope="module")
def aravis() -> Any:
    gi = pytest.importorskip("gi", reason="PyGObject is absent; install the extra 'aravis'")
    try:
        gi.require_version("Aravis", "0.8")
    except ValueError:
        pytest.skip("Aravis is absent; install Debian's gir1.2-aravis-0.8")
    from gi.repository import Aravis

    return Aravis


@pytest.fixture
def arv_tool() -> str:
    program = shutil.which("arv-tool-0.8")
    if program is None:
        pytest.skip("arv-tool-0.8 is absent; install Debian's aravis-tools-cli")
    return program


def expose(request: ExposureRequest) -> NDArray[np.uint16]:
    """A known pattern, marked with the counter and the pulse."""
    image = PATTERN.copy()
    image[0, :2] = request.counter, request.pulse_count
    return image


@dataclass
class Heads:
    """Two heads and their clocks."""

    heads: list[GigeHead] = field(default_factory=list)
    clocks: list[FreeRunningClock] = field(default_factory=list)

    def open(self, *, packet_loss: float = 0.0, pacing: Pacing | None = None) -> None:
        for index in range(2):
            clock = FreeRunningClock(offset_ns=index * 10**12, drift_ppm=20.0 * index)
            head = GigeHead(
                HeadIdentity(f"127.77.2.{index + 1}", f"A-{index}", "Head", "Peer", f"SU0{index}"),
                SIZE,
                expose,
                lambda _mono_ns: 36.5,
                clock,
                WireFaults(packet_loss=packet_loss),
                pacing or Pacing.for_receive_buffer(4 << 20),
            )
            head.start()
            self.heads.append(head)
            self.clocks.append(clock)

    def pulse(self, count: int) -> int:
        """Pulse Line1 of both heads. Returns when."""
        start_ns = time.monotonic_ns()
        for head in self.heads:
            head.line(start_ns, count)
        return start_ns

    def total(self, counter: str) -> int:
        return sum(head.statistics()[counter] for head in self.heads)


@pytest.fixture
def heads() -> Iterator[Heads]:
    heads = Heads()
    yield heads
    for head in heads.heads:
        head.close()


class Camera:
    """A head as Aravis sees it."""

    def __init__(self, aravis: Any, address: str, source: str, socket_buffer: int) -> None:
        self.aravis = aravis
        self.camera = aravis.Camera.new(address)
        self.device = self.camera.get_device()
        # With CAP_NET_RAW Aravis would bypass the sockets that everybody else gets.
        self.device.set_stream_options(aravis.GvStreamOption.PACKET_SOCKET_DISABLED)
        self.camera.set_string("PixelFormat", "Mono16")
        self.camera.set_chunk_mode(True)
        self.camera.set_trigger(source)
        self.camera.gv_set_packet_size(9000)
        self.stream = self.camera.create_stream(None, None)
        self.stream.set_property("socket-buffer", aravis.GvStreamSocketBuffer.FIXED)
        self.stream.set_property("socket-buffer-size", socket_buffer)
        self.stream.set_property("packet-request-ratio", 1.0)
        # Aravis gives up a frame after 0.1 s without a packet; on a busy machine each side of the
        # link may wait longer than that for a core.
        self.stream.set_property("frame-retention", round(FRAME_RETENTION_US * slowdown()))
        payload = self.camera.get_payload()
        for _ in range(4):
            self.stream.push_buffer(aravis.Buffer.new_allocate(payload))
        self.chunks = self.camera.create_chunk_parser()
        self.camera.start_acquisition()

    def receive(self) -> tuple[NDArray[np.uint16], dict[str, float]]:
        """Pixels and chunk data of the next frame, which must be complete."""
        buffer = self.stream.timeout_pop_buffer(POP_TIMEOUT_US)
        assert buffer is not None, "no frame came within five seconds"
        assert buffer.get_status() == self.aravis.BufferStatus.SUCCESS
        count = SIZE.width_px * SIZE.height_px
        image = np.frombuffer(buffer.get_data(), np.uint16, count).reshape(832, 1248)
        chunks = {
            "timestamp": self.chunks.get_integer_value(buffer, "ChunkTimestamp"),
            "counter": self.chunks.get_integer_value(buffer, "ChunkCounterValue"),
            "exposure_us": self.chunks.get_float_value(buffer, "ChunkExposureTime"),
            "temperature_c": self.chunks.get_float_value(buffer, "ChunkTemperature"),
        }
        assert buffer.get_timestamp() == chunks["timestamp"]
        self.stream.push_buffer(buffer)
        return image, chunks

    def close(self) -> None:
        self.camera.stop_acquisition()
        # Aravis lets go of stream and device when the last reference is gone.
        del self.chunks, self.stream, self.device, self.camera


def receive_all(aravis: Any, heads: Heads, *, socket_buffer: int, interval_s: float) -> None:
    """Pulse both heads twenty times and hold every frame against the truth."""
    cameras = [
        Camera(aravis, head.address, "Line1", socket_buffer=socket_buffer) for head in heads.heads
    ]
    try:
        for count in range(1, FRAMES + 1):
            start_ns = heads.pulse(count)
            for camera, clock in zip(cameras, heads.clocks, strict=True):
                image, chunks = camera.receive()
                assert image[0, :2].tolist() == [count, count]
                assert np.array_equal(image.ravel()[2:], PATTERN.ravel()[2:])
                assert chunks == {
                    "timestamp": clock.device_ns(start_ns),
                    "counter": count,
                    "exposure_us": 5000.0,
                    "temperature_c": 36.5,
                }
            left_s = interval_s - (time.monotonic_ns() - start_ns) / 1e9
            time.sleep(max(0.0, left_s))
    finally:
        for camera in cameras:
            camera.close()
    assert heads.total("frames_exposed") == heads.total("frames_sent") == 2 * FRAMES


def test_two_line_triggered_heads_deliver_20_of_20_frames(aravis: Any, heads: Heads) -> None:
    heads.open()
    receive_all(aravis, heads, socket_buffer=4 << 20, interval_s=0.1)


def test_with_1_percent_loss_every_packet_is_sent_again(aravis: Any, heads: Heads) -> None:
    heads.open(packet_loss=0.01)
    receive_all(aravis, heads, socket_buffer=4 << 20, interval_s=0.1)
    assert heads.total("packets_lost_by_fault") > 0
    assert heads.total("packets_resent") > 0


def test_the_socket_buffer_of_a_plain_debian_is_enough(aravis: Any, heads: Heads) -> None:
    heads.open(pacing=Pacing.for_receive_buffer(PLAIN_DEBIAN_RMEM_MAX))
    receive_all(aravis, heads, socket_buffer=PLAIN_DEBIAN_RMEM_MAX, interval_s=0.3)
    assert heads.total("packets_resent") < heads.total("packets_sent") / 10


def test_a_software_trigger_gives_a_frame_without_a_pulse(aravis: Any, heads: Heads) -> None:
    heads.open()
    camera = Camera(aravis, heads.heads[0].address, "Software", socket_buffer=4 << 20)
    try:
        camera.camera.software_trigger()
        image, chunks = camera.receive()
    finally:
        camera.close()
    assert image[0, :2].tolist() == [1, NO_PULSE]
    assert chunks["counter"] == 1


def test_the_automatic_packet_size_finds_the_loopbacks(aravis: Any, heads: Heads) -> None:
    heads.open()
    camera = aravis.Camera.new(heads.heads[0].address)
    assert camera.gv_auto_packet_size() > 60_000


def test_aravis_reads_the_clock_by_latch(aravis: Any, heads: Heads) -> None:
    heads.open()
    device = aravis.Camera.new(heads.heads[1].address).get_device()
    assert device.get_integer_feature_value("GevTimestampTickFrequency") == 1_000_000_000
    before_ns = time.monotonic_ns()
    device.execute_command("GevTimestampControlLatch")
    after_ns = time.monotonic_ns()
    latched_ns = device.get_integer_feature_value("GevTimestampValue")
    clock = heads.clocks[1]
    assert clock.device_ns(before_ns) <= latched_ns <= clock.device_ns(after_ns)


def test_chunks_are_chosen_through_selector_and_enable(aravis: Any, heads: Heads) -> None:
    heads.open()
    camera = aravis.Camera.new(heads.heads[0].address)
    with_all = SIZE.width_px * SIZE.height_px * 2 + 8 + len(CHUNKS) * 16
    camera.set_chunk_mode(True)
    assert camera.get_payload() == with_all
    camera.set_chunks("Timestamp,CounterValue")
    assert camera.get_payload() == with_all - (len(CHUNKS) - 2) * 16


def run(*command: str) -> str:
    """What a program prints within ten seconds."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    return done.stdout


def test_arv_tool_lists_the_heads(arv_tool: str, heads: Heads) -> None:
    heads.open()
    listed = run(arv_tool)
    for head in heads.heads:
        assert f"Peer-Head-{head.identity.serial} ({head.address})" in listed


def test_arv_tool_reads_and_sets_features(arv_tool: str, heads: Heads) -> None:
    heads.open()
    tool = (arv_tool, f"--address={heads.heads[0].address}", "control")
    run(*tool, "ExposureTime=1234.5", "TdiShifts=17", "PixelFormat=Mono12", "DeviceUserID=left")
    printed = run(
        *tool, "ExposureTime", "TdiShifts", "PixelFormat", "DeviceUserID", "DeviceTemperature"
    )
    for line in (
        "ExposureTime = 1234.5 us",
        "TdiShifts = 17",
        "PixelFormat = Mono12",
        "DeviceUserID = left",
        "DeviceTemperature = 36.5 C",
    ):
        assert line in printed


def test_arv_camera_test_grabs_free_running_frames(heads: Heads) -> None:
    program = shutil.which("arv-camera-test-0.8")
    if program is None:
        pytest.skip("arv-camera-test-0.8 is absent; install Debian's aravis-tools-cli")
    heads.open()
    device_id = f"Peer-{heads.heads[0].identity.serial}"
    run(
        program,
        f"--name={device_id}",
        "--frequency=10",
        "--duration=2",
        "--no-packet-socket",
    )
    assert heads.heads[0].statistics()["frames_sent"] >= 10
