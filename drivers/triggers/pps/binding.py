"""The kernel's PPS interface: its structures and requests, without the meaning of edges.

Source: include/uapi/linux/pps.h, Documentation/driver-api/pps.rst; RFC 2783.
"""

from __future__ import annotations

import fcntl
import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

API_VERSION: Final = 1
CAPTURE_ASSERT: Final = 0x01
CAPTURE_CLEAR: Final = 0x02
CAN_WAIT: Final = 0x100
TIME_INVALID: Final = 0x1

KTIME: Final = struct.Struct("@qiI")
"""struct pps_ktime: sec, nsec, flags."""
FDATA: Final = struct.Struct("@II qiI qiI i4x qiI")
"""struct pps_fdata: assert and clear sequence, assert and clear time, mode, time-out."""
PARAMS: Final = struct.Struct("@ii qiI qiI")
"""struct pps_kparams: version, mode, offsets of assert and clear."""
_POINTER: Final = struct.calcsize("P")
_WRITE, _READ = 1, 2


def _request(direction: int, number: int) -> int:
    # Quirk: the kernel's header uses the size of the pointer, not of the structure.
    # Upstream: manual: Linux, include/uapi/linux/pps.h, PPS_GETPARAMS to PPS_FETCH.
    return direction << 30 | _POINTER << 16 | ord("p") << 8 | number


GETPARAMS: Final = _request(_READ, 0xA1)
SETPARAMS: Final = _request(_WRITE, 0xA2)
GETCAP: Final = _request(_READ, 0xA3)
FETCH: Final = _request(_READ | _WRITE, 0xA4)


@dataclass(frozen=True)
class Edges:
    """The last edges of a source; times on CLOCK_REALTIME, zero before the first."""

    assert_sequence: int
    clear_sequence: int
    assert_ns: int
    clear_ns: int


class KernelPps:
    """An open /dev/pps device. Errors of the kernel are raised as OSError."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)

    def capabilities(self) -> int:
        """What the source can do (PPS_GETCAP).

        Returns:
            The CAPTURE_* and CAN_* bits.
        """
        answer = bytearray(struct.pack("@i", 0))
        fcntl.ioctl(self._fd, GETCAP, answer)
        return int(struct.unpack("@i", answer)[0])

    def mode(self) -> int:
        """The edges that are captured at present (PPS_GETPARAMS).

        Returns:
            The CAPTURE_* bits.
        """
        return int(self._params()[1])

    def set_mode(self, mode: int) -> None:
        """Capture these edges (PPS_SETPARAMS).

        Args:
            mode: CAPTURE_* bits.

        Raises:
            OSError: EPERM without CAP_SYS_TIME, EINVAL for a bit that the source does not have.
        """
        params = self._params()
        fcntl.ioctl(self._fd, SETPARAMS, bytearray(PARAMS.pack(API_VERSION, mode, *params[2:])))

    def fetch(self, timeout_s: float) -> Edges | None:
        """Wait for the next edge (PPS_FETCH).

        An edge before the call does not end the wait; `latest` returns it.

        Args:
            timeout_s: longest wait, s; with 0 the kernel returns at once.

        Returns:
            The last edges; None if none is captured in time.

        Raises:
            OSError: the source is lost.
        """
        seconds, nanoseconds = divmod(round(timeout_s * 1e9), 1_000_000_000)
        zeros = (0,) * 9
        data = bytearray(FDATA.pack(*zeros, seconds, nanoseconds, 0))
        try:
            fcntl.ioctl(self._fd, FETCH, data)
        except (TimeoutError, InterruptedError):
            return None
        return edges_of(bytes(data))

    def latest(self) -> Edges | None:
        """The last edges, without waiting: with a time-out of 0, the kernel returns at once.

        Returns:
            The last edges.

        Raises:
            OSError: the source is lost.
        """
        return self.fetch(0.0)

    def is_there(self) -> bool:
        """Whether the path still leads to this device; a wait for an edge does not report that.

        Returns:
            False if the path is gone or leads to another device.
        """
        # Quirk: a wait for an edge does not end if the source is removed.
        # Upstream: no report known (2026-11-23).
        try:
            return os.path.samestat(Path(self._path).stat(), os.fstat(self._fd))
        except FileNotFoundError:
            return False

    def close(self) -> None:
        """Close the device; may be called twice."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    def _params(self) -> tuple[int, ...]:
        answer = bytearray(PARAMS.size)
        fcntl.ioctl(self._fd, GETPARAMS, answer)
        return PARAMS.unpack(answer)


def edges_of(data: bytes) -> Edges:
    """The edges in a struct pps_fdata.

    Args:
        data: its bytes, FDATA.size of them.

    Returns:
        Sequence numbers and times of the last edges.

    Source: Linux, include/uapi/linux/pps.h.
    """
    asserts, clears, a_s, a_ns, _, c_s, c_ns, *_ = FDATA.unpack(data)
    return Edges(asserts, clears, a_s * 1_000_000_000 + a_ns, c_s * 1_000_000_000 + c_ns)
