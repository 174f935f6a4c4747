"""The folder head: a mission's frames again, in order, into memory; and files that are none."""

from __future__ import annotations

import ctypes
import itertools
import tempfile
import threading
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from daemon.mission.store.level0 import tiff_parts
from drivers.cameras.folder.folder_head import FolderHead
from drivers.cameras.folder.frames import FrameFileError, read_frame
from drivers.contract import CHUNK_ALLOWANCE_NBYTES, DeviceError, Frame, FrameStatus, Record
from tests.drivers.fakes import FakeClock, RecordingSink

HEIGHT, WIDTH = 6, 8
KNOWN: dict[str, object] = {
    "syntopic": 1,
    "head_serial": "SN-7",
    "pixel_format": "Mono12",
    "device_ns": "1447000001000000001",
    "counter": 41,
    "exposure_time_us": 1250.5,
    "temperature_c": 31.5,
    "settings": {"Gain": 2.0, "GevSCPSPacketSize": 8192},
}


class Memory:
    """Slots in this process."""

    def __init__(self, slot_count: int = 3) -> None:
        self.slot_count = slot_count
        self.slot_nbytes = HEIGHT * WIDTH * 2 + CHUNK_ALLOWANCE_NBYTES
        self._slots = [ctypes.create_string_buffer(self.slot_nbytes) for _ in range(slot_count)]

    def address(self, slot: int) -> int:
        return ctypes.addressof(self._slots[slot])

    def pixels(self, frame: Frame) -> NDArray[np.uint16]:
        shape = frame.height_px, frame.width_px
        count = shape[0] * shape[1]
        return np.frombuffer(self._slots[frame.slot].raw, np.uint16, count).reshape(shape)


def image(number: int, height: int = HEIGHT, width: int = WIDTH) -> NDArray[np.uint16]:
    return (np.arange(height * width, dtype=np.uint16) + 1000 * number).reshape(height, width)


def mission(root: Path, numbers: range = range(1, 5), **known: object) -> Path:
    """Level-0 as the service writes it."""
    for number in numbers:
        path = root / "L0" / f"{number:06d}" / "SU00.tif"
        path.parent.mkdir(parents=True)
        parts = tiff_parts([image(number)], {**KNOWN, "exposure": number, **known})
        path.write_bytes(b"".join(bytes(part) for part in parts))
    return root / "L0"


class Player:
    """Runs a head that plays by its interval, until so many frames or faults have come."""

    def __init__(self, section: Mapping[str, object], *, slot_count: int = 3) -> None:
        self.memory = Memory(slot_count)
        self.clock = FakeClock()
        line = {"trigger_source": "line", **section}
        self.head = FolderHead("SU00", line, memory=self.memory, clock=self.clock)
        self.recorder = RecordingSink()
        self.pixels: list[NDArray[np.uint16]] = []

    @property
    def frames(self) -> list[Frame]:
        return [record for record in self.recorder.records if isinstance(record, Frame)]

    def play(self, until: Callable[[Player], bool], *, recycle: bool = True) -> Player:
        def watch(record: Record) -> None:
            if isinstance(record, Frame):
                self.pixels.append(self.memory.pixels(record))
                if recycle:
                    self.head.recycle(record.slot)
            if until(self):
                self.head._closing.set()

        self.recorder.stop = watch
        self.head.run(self.recorder)
        return self


def played_out(player: Player) -> bool:
    return "played-out" in player.recorder.event_names


