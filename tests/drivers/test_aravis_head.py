"""The Aravis head against emulated heads: pixel formats, chunks, actions, packets, odd frames."""

from __future__ import annotations

import mmap
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.cameras.aravis.action_trigger import ActionTrigger
from drivers.cameras.aravis.aravis_head import AravisHead
from drivers.contract import (
    CHUNK_ALLOWANCE_NBYTES,
    DeviceError,
    DeviceEvent,
    Frame,
    FrameStatus,
    LifeCycle,
    Record,
    TemperatureSample,
)
from sim_hw.faults.plan import PlannedFault
from sim_hw.gige import acquisition
from sim_hw.gige.gige_head import (
    ExposureRequest,
    FrameSize,
    GigeHead,
    HeadIdentity,
    Pacing,
    WireFaults,
)
from sim_hw.world.world_clock import FreeRunningClock

pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")
pytestmark = [pytest.mark.realtime, pytest.mark.timeout(240)]

NETWORK = f"127.{1 + os.getpid() % 250}.77"
"""Addresses of this process's own: other tests have heads, too."""
SHAPE = (240, 320)
PATTERN = np.random.default_rng(3).integers(0, 4096, SHAPE, dtype=np.uint16)
WITHIN_S = 40.0
EXPOSURE_US = 800.0
FORMATS = {
    "Mono8": 8,
    "Mono10": 10,
    "Mono10p": 10,
    "Mono10Packed": 10,
    "Mono12": 12,
    "Mono12p": 12,
    "Mono12Packed": 12,
    "Mono16": 12,
}
"""Bits that are left of the sensor's 12."""


class Memory:
    """Slots in an anonymous mapping."""

    slot_count = 4
    slot_nbytes = SHAPE[0] * SHAPE[1] * 2 + CHUNK_ALLOWANCE_NBYTES

    def __init__(self) -> None:
        mapping = mmap.mmap(-1, self.slot_count * self.slot_nbytes)
        self.slots = np.frombuffer(mapping, np.uint8).reshape(self.slot_count, self.slot_nbytes)

    def address(self, slot: int) -> int:
        return int(self.slots[slot].ctypes.data)

    def pixels(self, slot: int) -> NDArray[np.uint16]:
        nbytes = SHAPE[0] * SHAPE[1] * 2
        return self.slots[slot, :nbytes].view(np.uint16).reshape(SHAPE).copy()


class Pair:
    """An emulated head, and the driver in its thread."""

    def __init__(self, number: int, faults: WireFaults, section: dict[str, object]) -> None:
        self.clock = FreeRunningClock(offset_ns=number * 10**12, drift_ppm=15.0 * number)
        self.starts_ns: list[int] = []
        address = f"{NETWORK}.{number + 1}"
        self.emulated = GigeHead(
            HeadIdentity(address, f"E-{number}", "Head", "Peer", f"SU0{number}"),
            FrameSize(SHAPE[1], SHAPE[0]),
            self.expose,
            lambda _mono_ns: 36.5,
            self.clock,
            faults,
            Pacing.for_receive_buffer(4 << 20),
        )
        self.memory = Memory()
        more = {"exposure_time_us": EXPOSURE_US, "frame_retention_ms": 2000.0, **section}
        self.driver = AravisHead(f"SU0{number}", {"address": address, **more}, memory=self.memory)
        self.frames: list[Frame] = []
        self.pictures: list[NDArray[np.uint16]] = []
        self.events: list[DeviceEvent] = []
        self.temperatures: list[TemperatureSample] = []
        self.changed = threading.Condition()
        self.thread = threading.Thread(target=self.driver.run, args=(self.sink,))

    def expose(self, request: ExposureRequest) -> NDArray[np.uint16]:
        self.starts_ns.append(request.start_mono_ns)
        return PATTERN

    def sink(self, record: Record) -> None:
        with self.changed:
            if isinstance(record, TemperatureSample):
                self.temperatures.append(record)
            if isinstance(record, Frame):
                self.frames.append(record)
                self.pictures.append(self.memory.pixels(record.slot))
                self.driver.recycle(record.slot)
            elif isinstance(record, DeviceEvent):
                self.events.append(record)
            self.changed.notify_all()

    def wait(self, is_so: Callable[[], bool], what: str) -> None:
        with self.changed:
            assert self.changed.wait_for(is_so, WITHIN_S), (
                f"{what}: {[e.sentence for e in self.events]} {dict(self.driver.statistics())}"
            )

    def wait_frames(self, count: int) -> None:
        self.wait(lambda: len(self.frames) >= count, f"{count} frames")

    def pulse(self, count: int) -> None:
        """A pulse on the line, once the head can take it."""
        self.emulated.line(time.monotonic_ns(), count)

    def start_on_host_ns(self, frame: Frame) -> int:
        """Start of exposure as the program computes it: device time through the latch."""
        assert frame.device_ns is not None
        assert frame.device_clock_ns is not None
        assert frame.device_clock_mono_ns is not None
        return frame.device_clock_mono_ns + frame.device_ns - frame.device_clock_ns

    @contextmanager
    def running(self) -> Iterator[Pair]:
        self.emulated.start()
        self.thread.start()
        pause = threading.Event()
        try:
            deadline = time.monotonic() + WITHIN_S
            while not (
                self.driver.state is LifeCycle.ACTIVE and self.emulated._acquisition.is_acquiring
            ):
                assert time.monotonic() < deadline, [e.sentence for e in self.events]
                pause.wait(0.01)
            yield self
        finally:
            self.driver.close()
            self.thread.join(10)
            self.emulated.close()


