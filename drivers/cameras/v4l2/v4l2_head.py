"""A V4L2 head: opening, streaming, loss and reconnection.

What can be set is in `drivers.cameras.v4l2.settings`, how it is set in
`drivers.cameras.v4l2.camera`.
"""

from __future__ import annotations

import errno
import select
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Final

from drivers import DriverError
from drivers.cameras.head_device import HeadDevice
from drivers.cameras.pixels import packed_nbytes, pixels_in_a_group, unpack, words_at
from drivers.cameras.v4l2.camera import V4l2Camera
from drivers.cameras.v4l2.node import FilledBuffer
from drivers.cameras.v4l2.sequence import SequenceCounter
from drivers.cameras.v4l2.settings import V4l2Settings
from drivers.contract import DeviceError, Frame, FrameStatus, LifeCycle, Sink

WAIT_STEP_S: Final = 0.1
TRIGGER_TIMEOUT_S: Final = 1.0
# Quirk: vivid stamps the end of a frame up to 34 ms ahead of the host's clock. Stamps somewhat
# ahead are accepted. Upstream: no report known (2026-11-23).
STAMP_AHEAD_NS: Final = 1_000_000_000
"""Stamps of the end of a frame may lie somewhat ahead; a second is none of this world."""
STAMP_BEHIND_NS: Final = 60_000_000_000
QUEUE_ATTEMPTS: Final = 20
"""A buffer refused so often in a row means that the stream is broken."""


class V4l2HeadLostError(DriverError):
    """The head is lost or its stream failed; internal."""


@dataclass
class _Session:
    """An opened head, from opening to closing or loss."""

    camera: V4l2Camera
    settings: dict[str, float | int | str]
    temperature_c: float | None = None
    sequence: SequenceCounter = field(default_factory=SequenceCounter)
    unqueued_buffers: dict[int, int] = field(default_factory=dict)
    """Buffers the kernel refused to take back, and how often."""


