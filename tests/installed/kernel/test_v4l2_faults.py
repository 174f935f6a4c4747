"""Every fault vivid can inject is detected and reported, and the head reconnects."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import pytest

from drivers.contract import DeviceError, FrameStatus
from tests.installed.kernel import vivid

SIZE = {"width_px": 320, "height_px": 180, "pixel_format": "Y12", "frame_interval_s": 0.02}
"""The smallest picture at its fastest: the processor is emulated."""


@pytest.fixture(autouse=True)
def webcam() -> Iterator[None]:
    """A webcam of vivid's, with controls of gain and automatic gain."""
    vivid.load(node_types="0x1", input_types="0x0", num_inputs=1, multiplanar=1)
    yield
    vivid.unload()
    assert vivid.descriptors() == set(), "no descriptor is left open"
    assert vivid.mappings() == 0, "no mapping is left"


def flight(**more: object) -> vivid.Flight:
    return vivid.Flight(**{**SIZE, "keep_frames": 0, **more})


def test_dropped_frames_are_gaps_that_are_counted_one_by_one() -> None:
    with flight() as head:
        head.wait_frames(3)
        vivid.set_control(0, "percentage_of_dropped_buffers", 40)
        head.wait_count("frames_missing", 5)
        vivid.set_control(0, "percentage_of_dropped_buffers", 0)
        head.wait_frames(5)
    counters = [frame.counter for frame in head.frames if frame.counter is not None]
    gaps = sum(b - a - 1 for a, b in itertools.pairwise(counters) if b > a)
    statistics = head.head.statistics()
    assert statistics["frames_missing"] == gaps + counters[0] - 1
    assert counters[-1] == statistics["frames"] + statistics["frames_missing"]
    assert [n for n in head.names if n != "opened"] == ["frames-missing"]
    assert statistics["opened"] == 1


def test_a_silent_head_is_reported_and_reopened_until_it_sends_again() -> None:
    with flight(silence_s=1.0) as head:
        head.wait_frames(2)
        vivid.set_control(0, "percentage_of_dropped_buffers", 100)
        head.wait_event("lost")
        vivid.set_control(0, "percentage_of_dropped_buffers", 0)
        head.wait_frames(3)
    reported = next(event for event in head.events if event.name == "lost")
    assert "no frame came for 1 s" in reported.sentence
    assert head.reported == ["opened", "lost", "opened"], "opened again with its first frame"
    assert head.head.statistics()["silences"] >= 1


def test_a_frame_with_the_kernels_error_flag_is_incomplete_though_it_is_whole_in_size() -> None:
    with flight() as head:
        head.wait_frames(2)
        vivid.set_control(0, "inject_v4l2_buf_flag_error", 1)
        head.wait_count("frames_incomplete", 1)
        head.wait_frames(3)
    statuses = [frame.status for frame in head.frames]
    assert statuses.count(FrameStatus.INCOMPLETE) == 1
    assert statuses[-1] is FrameStatus.COMPLETE
    assert head.reported == ["opened"], "the stream goes on as it was"


def test_a_buffer_the_kernel_refuses_once_is_given_again() -> None:
    with flight() as head:
        head.wait_frames(2)
        vivid.set_control(0, "inject_vidioc_qbuf_error", 1)
        head.wait_count("queue_failures", 1)
        head.wait_frames(10)
    assert head.head.statistics()["queue_failures"] == 1
    assert head.reported == ["opened"]


@pytest.mark.parametrize("name", ["inject_vidioc_reqbufs_error", "inject_vidioc_streamon_error"])
def test_a_start_that_fails_once_is_tried_again(name: str) -> None:
    vivid.set_control(0, name, 1)
    with flight() as head:
        head.wait_frames(3)
    assert head.reported == ["lost", "opened"]
    assert [e.is_fault for e in head.events if e.name in head.reported] == [True, False]


def test_a_stream_that_ends_for_good_is_reopened() -> None:
    with flight() as head:
        head.wait_frames(3)
        vivid.set_control(0, "inject_fatal_streaming_error", 1)
        head.wait_event("opened", 2)
        head.wait_frames(3)
    assert head.reported == ["opened", "lost", "opened"]
    lost = next(event for event in head.events if event.name == "lost")
    assert "its stream broke off" in lost.sentence
    ids = [frame.frame_id for frame in head.frames]
    assert min(ids[3:]) < 3, "the sequence restarted"