@contextmanager
def flying(
    count: int = 1, *, faults: WireFaults | None = None, **section: object
) -> Iterator[Sequence[Pair]]:
    with ExitStack() as stack:
        yield [
            stack.enter_context(Pair(n, faults or WireFaults(), section).running())
            for n in range(count)
        ]


@pytest.mark.parametrize("pixel_format", FORMATS)
def test_every_format_comes_as_right_justified_values_bit_for_bit(pixel_format: str) -> None:
    with flying(pixel_format=pixel_format, gain_db=6.5) as (pair,):
        for number in (1, 2):
            pair.pulse(number)
            pair.wait_frames(number)
    expected = PATTERN >> (12 - FORMATS[pixel_format])
    for picture in pair.pictures:
        np.testing.assert_array_equal(picture, expected)
    assert [f.status for f in pair.frames] == [FrameStatus.COMPLETE] * 2
    assert {f.pixel_format for f in pair.frames} == {pixel_format}
    # What the head wrote behind the pixels is read though they were moved.
    assert [f.counter for f in pair.frames] == [1, 2]
    assert [f.frame_id for f in pair.frames] == [1, 2]
    assert {f.exposure_time_us for f in pair.frames} == {EXPOSURE_US}
    assert {f.settings["Gain"] for f in pair.frames} == {6.5}
    assert {f.temperature_c for f in pair.frames} == {36.5}
    devices = [pair.clock.device_ns(start_ns) for start_ns in pair.starts_ns]
    assert [f.device_ns for f in pair.frames] == devices


def test_frames_whose_chunk_data_cannot_be_read_are_whole_and_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    written = acquisition.chunk_data

    def displaced(image_nbytes: int, chunks: Sequence[tuple[int, bytes]]) -> bytes:
        """Four bytes behind the last tag, as a Lucid TRI204S-C appends them."""
        return written(image_nbytes, chunks)[4:] + bytes(4)

    with flying() as (pair,):
        pair.pulse(1)
        pair.wait_frames(1)
        monkeypatch.setattr(acquisition, "chunk_data", displaced)
        for number in (2, 3):
            pair.pulse(number)
            pair.wait_frames(number)
        pair.wait(
            lambda: "chunks-unreadable" in [e.name for e in pair.events], "the report of chunks"
        )
        monkeypatch.undo()
        pair.pulse(4)
        pair.wait_frames(4)
        statistics = pair.driver.statistics()
    for picture in pair.pictures:
        np.testing.assert_array_equal(picture, PATTERN)
    assert [f.status for f in pair.frames] == [FrameStatus.COMPLETE] * 4
    assert [f.counter for f in pair.frames] == [1, None, None, 4]
    devices = [pair.clock.device_ns(start_ns) for start_ns in pair.starts_ns]
    assert [f.device_ns for f in pair.frames] == devices, "the leader packet has the time too"
    assert statistics["chunks_unreadable"] == 2
    (event,) = [e for e in pair.events if e.name == "chunks-unreadable"]
    assert event.is_fault and "set chunks = false" in event.sentence