class V4l2Head(V4l2Settings, HeadDevice):
    """A camera behind a video capture node of the kernel.

    Yields a Frame for every buffer the kernel fills: COMPLETE, INCOMPLETE where the kernel flags an
    error or the buffer is short, CORRUPT where it is longer than a frame. Pixels come unpacked and
    right-justified. `counter` is the kernel's sequence number, unwrapped, from 1; `device_ns` is
    the start of exposure on CLOCK_MONOTONIC, None where the kernel's stamp is of another clock or
    makes no sense.

    Source: Documentation/userspace-api/media/v4l. Quirks: docs/reference/drivers/v4l2.md.
    """

    kind: ClassVar = "head"
    counted: ClassVar = (
        "frames",
        "frames_incomplete",
        "frames_corrupt",
        "frames_missing",
        "underruns",
        "opened",
        "sequence_repeated",
        "sequence_restarts",
        "stamps_implausible",
        "queue_failures",
        "silences",
        "formats_changed",
    )

    _session: _Session | None = None
    _adjusted: tuple[float, float] | None = None
    _is_silent = False

    def bind(self, sink: Sink | None = None) -> Mapping[str, str]:
        """Open the head and write its settings. See `drivers.contract.Head`.

        Args:
            sink: not used.

        Returns:
            Identity, size of a frame, exposure time, number of controls and temperature.

        Raises:
            DeviceError: it does not answer, refuses a setting, or is closed meanwhile.
        """
        self._open_device()
        session = self._session
        if session is None:
            raise DeviceError(f"{self.name}: closed while it was being opened; nothing to do")
        self._state = LifeCycle.BOUND
        camera, layout = session.camera, session.camera.layout
        exposure_us = camera.exposure_time_us(session.settings)
        return {
            **camera.identity,
            "frame": f"{layout.width_px} x {layout.height_px} {camera.format.name}",
            "exposure": "not known" if exposure_us is None else f"{exposure_us:g} us",
            "controls": str(len(camera.controls)),
            "temperature": ""
            if session.temperature_c is None
            else f"{session.temperature_c:.1f} degC",
        }

    def trigger(self) -> None:
        """Press the trigger button; from any thread. See `drivers.contract.Head`.

        Raises:
            DeviceError: the head waits for its line, is not running, or refuses.
        """
        if self.trigger_source != "software":
            raise DeviceError(
                f"{self.name}: the head waits for its line; set trigger_source = "
                '"software" and trigger_control to trigger it from here'
            )
        session = self._session
        if session is None or self._state is not LifeCycle.ACTIVE:
            raise DeviceError(f"{self.name}: the head is not running; wait for it to be opened")
        try:
            session.camera.press_button(self.trigger_control)
        except OSError as error:
            raise DeviceError(
                f"{self.name}: {self.trigger_control} was refused ({error.strerror}); see whether "
                "the head is lost"
            ) from None

    def adjust(self, exposure_time_us: float, gain_db: float, tdi_shifts: int) -> None:
        """Write the controls; also when the head is opened again. See `drivers.contract.Head`.

        Args:
            exposure_time_us: exposure time, us.
            gain_db: gain relative to the configured one, dB.
            tdi_shifts: 0; the head has no TDI.

        Raises:
            DeviceError: the head has no such control, refuses, is not running, or is lost.
        """
        if tdi_shifts:
            raise DeviceError(
                f"{self.name}: {tdi_shifts} TDI shifts are asked for; this head has none, set "
                "[exposure] tdi_shifts_max = 0"
            )
        session = self._session
        if session is None or self._state is not LifeCycle.ACTIVE:
            raise DeviceError(f"{self.name}: the head is not running; wait for it to be opened")
        try:
            session.camera.adjust(exposure_time_us, gain_db)
            session.settings = session.camera.control_values()
        except OSError as error:
            raise DeviceError(
                f"{self.name}: the head was lost while it was set ({error.strerror}); reconnecting"
            ) from None
        self._adjusted = (exposure_time_us, gain_db)

    # Opening

    def _open_device(self) -> None:
        if self._session is not None or self._closing.is_set():
            return
        camera = V4l2Camera(self)
        try:
            self._check_size(camera)
            if self._adjusted is not None:
                camera.adjust(*self._adjusted)
            session = _Session(camera, camera.control_values(), camera.temperature_c())
        except OSError as error:
            camera.node.close()
            raise DeviceError(
                f"{self.name} at {self.device}: the head was lost while it was opened "
                f"({error.strerror}); check cable and power"
            ) from None
        except DeviceError:
            camera.node.close()
            raise
        self._session = session
        self.counters["opened"] += 1

    def _check_size(self, camera: V4l2Camera) -> None:
        layout = camera.layout
        group = pixels_in_a_group(camera.format.packing)
        if layout.width_px % group:
            raise DeviceError(
                f"{self.name} at {self.device}: width_px is {layout.width_px}; "
                f"{camera.format.name} needs a multiple of {group}"
            )
        row_nbytes = packed_nbytes(camera.format.packing, layout.width_px)
        if layout.row_nbytes and layout.row_nbytes < row_nbytes:
            raise DeviceError(
                f"{self.name} at {self.device}: the kernel's driver announces {layout.row_nbytes} "
                f"bytes for a row of {layout.width_px} pixels {camera.format.name}, which has "
                f"{row_nbytes}; choose another pixel_format, and report it to the driver's maker"
            )
        nbytes = layout.width_px * layout.height_px * 2
        if self._memory.slot_nbytes < nbytes:
            raise DeviceError(
                f"{self.name} at {self.device}: a frame has {nbytes} bytes, its slot "
                f"{self._memory.slot_nbytes}; check width_px and height_px"
            )

    # Running

    def _opened_sentence(self) -> str:
        return f"The head {self.name} is open at {self.device}; nothing to do."

    def _held_settings(self) -> Mapping[str, float | int | str]:
        session = self._session
        return {} if session is None else session.settings

    def _serve(self, sink: Sink) -> None:
        session = self._session
        if session is None:
            return
        node = session.camera.node
        reason = ""
        try:
            count = node.make_buffers(self.buffers)
            if node.layout() != session.camera.layout:
                # From here on the kernel refuses other programs to change it.
                self.counters["formats_changed"] += 1
                raise V4l2HeadLostError("another program changed its format")
            session.unqueued_buffers = dict.fromkeys(range(count), 0)
            self._queue_again(session)
            node.stream_on()
            if not self._is_silent:
                self._begin_delivery()
            self._deliver(session, sink)
        except V4l2HeadLostError as error:
            reason = str(error)
        except OSError as error:
            reason = _loss(error)
        if reason:
            self._state = LifeCycle.INACTIVE
            self._emit_lost(
                f"The head {self.name} at {self.device} was lost ({reason}). Check its power and "
                "cable; it is reopened automatically."
            )
        self._release_device()

    def _deliver(self, session: _Session, sink: Sink) -> None:
        node = session.camera.node
        started_ns = last_frame_ns = self.clock.mono_ns()
        next_check_ns = started_ns + round(self.check_interval_s * 1e9)
        while not self._closing.is_set():
            found = node.wait(WAIT_STEP_S)
            now_ns = self.clock.mono_ns()
            if found & (select.POLLIN | select.POLLERR | select.POLLHUP):
                filled = node.dequeue()
                if filled is not None:
                    last_frame_ns = now_ns
                    if self._is_silent:
                        self._is_silent = False
                        self._begin_delivery()
                    self._take(session, filled, sink)
                elif found & (select.POLLERR | select.POLLHUP):
                    raise V4l2HeadLostError("the kernel ended its stream")
            self._queue_again(session)
            if self.silence_s and now_ns - last_frame_ns > self.silence_s * 1e9:
                self.counters["silences"] += 1
                # It opens without an error; only a frame shows that it delivers again.
                self._is_silent = True
                raise V4l2HeadLostError(f"no frame came for {self.silence_s:g} s")
            if now_ns >= next_check_ns:
                node.check_alive()
                session.settings = session.camera.control_values()
                session.temperature_c = session.camera.temperature_c()
                next_check_ns = now_ns + round(self.check_interval_s * 1e9)

    def _take(self, session: _Session, filled: FilledBuffer, sink: Sink) -> None:
        """A filled buffer: its pixels into a slot, the buffer back to the kernel."""
        counted = session.sequence.advance(filled.sequence)
        self.counters["sequence_repeated"] += counted.is_repeated
        self.counters["sequence_restarts"] += counted.is_restart
        if counted.missing:
            self.counters["frames_missing"] += counted.missing
            self.emitter.emit_throttled(
                "frames-missing",
                f"The head {self.name} lost {counted.missing} frames before they reached memory. "
                "See whether the computer is overloaded; the exposures are flagged.",
            )
        try:
            slot = self._free_slot()
            frame = None if slot is None else self._frame(session, filled, counted.counter, slot)
        finally:
            session.unqueued_buffers[filled.index] = 0
            self._queue_again(session)
        if frame is None:
            return
        key = "frames" if frame.status is FrameStatus.COMPLETE else f"frames_{frame.status.value}"
        self.counters[key] += 1
        self._mark_in_use(frame.slot)
        sink(frame)

    def _frame(self, session: _Session, filled: FilledBuffer, counter: int, slot: int) -> Frame:
        camera, layout = session.camera, session.camera.layout
        now_ns = self.clock.mono_ns()
        exposure_us = camera.exposure_time_us(session.settings)
        return Frame(
            head=self.name,
            slot=slot,
            status=self._copy(session, filled, slot),
            frame_id=filled.sequence,
            counter=counter,
            width_px=layout.width_px,
            height_px=layout.height_px,
            pixel_format=camera.format.name,
            device_ns=self._start_of_exposure_ns(filled, exposure_us, now_ns),
            device_clock_ns=now_ns,
            device_clock_mono_ns=now_ns,
            latch_sigma_ns=round(self.stamp_sigma_us * 1e3),
            mono_ns=now_ns,
            exposure_time_us=exposure_us,
            temperature_c=session.temperature_c,
            settings=session.settings,
        )

    def _copy(self, session: _Session, filled: FilledBuffer, slot: int) -> FrameStatus:
        """Unpack a buffer into a slot, row by row where rows are padded; what it is worth."""
        import numpy as np

        layout, packing = session.camera.layout, session.camera.format.packing
        row_nbytes = packed_nbytes(packing, layout.width_px)
        stride = layout.row_nbytes or row_nbytes
        needed = stride * (layout.height_px - 1) + row_nbytes
        content = session.camera.node.content(filled)
        shape = (layout.height_px, layout.width_px)
        pixels = words_at(self._memory.address(slot), shape[0] * shape[1])
        if len(content) < needed:
            # No pixel of an earlier exposure may show through.
            pixels[:] = 0
            content = np.concatenate([content, np.zeros(needed - len(content), np.uint8)])
            status = FrameStatus.INCOMPLETE
        elif filled.has_error:
            status = FrameStatus.INCOMPLETE
        elif filled.nbytes - filled.offset > max(layout.nbytes, needed):
            status = FrameStatus.CORRUPT
        else:
            status = FrameStatus.COMPLETE
        if stride == row_nbytes:
            unpack(packing, content[:needed], pixels)
        else:
            for row in range(layout.height_px):
                at = row * stride
                unpack(packing, content[at : at + row_nbytes], pixels.reshape(shape)[row])
        return status

    def _start_of_exposure_ns(
        self, filled: FilledBuffer, exposure_us: float | None, now_ns: int
    ) -> int | None:
        stamp_ns = filled.stamp_ns
        if stamp_ns is None:
            return None
        if not now_ns - STAMP_BEHIND_NS <= stamp_ns <= now_ns + STAMP_AHEAD_NS:
            self.counters["stamps_implausible"] += 1
            return None
        if filled.is_start_of_exposure:
            return stamp_ns
        if exposure_us is None:
            return None
        return stamp_ns - round((exposure_us + self.readout_us) * 1e3)

    def _queue_again(self, session: _Session) -> None:
        """Give the kernel every buffer it should have; one it refuses is tried again."""
        for index, tries in list(session.unqueued_buffers.items()):
            try:
                session.camera.node.queue(index)
            except OSError as error:
                # Quirk: a driver may refuse a buffer once and accept it later.
                # Upstream: manual: Linux, Documentation/admin-guide/media/vivid.rst, section Error
                # Injection Controls.
                self.counters["queue_failures"] += 1
                if error.errno != errno.EINVAL or tries + 1 >= QUEUE_ATTEMPTS:
                    raise
                session.unqueued_buffers[index] = tries + 1
            else:
                del session.unqueued_buffers[index]

    # Closing

    def _release_device(self) -> None:
        with self._slots:
            session, self._session = self._session, None
        if session is None:
            return
        node = session.camera.node
        try:
            node.stream_off()
        except OSError:
            # Quirk: a lost head refuses to stop. Its mappings are released all the same, or its
            # node never comes back. Upstream: manual: Linux,
            # Documentation/driver-api/media/v4l2-dev.rst, section video device cleanup;
            # realsenseai/librealsense#406.
            self.counters["stop_failures"] += 1
        node.close()


def _loss(error: OSError) -> str:
    reason_text = error.strerror or str(error)
    return {
        errno.ENODEV: "it was unplugged",
        errno.EIO: "its stream broke off",
        errno.EBUSY: "another program uses it",
        errno.EPIPE: "formats along its media pipeline differ, see media-ctl -p",
        errno.ENOLINK: "no enabled link of its media pipeline leads to it, see media-ctl -p",
    }.get(error.errno or 0, reason_text)
