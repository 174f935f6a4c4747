"""An opened video node of the kernel: its formats and its buffers.

Every call either returns or raises OSError; none waits but `wait`, which has a time-out. What is
asked when, and what an error means for the head, is in `drivers.cameras.v4l2.v4l2_head`.

Source: Documentation/userspace-api/media/v4l of the kernel.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import mmap
import select
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from drivers.cameras.v4l2 import uapi
from drivers.cameras.v4l2.control_port import ControlPort, text_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

NS_PER_S: Final = 1_000_000_000
NS_PER_US: Final = 1_000


@dataclass(frozen=True)
class FrameLayout:
    """How a frame lies in a buffer."""

    width_px: int
    height_px: int
    code: int
    row_nbytes: int
    nbytes: int


@dataclass(frozen=True)
class FilledBuffer:
    """A buffer the kernel has filled.

    `stamp_ns` is CLOCK_MONOTONIC, None if the kernel reports another clock.
    """

    index: int
    offset: int
    nbytes: int
    sequence: int
    has_error: bool
    stamp_ns: int | None
    is_start_of_exposure: bool


class VideoNode(ControlPort):
    """A video capture node, open until `close`; single- and multi-planar API alike.

    Raises:
        OSError: it cannot be opened, or is no streaming capture node (ENOTTY, ENODEV).
    """

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self._maps: list[tuple[mmap.mmap, int]] = []
        try:
            capability = self._call(uapi.QUERYCAP, uapi.Capability())
            capabilities = capability.capabilities
            if capabilities & uapi.CAP_DEVICE_CAPS:
                capabilities = capability.device_caps
            if capabilities & uapi.CAP_VIDEO_CAPTURE:
                self.buffer_type = uapi.BUF_TYPE_VIDEO_CAPTURE
            elif capabilities & uapi.CAP_VIDEO_CAPTURE_MPLANE:
                self.buffer_type = uapi.BUF_TYPE_VIDEO_CAPTURE_MPLANE
            else:
                raise OSError(errno.ENODEV, "it is no capture node")
            self.is_media_centric = bool(capabilities & uapi.CAP_IO_MC)
            if not capabilities & uapi.CAP_STREAMING:
                raise OSError(errno.ENODEV, "it cannot stream")
        except OSError:
            self.close()
            raise
        self.driver = text_of(capability.driver)
        self.card = text_of(capability.card)
        self.bus = text_of(capability.bus_info)
        self.kernel = ".".join(str(capability.version >> s & 0xFF) for s in (16, 8, 0))

    @property
    def is_multi_planar(self) -> bool:
        """Whether the node has the multi-planar API."""
        return self.buffer_type == uapi.BUF_TYPE_VIDEO_CAPTURE_MPLANE

    def close(self) -> None:
        """Release mappings and descriptor: a device that was unplugged waits for both."""
        self.free_buffers()
        super().close()

    def wait(self, timeout_s: float) -> int:
        """Wait for a frame.

        Args:
            timeout_s: longest wait, s.

        Returns:
            Event bits of poll(2); 0 if none came in time.
        """
        poll = select.poll()
        poll.register(self._fd, select.POLLIN)
        found = poll.poll(timeout_s * 1e3)
        return found[0][1] if found else 0

    def check_alive(self) -> None:
        """Check that the device exists.

        Raises:
            OSError: ENODEV, the device is gone.
        """
        self._call(uapi.QUERYCAP, uapi.Capability())

    # Format

    def formats(self) -> list[int]:
        """The formats that the head offers.

        Returns:
            V4L2 pixel formats, four characters as a number each.

        Raises:
            OSError: the head is lost.
        """
        codes: list[int] = []
        for index in range(256):
            description = uapi.FormatDescription(index=index, type=self.buffer_type)
            try:
                self._call(uapi.ENUM_FMT, description)
            except OSError as error:
                if error.errno == errno.EINVAL:
                    break
                raise
            codes.append(int(description.pixelformat))
        return codes

    def layout(self) -> FrameLayout:
        """The present layout of a frame.

        Returns:
            Size in pixels, format, bytes of a row and of a frame.

        Raises:
            OSError: the head is lost, or the format has several planes.
        """
        form = uapi.Format(type=self.buffer_type)
        return self._layout(self._call(uapi.G_FMT, form))

    def set_layout(self, width_px: int, height_px: int, code: int) -> FrameLayout:
        """Request a layout of a frame.

        Args:
            width_px: columns.
            height_px: rows.
            code: V4L2 pixel format.

        Returns:
            What the head accepted, which may be another layout.

        Raises:
            OSError: the head refuses, streams (EBUSY), or is lost.
        """
        form = self._call(uapi.G_FMT, uapi.Format(type=self.buffer_type))
        pix = form.fmt.pix_mp if self.is_multi_planar else form.fmt.pix
        pix.width, pix.height, pix.pixelformat = width_px, height_px, code
        pix.field = uapi.FIELD_NONE
        if self.is_multi_planar:
            pix.num_planes = 1
            pix.plane_fmt[0].bytesperline = pix.plane_fmt[0].sizeimage = 0
        else:
            pix.bytesperline = pix.sizeimage = 0
        return self._layout(self._call(uapi.S_FMT, form))

    def set_input(self, number: int) -> None:
        """Select a video input.

        Args:
            number: number of the input, from 0.

        Raises:
            OSError: the head has no such input, or is lost.
        """
        self._call(uapi.S_INPUT, ctypes.c_int(number))

    def set_interval(self, interval_s: float) -> float:
        """Request a frame interval.

        Args:
            interval_s: time from frame to frame, s; rounded to microseconds.

        Returns:
            The interval that the head accepted, s; 0 if it reports none.

        Raises:
            OSError: the head refuses or is lost.
        """
        parm = self._call(uapi.G_PARM, uapi.StreamParm(type=self.buffer_type))
        fraction = parm.parm.capture.timeperframe
        fraction.numerator, fraction.denominator = round(interval_s * 1e6), 1_000_000
        self._call(uapi.S_PARM, parm)
        return float(fraction.numerator / fraction.denominator if fraction.denominator else 0)

    def _layout(self, form: uapi.Format) -> FrameLayout:
        if not self.is_multi_planar:
            pix = form.fmt.pix
            return FrameLayout(
                pix.width, pix.height, int(pix.pixelformat), pix.bytesperline, pix.sizeimage
            )
        pix = form.fmt.pix_mp
        if pix.num_planes != 1:
            raise OSError(errno.EINVAL, f"the format has {pix.num_planes} planes, not one")
        plane = pix.plane_fmt[0]
        return FrameLayout(
            pix.width, pix.height, int(pix.pixelformat), plane.bytesperline, plane.sizeimage
        )

    # Buffers

    def make_buffers(self, count: int) -> int:
        """Request buffers from the kernel and map them.

        Args:
            count: requested number.

        Returns:
            Number of buffers that the kernel made.

        Raises:
            OSError: the head streams already, or is lost.
        """
        request = uapi.RequestBuffers(count=count, type=self.buffer_type, memory=uapi.MEMORY_MMAP)
        self._call(uapi.REQBUFS, request)
        for index in range(request.count):
            buffer, planes = self._buffer(index)
            self._call(uapi.QUERYBUF, buffer)
            offset = planes[0].m.mem_offset if self.is_multi_planar else buffer.m.offset
            length = planes[0].length if self.is_multi_planar else buffer.length
            mapped = mmap.mmap(
                self._fd, length, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE, offset=offset
            )
            self._maps.append((mapped, length))
        return len(self._maps)

    def free_buffers(self) -> None:
        """Unmap, then hand the buffers back; never raises, since a lost device refuses."""
        for mapped, _ in self._maps:
            # A view left somewhere lets go of its mapping when it is collected.
            with contextlib.suppress(BufferError):
                mapped.close()
        self._maps.clear()
        if self._fd >= 0:
            request = uapi.RequestBuffers(
                count=0, type=getattr(self, "buffer_type", 1), memory=uapi.MEMORY_MMAP
            )
            with contextlib.suppress(OSError):
                self._call(uapi.REQBUFS, request)

    def content(self, filled: FilledBuffer) -> NDArray[np.uint8]:
        """The bytes of a filled buffer, without a copy.

        Args:
            filled: as dequeued.

        Returns:
            Shape (n,). Not to be retained: a view keeps the mapping open.
        """
        import numpy as np

        mapped, length = self._maps[filled.index]
        end = min(filled.nbytes, length)
        if end <= filled.offset:
            return np.empty(0, np.uint8)
        return np.frombuffer(mapped, np.uint8, end - filled.offset, filled.offset)

    def queue(self, index: int) -> None:
        """Give a buffer to the kernel.

        Args:
            index: number of the buffer.

        Raises:
            OSError: the kernel refuses (EINVAL), or the head is lost.
        """
        buffer, _planes = self._buffer(index)
        self._call(uapi.QBUF, buffer)

    def dequeue(self) -> FilledBuffer | None:
        """Take the next filled buffer.

        Returns:
            The buffer; None if there is none yet.

        Raises:
            OSError: the stream failed (EIO) or the head is lost (ENODEV).
        """
        buffer, planes = self._buffer(0)
        try:
            self._call(uapi.DQBUF, buffer)
        except OSError as error:
            if error.errno == errno.EAGAIN:
                return None
            raise
        flags = int(buffer.flags)
        stamp = buffer.timestamp
        clock = flags & uapi.BUF_FLAG_TIMESTAMP_MASK
        return FilledBuffer(
            index=int(buffer.index),
            offset=int(planes[0].data_offset) if self.is_multi_planar else 0,
            nbytes=int(planes[0].bytesused if self.is_multi_planar else buffer.bytesused),
            sequence=int(buffer.sequence),
            # Quirk: a corrupted buffer has its full size; only the flag shows the error.
            # Upstream: manual: Linux, Documentation/userspace-api/media/v4l/buffer.rst,
            # V4L2_BUF_FLAG_ERROR.
            has_error=bool(flags & uapi.BUF_FLAG_ERROR),
            stamp_ns=stamp.tv_sec * NS_PER_S + stamp.tv_usec * NS_PER_US
            if clock == uapi.BUF_FLAG_TIMESTAMP_MONOTONIC
            else None,
            is_start_of_exposure=flags & uapi.BUF_FLAG_TSTAMP_SRC_MASK
            == uapi.BUF_FLAG_TSTAMP_SRC_SOE,
        )

    def stream_on(self) -> None:
        """Start streaming.

        Raises:
            OSError: the head refuses or is lost.
        """
        self._call(uapi.STREAMON, ctypes.c_int(self.buffer_type))

    def stream_off(self) -> None:
        """Stop streaming; the kernel returns all buffers.

        Raises:
            OSError: the head is lost.
        """
        self._call(uapi.STREAMOFF, ctypes.c_int(self.buffer_type))

    def _buffer(self, index: int) -> tuple[uapi.Buffer, Any]:
        planes = (uapi.BufferPlane * uapi.VIDEO_MAX_PLANES)()
        buffer = uapi.Buffer(index=index, type=self.buffer_type, memory=uapi.MEMORY_MMAP)
        if self.is_multi_planar:
            buffer.m.planes = ctypes.cast(planes, ctypes.POINTER(uapi.BufferPlane))
            buffer.length = 1
        return buffer, planes