def test_a_packed_frame_without_chunks_is_unpacked_alike() -> None:
    with flying(pixel_format="Mono12p", chunks=False) as (pair,):
        pair.pulse(1)
        pair.wait_frames(1)
    np.testing.assert_array_equal(pair.pictures[0], PATTERN)
    assert pair.frames[0].counter is None
    assert pair.frames[0].temperature_c == 36.5, "asked for, since the frame does not say"


def test_the_heads_own_thermometer_is_a_probe_where_it_is_named() -> None:
    with flying(temperature_probe="3", latch_interval_s=0.5) as (pair,):
        deadline = time.monotonic() + WITHIN_S
        while len(pair.temperatures) < 2 and time.monotonic() < deadline:
            time.sleep(0.05)
    assert {(t.probe, t.value_c) for t in pair.temperatures} == {("3", 36.5)}
    first, second = pair.temperatures[:2]
    assert second.mono_ns > first.mono_ns
    with flying(latch_interval_s=0.5) as (pair,):
        pair.pulse(1)
        pair.wait_frames(1)
    assert pair.temperatures == []


def test_heads_are_found_with_what_reaches_them() -> None:
    from daemon.cli.find_heads import found_heads

    with flying(2) as pairs:
        addresses = [pair.driver.address for pair in pairs]
        # A reply may come too late on a busy machine, as it may be lost on a busy network.
        for _ in range(5):
            found, _ = found_heads()
            ours = [head for head in found if head["settings"].get("address") in addresses]
            if len(ours) == len(pairs):
                break
    assert [head["settings"]["serial"] for head in ours] == ["E-0", "E-1"]
    assert {head["driver"] for head in ours} == {"aravis"}
    assert {head["found"]["vendor"] for head in ours} == {"Peer"}


def test_a_format_that_is_no_survey_frame_is_refused_by_the_settings() -> None:
    problems = AravisHead.problems({"address": "127.77.9.1", "pixel_format": "RGB8"})
    assert problems == [
        "pixel_format is 'RGB8'; a GenICam name of 8 to 16 bits, monochrome or Bayer, such as "
        "Mono12p or BayerRG12"
    ]


def test_an_action_command_exposes_at_once() -> None:
    with flying(trigger_source="action") as (pair,):
        before_ns = time.monotonic_ns()
        pair.driver.trigger()
        after_ns = time.monotonic_ns()
        pair.wait_frames(1)
    assert before_ns <= pair.starts_ns[0] <= after_ns
    assert pair.driver.statistics()["actions"] == 1
    assert pair.emulated.statistics()["actions"] == 1


def test_scheduled_actions_expose_heads_at_their_delays_whatever_their_clocks() -> None:
    delays_ns = {"A": 0, "B": 30_000_000, "C": 12_000_000}
    with flying(3, trigger_source="action", latch_interval_s=0.5) as pairs:
        heads = {output: [pair.driver] for output, pair in zip(delays_ns, pairs, strict=True)}
        trigger = ActionTrigger("trigger", {"lead_ms": 400.0}, heads=heads)
        assert trigger.bind()["actions"] == "scheduled"
        trigger.program(delays_ns)
        pulses = []
        for sequence in range(1, 4):
            pulses.append(trigger.fire(sequence))
            for pair in pairs:
                pair.wait_frames(sequence)
        trigger.close()
    for pair, delay_ns in zip(pairs, delays_ns.values(), strict=True):
        for pulse, start_ns in zip(pulses, pair.starts_ns, strict=True):
            error_ns = start_ns - (pulse.mono_ns + delay_ns)
            # The sigma is half the width of what the latches allow; the emulator adds nothing.
            assert abs(error_ns) <= pulse.sigma_ns + 1_000, f"{error_ns} ns off"
    assert all(pulse.sigma_ns < 50_000_000 for pulse in pulses)
    assert [pulse.count for pulse in pulses] == [1, 2, 3]


def test_an_action_that_comes_after_its_time_is_reported_as_late() -> None:
    with flying(trigger_source="action") as (pair,):
        now_ns = pair.clock.device_ns(time.monotonic_ns())
        with pytest.raises(DeviceError, match="after its time; increase lead_ms"):
            pair.driver.send_action_command(now_ns - 1_000_000_000)
        pair.wait_frames(1)
    assert pair.driver.statistics()["actions_late"] == 1