def test_a_mission_is_played_in_order_with_what_its_capture_knew(tmp_path: Path) -> None:
    player = Player({"folder": str(mission(tmp_path)), "interval_s": 0.5}).play(played_out)
    assert [frame.status for frame in player.frames] == [FrameStatus.COMPLETE] * 4
    for number, (frame, pixels) in enumerate(zip(player.frames, player.pixels, strict=True), 1):
        assert np.array_equal(pixels, image(number))
        assert (frame.frame_id, frame.counter) == (number, number)
    first = player.frames[0]
    assert (first.device_ns, first.device_clock_ns) == (1447000001000000001, None)
    assert (first.exposure_time_us, first.temperature_c) == (1250.5, 31.5)
    assert first.pixel_format == "Mono12"
    assert (first.settings["Gain"], first.settings["recorded_counter"]) == (2.0, 41)
    gaps_ns = {b.mono_ns - a.mono_ns for a, b in itertools.pairwise(player.frames)}
    assert gaps_ns == {500_000_000}


def test_a_folder_of_others_is_played_in_the_order_of_numbers(tmp_path: Path) -> None:
    for number in (10, 9, 1):
        tifffile.imwrite(tmp_path / f"img_{number}.tif", image(number), compression="zlib")
    (tmp_path / "notes.txt").write_text("none")
    player = Player({"folder": str(tmp_path), "pattern": "*.tif"}).play(played_out)
    assert [int(pixels[0, 0]) for pixels in player.pixels] == [1000, 9000, 10000]
    assert {frame.device_ns for frame in player.frames} == {None}


def test_a_loop_begins_again(tmp_path: Path) -> None:
    section = {"folder": str(mission(tmp_path)), "loop": True}
    player = Player(section).play(lambda player: len(player.frames) == 10)
    assert [int(p[0, 0]) // 1000 for p in player.pixels] == [1, 2, 3, 4, 1, 2, 3, 4, 1, 2]
    assert [frame.counter for frame in player.frames] == list(range(1, 11))
    assert player.head.statistics()["rounds"] == 2


def test_without_a_free_slot_a_frame_is_lost_and_counted(tmp_path: Path) -> None:
    section = {"folder": str(mission(tmp_path))}
    player = Player(section, slot_count=2).play(played_out, recycle=False)
    assert [frame.counter for frame in player.frames] == [1, 2]
    assert player.head.statistics()["underruns"] == 2
    assert "underrun" in player.recorder.event_names
    with pytest.raises(ValueError, match="slot 7 was not handed out"):
        player.head.recycle(7)


def test_a_damaged_file_costs_its_own_frame_only(tmp_path: Path) -> None:
    folder = mission(tmp_path)
    broken = folder / "000002" / "SU00.tif"
    broken.write_bytes(broken.read_bytes()[:4110])
    (folder / "000003" / "SU00.tif").unlink()
    (folder / "000003" / "SU00.tif").mkdir()
    tifffile.imwrite(folder / "000004" / "SU00.tif", image(4, 3, 4))
    player = Player({"folder": str(folder)}).play(played_out)
    assert [(f.counter, f.status.value) for f in player.frames] == [(1, "complete"), (3, "corrupt")]
    assert (player.frames[1].height_px, player.frames[1].width_px) == (3, 4)
    counted = player.head.statistics()
    assert (counted["unreadable"], counted["frames"], counted["frames_corrupt"]) == (1, 1, 1)


def test_a_frame_larger_than_the_memory_is_never_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "huge.tif"
    tifffile.imwrite(path, np.zeros((3000, 3000), np.uint16), compression="zlib")
    with pytest.raises(FrameFileError, match="3000 x 3000 px; the head's memory holds 1000"):
        read_frame(path, max_nbytes=2000)


@pytest.mark.parametrize(
    "array", [np.zeros((4, 4), np.uint8), np.zeros((3, 4, 4), np.uint16), np.zeros((4, 4), "f4")]
)
def test_only_one_plane_of_16_bits_is_a_frame(tmp_path: Path, array: NDArray[np.uint16]) -> None:
    planes = {"photometric": "rgb", "planarconfig": "separate"} if array.ndim == 3 else {}
    tifffile.imwrite(tmp_path / "a.tif", array, **planes)
    with pytest.raises(FrameFileError, match="one plane of uint16 is needed"):
        read_frame(tmp_path / "a.tif", max_nbytes=10_000)


@settings(max_examples=150, deadline=None)
@given(
    changes=st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255)), max_size=6),
    end=st.integers(0, 5000),
)
def test_a_mutated_file_is_a_frame_of_its_size_or_is_refused(
    changes: list[tuple[int, int]], end: int
) -> None:
    data = bytearray(b"".join(bytes(part) for part in tiff_parts([image(1)], KNOWN)))
    for at, value in changes:
        data[at] = value
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.tif"
        path.write_bytes(data[:end] if end < 4000 else data)
        try:
            frame = read_frame(path, max_nbytes=10_000)
        except FrameFileError:
            return
    assert frame.pixels.dtype == np.uint16
    assert frame.pixels.nbytes <= 10_000


