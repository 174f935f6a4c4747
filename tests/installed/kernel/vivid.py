"""The kernel's vivid driver as a bench: heads, frames of our own fed through them, and faults.

Set up and fed by v4l2-ctl, which we did not write.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.v4l2.v4l2_head import V4l2Head
from drivers.contract import DeviceEvent, Frame, LifeCycle, Record

GUEST = Path(os.environ.get("KERNEL_GUEST", "/dev/kernel-guest"))
TIMEOUT_S = 60.0
UNTOUCHED = 0xA5A5


def load(**parameters: object) -> None:
    """Load vivid again."""
    unload()
    arguments = [f"{name}={value}" for name, value in parameters.items()]
    subprocess.run(["insmod", GUEST / "modules/vivid.ko", *arguments], timeout=60, check=True)


def unload() -> None:
    subprocess.run(["rmmod", "vivid"], capture_output=True, timeout=60, check=False)


def ctl(node: int, *arguments: str) -> str:
    """Run v4l2-ctl on a node; its output."""
    done = subprocess.run(
        ["v4l2-ctl", "-d", f"/dev/video{node}", *arguments],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, f"v4l2-ctl {arguments}: {done.stdout}{done.stderr}"
    return done.stdout


def set_control(node: int, name: str, value: int) -> None:
    ctl(node, "-c", f"{name}={value}")


class Memory:
    """Slots in an anonymous mapping, filled with a pattern no frame has."""

    def __init__(self, nbytes: int, slot_count: int) -> None:
        self.slot_count = slot_count
        self.slot_nbytes = nbytes + 4096
        mapping = mmap.mmap(-1, slot_count * self.slot_nbytes)
        self.slots = np.frombuffer(mapping, np.uint16).reshape(slot_count, -1)
        self.slots[:] = UNTOUCHED

    def address(self, slot: int) -> int:
        return int(self.slots[slot].ctypes.data)


class Flight:
    """A head in its thread, and what it yielded."""

    def __init__(
        self,
        *,
        nbytes: int = 1280 * 720 * 2,
        slot_count: int = 4,
        keep_frames: int = 400,
        **section: object,
    ) -> None:
        self.memory = Memory(nbytes, slot_count)
        self.head = V4l2Head(
            "SU00",
            {"device": "/dev/video0", "check_interval_s": 0.5, **section},
            memory=self.memory,
        )
        self.keep_frames = keep_frames
        self.recycle = True
        self.frames: list[Frame] = []
        self.pictures: list[NDArray[np.uint16]] = []
        self.behind: list[bool] = []
        self.events: list[DeviceEvent] = []
        self.changed = threading.Condition()
        self.thread = threading.Thread(target=self.head.run, args=(self.sink,))

    def sink(self, record: Record) -> None:
        with self.changed:
            if isinstance(record, Frame):
                count = record.width_px * record.height_px
                slot = self.memory.slots[record.slot]
                if len(self.pictures) < self.keep_frames:
                    self.pictures.append(slot[:count].reshape(record.height_px, -1).copy())
                    self.behind.append(bool((slot[count:] == UNTOUCHED).all()))
                self.frames.append(record)
                if self.recycle:
                    self.head.recycle(record.slot)
            elif isinstance(record, DeviceEvent):
                self.events.append(record)
            self.changed.notify_all()

    def __enter__(self) -> Flight:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.head.close()
        self.thread.join(10)
        assert not self.thread.is_alive(), "run goes on after close"
        assert self.head.state is LifeCycle.INACTIVE

    def wait(self, true: Callable[[], bool], what: str) -> None:
        with self.changed:
            assert self.changed.wait_for(true, TIMEOUT_S), (
                f"{what} did not come: {self.names}, {dict(self.head.statistics())}, "
                f"{[event.sentence for event in self.events][-1:]}"
            )

    def wait_frames(self, more: int) -> None:
        """Wait for so many further frames."""
        wanted = len(self.frames) + more
        self.wait(lambda: len(self.frames) >= wanted, f"{more} frames")

    def wait_event(self, name: str, times: int = 1) -> None:
        self.wait(lambda: self.names.count(name) >= times, f"event {name}")

    def wait_count(self, counter: str, min_count: int) -> None:
        deadline = time.monotonic() + TIMEOUT_S
        pause = threading.Event()
        while self.head.statistics().get(counter, 0) < min_count:
            assert time.monotonic() < deadline, f"{counter}: {dict(self.head.statistics())}"
            pause.wait(0.05)

    @property
    def names(self) -> list[str]:
        return [event.name for event in self.events]

    @property
    def reported(self) -> list[str]:
        """Events other than missing frames: a slow host loses some of its own."""
        return [name for name in self.names if name != "frames-missing"]


@contextlib.contextmanager
def feeding(path: Path, *, node: int = 1) -> Iterator[None]:
    """Frames of a file, over and over, into vivid's output node."""
    command = ["v4l2-ctl", "-d", f"/dev/video{node}", "--stream-out-mmap=4", "--stream-loop"]
    with subprocess.Popen(
        [*command, f"--stream-from={path}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as feeder:
        try:
            yield
        finally:
            feeder.kill()


def descriptors() -> set[str]:
    """Video nodes this process holds open."""
    found = set()
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            target = str(entry.readlink())
            if "/dev/video" in target:
                found.add(target)
    return found


def mappings() -> int:
    """Mappings of video nodes in this process."""
    return Path("/proc/self/maps").read_text(encoding="utf-8").count("/dev/video")


MARK = (0xAB, 0x12, 0xCD, 0x34, 0xEF)
"""Begins every frame of ours; fits into 8 bits."""


def frame_of_ours(
    rng: np.random.Generator, number: int, shape: tuple[int, int], bits: int
) -> NDArray[np.uint16]:
    """A frame of noise that begins with the mark and its number."""
    frame = rng.integers(0, 1 << bits, shape, dtype=np.uint16)
    frame[0, : len(MARK)] = MARK
    frame[0, len(MARK)] = number
    return frame


def number_of(picture: NDArray[np.uint16]) -> int | None:
    """The number of a frame of ours; None for pictures of vivid's own."""
    return int(picture[0, len(MARK)]) if tuple(picture[0, : len(MARK)]) == MARK else None