def test_an_action_that_means_other_heads_is_reported_as_not_taken() -> None:
    with flying(trigger_source="action", action_group_mask=0b100) as (pair,):
        # Somebody else has given the head another group.
        pair.emulated._registers.set_register(0x9804, 0b010)
        with pytest.raises(DeviceError, match="was not accepted"):
            pair.driver.trigger()
    assert pair.emulated.statistics()["actions_ignored"] == 1


def test_a_trigger_of_actions_refuses_heads_that_wait_for_something_else() -> None:
    head = AravisHead("SU00", {"address": "127.77.9.1"}, memory=Memory())
    with pytest.raises(DeviceError, match=r'SU00 waits for no action command.*"action"'):
        ActionTrigger("trigger", {}, heads={"A": [head]})


def test_lost_packets_are_requested_again_and_counted() -> None:
    faults = WireFaults(packet_loss=0.02)
    with flying(faults=faults, packet_size=1500, pixel_format="Mono12p") as (pair,):
        for number in range(1, 9):
            pair.pulse(number)
            pair.wait_frames(number)
    statistics = pair.driver.statistics()
    assert statistics["frames"] == 8
    assert statistics["resent_packets"] > 0
    assert statistics["resent_packets"] <= pair.emulated.statistics()["packets_resent"]
    assert statistics["resend_requests"] >= statistics["resent_packets"]
    for picture in pair.pictures:
        np.testing.assert_array_equal(picture, PATTERN)


@pytest.mark.parametrize(
    ("section", "packet_size"),
    [({"packet_size": 1500}, 1500), ({"packet_size_limit": 4000}, 4000)],
    ids=["given", "negotiated up to the limit"],
)
def test_packets_have_the_size_that_was_given_or_passes(
    section: dict[str, object], packet_size: int
) -> None:
    with flying(**section) as (pair,):
        pair.pulse(1)
        pair.wait_frames(1)
    assert pair.frames[0].settings["GevSCPSPacketSize"] == packet_size


def fault(name: str, at_pulse: int) -> WireFaults:
    return WireFaults(planned=(PlannedFault(name, "SU00", None, at_pulse, None, 0.0),))


def test_a_half_frame_is_incomplete_and_the_next_one_is_itself() -> None:
    with flying(faults=fault("half-frame", 2), pixel_format="Mono12Packed") as (pair,):
        for number in (1, 2, 3):
            pair.pulse(number)
            pair.wait_frames(number)
    statuses = [f.status for f in pair.frames]
    assert statuses == [FrameStatus.COMPLETE, FrameStatus.INCOMPLETE, FrameStatus.COMPLETE]
    assert [pair.frames[i].counter for i in (0, 2)] == [1, 3]
    rows = SHAPE[0] // 2 - 8
    np.testing.assert_array_equal(pair.pictures[1][:rows], PATTERN[:rows])
    np.testing.assert_array_equal(pair.pictures[2], PATTERN)
    assert pair.driver.statistics()["frames_incomplete"] == 1


def test_a_frame_older_than_its_trigger_reports_it_by_time_and_count() -> None:
    with flying(faults=fault("older-frame", 3)) as (pair,):
        for number in (1, 2, 3, 4):
            pair.pulse(number)
            pair.wait_frames(number)
    devices = [pair.clock.device_ns(start_ns) for start_ns in pair.starts_ns]
    assert [f.counter for f in pair.frames] == [1, 2, 2, 4]
    assert [f.device_ns for f in pair.frames] == [devices[i] for i in (0, 1, 1, 3)]


def test_the_first_frame_after_idle_that_never_comes_shifts_nothing() -> None:
    with flying(faults=WireFaults(drop_frame=frozenset({1}))) as (pair,):
        for number in (1, 2, 3):
            pair.pulse(number)
            threading.Event().wait(0.05)
        pair.wait_frames(2)
    assert [f.counter for f in pair.frames] == [2, 3]
    devices = [pair.clock.device_ns(start_ns) for start_ns in pair.starts_ns]
    assert [f.device_ns for f in pair.frames] == devices[1:]
    assert [f.frame_id for f in pair.frames] == [1, 2], "the wire's number would have shifted"