def test_software_triggers_play_one_file_each_and_say_when_there_are_no_more(
    tmp_path: Path,
) -> None:
    memory = Memory()
    head = FolderHead("SU00", {"folder": str(mission(tmp_path, range(1, 3)))}, memory=memory)
    with pytest.raises(DeviceError, match="not running"):
        head.trigger()
    recorder = RecordingSink()
    opened, came = threading.Event(), threading.Semaphore(0)

    def watch(record: Record) -> None:
        if isinstance(record, Frame):
            came.release()
        elif not opened.is_set():
            head.trigger()
            opened.set()

    recorder.stop = watch
    thread = threading.Thread(target=head.run, args=(recorder,))
    thread.start()
    try:
        assert opened.wait(5), "an open head can be triggered"
        assert came.acquire(timeout=5)
        head.trigger()
        assert came.acquire(timeout=5)
        with pytest.raises(DeviceError, match="all 2 files are played; set loop = true"):
            head.trigger()
    finally:
        head.close()
        thread.join(5)
    assert not thread.is_alive()
    frames = [record for record in recorder.records if isinstance(record, Frame)]
    assert [int(memory.pixels(frame)[0, 0]) for frame in frames] == [1000, 2000]


def test_a_head_that_plays_by_its_interval_takes_no_trigger(tmp_path: Path) -> None:
    head = Player({"folder": str(mission(tmp_path))}).head
    with pytest.raises(DeviceError, match='set trigger_source = "software"'):
        head.trigger()


def test_binding_states_what_is_there_or_missing(tmp_path: Path) -> None:
    folder = mission(tmp_path)
    found = Player({"folder": str(folder)}).head.bind()
    assert (found["files"], found["serial"], found["frame"]) == ("4", "SN-7", "8 x 6 Mono12")
    with pytest.raises(DeviceError, match="is no folder"):
        Player({"folder": str(tmp_path / "none")}).head.bind()
    with pytest.raises(DeviceError, match=r"no file below .* fits \*/SU00.png"):
        Player({"folder": str(folder), "pattern": "*/{head}.png"}).head.bind()
    assert FolderHead.problems({"folder": "/a", "pattern": "/etc/*.tif"}) == [
        "pattern is '/etc/*.tif'; a path below folder, such as */{head}.tif"
    ]
    assert FolderHead.problems({"folder": "/a", "pattern": "../*.tif"})
    assert FolderHead.problems({"folder": "/a", "pattern": "a**/b"})


def test_a_folder_that_comes_later_is_found(tmp_path: Path) -> None:
    player = Player({"folder": str(tmp_path / "L0")})

    def create(player: Player) -> bool:
        if player.recorder.event_names == ["lost"]:
            mission(tmp_path)
        return played_out(player)

    player.play(create)
    assert player.recorder.event_names == ["lost", "opened", "played-out"]
    assert len(player.frames) == 4


def test_what_a_frame_was_exposed_with_cannot_be_changed(tmp_path: Path) -> None:
    head = FolderHead("SU00", {"folder": str(tmp_path)}, memory=Memory())
    with pytest.raises(DeviceError, match="as they were exposed once"):
        head.adjust(1000.0, 0.0, 0)