def test_an_unplugged_head_is_noticed_let_go_of_and_found_again() -> None:
    with flight() as head:
        head.wait_frames(3)
        vivid.set_control(0, "disconnect", 1)
        head.wait_event("lost")
        # vivid is there again once the last handle and mapping of it are gone.
        head.wait_event("opened", 2)
        head.wait_frames(3)
    assert head.reported[:2] == ["opened", "lost"]
    assert head.head.statistics()["opened"] == 2


def test_an_unplugged_head_is_noticed_while_it_waits_for_a_trigger() -> None:
    with flight() as head:
        head.wait_frames(1)
        vivid.set_control(0, "percentage_of_dropped_buffers", 100)
        vivid.set_control(0, "disconnect", 1)
        head.wait_event("lost")
        head.wait_event("opened", 2)


def test_a_sequence_number_that_wraps_loses_nothing() -> None:
    vivid.set_control(0, "wrap_sequence_number", 1)
    with flight() as head:
        head.wait(lambda: any(3 < f.frame_id < 1 << 31 for f in head.frames), "a wrapped number")
    ids = [frame.frame_id for frame in head.frames]
    assert ids[0] > 1 << 31
    counters = [frame.counter for frame in head.frames if frame.counter is not None]
    steps = [b - a for a, b in itertools.pairwise(counters)]
    assert steps == [(b - a) % (1 << 32) for a, b in itertools.pairwise(ids)]
    assert counters[0] == 1
    assert head.head.statistics()["frames_missing"] == sum(steps) - len(steps)


@pytest.mark.parametrize("choice", [1, 2])
def test_a_time_of_no_possible_world_is_no_time(choice: int) -> None:
    vivid.set_control(0, "timestamp_source", 1)
    vivid.set_control(0, "wrap_timestamp", choice)
    with flight() as head:
        head.wait_frames(4)
    assert [frame.device_ns for frame in head.frames[:4]] == [None] * 4
    assert head.head.statistics()["stamps_implausible"] >= 4
    assert head.reported == ["opened"]


def test_all_slots_taken_is_a_frame_lost_and_the_stream_goes_on() -> None:
    head = flight(slot_count=3)
    head.recycle = False
    with head:
        head.wait_count("underruns", 4)
        taken = [frame.slot for frame in head.frames]
        assert sorted(taken) == [0, 1, 2]
        head.recycle = True
        for slot in taken:
            head.head.recycle(slot)
        with pytest.raises(ValueError, match="was not handed out"):
            head.head.recycle(7)
        head.wait_frames(5)
    assert head.reported == ["opened", "underrun"]


def test_a_head_that_another_program_streams_from_is_waited_for() -> None:
    with flight() as first:
        first.wait_frames(2)
        with flight() as second:
            second.wait_event("lost")
            first.head.close()
            second.wait_frames(2)
    lost = next(event for event in second.events if event.name == "lost")
    assert "busy" in lost.sentence.lower()


def test_an_absent_head_is_reported_with_its_cure() -> None:
    vivid.unload()
    with pytest.raises(DeviceError, match="there is no such node; check cable and power"):
        flight().head.bind()
    with flight() as head:
        head.wait_event("lost")
        vivid.load(node_types="0x1", input_types="0x0", num_inputs=1, multiplanar=1)
        head.wait_frames(2)
    assert head.reported == ["lost", "opened"]


def test_a_format_that_another_program_changes_before_the_stream_is_set_again() -> None:
    head = flight()
    head.head.bind()
    vivid.ctl(0, "--set-fmt-video=width=640,height=360,pixelformat=GREY")
    with head:
        head.wait_event("lost")
        head.wait_frames(2)
    lost = next(event for event in head.events if event.name == "lost")
    assert "another program changed its format" in lost.sentence
    assert head.head.statistics()["formats_changed"] == 1
    assert {(f.width_px, f.height_px, f.pixel_format) for f in head.frames} == {(320, 180, "Y12")}
