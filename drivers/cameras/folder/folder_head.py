"""A folder of frames as a head: played into memory at every trigger or at an interval.

What a file holds is in `drivers.cameras.folder.frames`.
"""

from __future__ import annotations

import queue
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, ClassVar, Final

from drivers.base.settings import Setting
from drivers.cameras.head_device import HeadDevice
from drivers.cameras.pixels import words_at
from drivers.contract import (
    DeviceError,
    Frame,
    FrameMemory,
    FrameStatus,
    LifeCycle,
    Sink,
)
from drivers.timescales.clock import Clock

if TYPE_CHECKING:
    from drivers.cameras.folder.frames import FrameFile

WAIT_STEP_S: Final = 0.1
MAX_QUEUED_TRIGGERS: Final = 16
"""So many triggers may wait while a file is read; a head in the air forgets them sooner."""


class FolderHead(HeadDevice):
    """Frames of a mission's Level-0, or of a folder of 16-bit TIFFs, as if a head had them.

    Each trigger (or interval) plays the next file: COMPLETE, or CORRUPT where its size is not that
    of the first one. A file that cannot be read is a frame lost, and so is one that is due while
    all slots are taken (an underrun). `counter` counts all that were due. Where the files are
    ours, `device_ns`, exposure time, temperature and settings are those of the capture; the
    recorded head's clock has no latch on this host, so `device_clock_ns` is None.

    Source: docs/reference/formats.md, Level-0 frames.
    """

    kind: ClassVar = "head"
    counted: ClassVar = ("frames", "frames_corrupt", "unreadable", "underruns", "opened", "rounds")

    folder = Setting("", required=True, help="folder of the frames, such as MISSION/L0")
    pattern = Setting("*/{head}.tif", help="files below it; {head} is the head's name, * any text")
    loop = Setting(False, help="begin again after the last file")
    trigger_source = Setting(
        "software", choices=("software", "line"), help="who fires; line: the interval does"
    )
    interval_s = Setting(1.0, minimum=0.01, maximum=3600, help="from frame to frame with line")

    def __init__(
        self,
        name: str,
        settings: Mapping[str, object],
        *,
        memory: FrameMemory,
        clock: Clock | None = None,
    ) -> None:
        super().__init__(name, settings, memory=memory, clock=clock)
        self._waiting: queue.Queue[int] = queue.Queue(MAX_QUEUED_TRIGGERS)
        self._files: list[Path] = []
        self._next_file = 0
        self._due = 0
        self._shape: tuple[int, int] | None = None

    @classmethod
    def setting_conflicts(cls, values: Mapping[str, Any]) -> list[str]:
        pattern = PurePosixPath(values["pattern"])
        if not pattern.parts or pattern.is_absolute() or ".." in pattern.parts:
            return [
                f"pattern is {values['pattern']!r}; a path below folder, such as */{{head}}.tif"
            ]
        if any("**" in part and part != "**" for part in pattern.parts):
            return [f"pattern is {values['pattern']!r}; ** stands alone between slashes"]
        return []

    def bind(self, sink: Sink | None = None) -> Mapping[str, str]:
        """Find the files and read the first. See `drivers.contract.Head`.

        Args:
            sink: not used.

        Returns:
            Model, serial number of the recorded head, folder, number of files and size of a frame.

        Raises:
            DeviceError: the folder has no suitable file, or the first one cannot be read.
        """
        from drivers.cameras.folder.frames import FrameFileError, frame_files, read_frame

        pattern = self.pattern.replace("{head}", self.name)
        folder = Path(self.folder)
        if not folder.is_dir():
            raise DeviceError(f"{self.name}: {folder} is no folder; set folder to where frames are")
        try:
            self._files = frame_files(folder, pattern)
        except OSError as error:
            raise DeviceError(
                f"{self.name}: {folder} cannot be read ({error}); check its permissions"
            ) from error
        if not self._files:
            raise DeviceError(f"{self.name}: no file below {folder} fits {pattern}; check pattern")
        try:
            first = read_frame(self._files[0], max_nbytes=self._memory.slot_nbytes)
        except FrameFileError as error:
            raise DeviceError(
                f"{self.name}: {self._files[0]} {error}; take it out or choose another pattern"
            ) from error
        self._shape = first.pixels.shape[0], first.pixels.shape[1]
        self._next_file = 0
        self._state = LifeCycle.BOUND
        return {
            "model": "folder",
            "serial": first.head_serial,
            "folder": str(folder),
            "files": str(len(self._files)),
            "frame": f"{self._shape[1]} x {self._shape[0]} {first.pixel_format}",
        }

    def adjust(self, exposure_time_us: float, gain_db: float, tdi_shifts: int) -> None:
        """Refused: the frames are exposed already."""
        raise DeviceError(
            f"{self.name}: frames of a folder are as they were exposed once; fly them with "
            '[exposure] control = "manual"'
        )

    def trigger(self) -> None:
        """Play the next file; from any thread. See `drivers.contract.Head`.

        Raises:
            DeviceError: the head plays by its interval, is not running, has played all files, or
                MAX_QUEUED_TRIGGERS triggers are waiting.
        """
        if self.trigger_source != "software":
            raise DeviceError(
                f"{self.name}: the head plays by its interval; set trigger_source = "
                '"software" to trigger it from here'
            )
        if self._state is not LifeCycle.ACTIVE:
            raise DeviceError(f"{self.name}: the head is not running; wait for it to be opened")
        if self._is_exhausted():
            raise DeviceError(
                f"{self.name}: all {len(self._files)} files are played; set loop = true to begin "
                "again"
            )
        try:
            self._waiting.put_nowait(0)
        except queue.Full:
            raise DeviceError(
                f"{self.name}: {MAX_QUEUED_TRIGGERS} triggers wait already; lengthen the interval"
            ) from None

    def _open_device(self) -> None:
        if not (self._files and self._shape):
            self.bind()
        self.counters["opened"] += 1

    def _opened_sentence(self) -> str:
        return f"The head {self.name} plays {len(self._files)} files of {self.folder}."

    def _serve(self, sink: Sink) -> None:
        self._begin_delivery()
        next_ns = self.clock.mono_ns() + round(self.interval_s * 1e9)
        while not self._closing.is_set():
            if self.trigger_source == "line":
                left_ns = next_ns - self.clock.mono_ns()
                if left_ns > 0:
                    self.clock.wait(self._closing, left_ns * 1e-9)
                    continue
                next_ns = max(next_ns + round(self.interval_s * 1e9), self.clock.mono_ns())
                self._expose(sink)
            else:
                try:
                    self._waiting.get(timeout=WAIT_STEP_S)
                except queue.Empty:
                    continue
                self._expose(sink)

    def _is_exhausted(self) -> bool:
        return self._next_file >= len(self._files) and not self.loop

    def _expose(self, sink: Sink) -> None:
        from drivers.cameras.folder.frames import FrameFileError, read_frame

        if self._is_exhausted():
            return
        path = self._files[self._next_file % len(self._files)]
        self._next_file += 1
        self._due += 1
        if self._next_file % len(self._files) == 0:
            self.counters["rounds"] += 1
        slot = self._free_slot()
        if slot is not None:
            try:
                file = read_frame(path, max_nbytes=self._memory.slot_nbytes)
            except FrameFileError as error:
                self.counters["unreadable"] += 1
                self.emitter.emit_throttled(
                    "unreadable",
                    f"The head {self.name} has no frame of {path}: it {error}. Take the file out, "
                    "or restore it.",
                )
            else:
                self._deliver_frame(file, slot, sink)
        if self._is_exhausted():
            self.emitter.emit(
                "played-out",
                f"The head {self.name} has played all {len(self._files)} files; set loop = true "
                "to begin again.",
            )

    def _deliver_frame(self, file: FrameFile, slot: int, sink: Sink) -> None:
        height_px, width_px = file.pixels.shape
        slot_pixels = words_at(self._memory.address(slot), file.pixels.size)
        slot_pixels.reshape(file.pixels.shape)[:] = file.pixels
        is_complete = (height_px, width_px) == self._shape
        self.counters["frames" if is_complete else "frames_corrupt"] += 1
        settings: dict[str, float | int | str] = {**file.settings, "file": str(file.path)}
        if file.counter is not None:
            settings["recorded_counter"] = file.counter
        self._mark_in_use(slot)
        sink(
            Frame(
                head=self.name,
                slot=slot,
                status=FrameStatus.COMPLETE if is_complete else FrameStatus.CORRUPT,
                frame_id=self._due,
                counter=self._due,
                width_px=width_px,
                height_px=height_px,
                pixel_format=file.pixel_format,
                device_ns=file.device_ns,
                device_clock_ns=None,
                device_clock_mono_ns=None,
                latch_sigma_ns=None,
                mono_ns=self.clock.mono_ns(),
                exposure_time_us=file.exposure_time_us,
                temperature_c=file.temperature_c,
                settings=settings,
            )
        )
