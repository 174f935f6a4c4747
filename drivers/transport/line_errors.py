"""Errors of a serial line that the kernel's driver counts, such as bytes that were read too late.

A checksum shows that a message is damaged. These counters show whether this computer lost its
bytes, or whether they came damaged over the line.
"""

from __future__ import annotations

import ctypes
import fcntl
from collections import Counter
from typing import Any, Final

TIOCGICOUNT: Final = 0x545D
COUNTER_RANGE: Final = 1 << 32


class InterruptCounts(ctypes.Structure):
    """`struct serial_icounter_struct`; the kernel fills the counters since the port exists.

    Source: Linux, include/uapi/linux/serial.h.
    """

    _fields_ = (
        *((name, ctypes.c_int) for name in ("cts", "dsr", "rng", "dcd", "rx", "tx")),
        *((name, ctypes.c_int) for name in ("frame", "overrun", "parity", "brk", "buf_overrun")),
        ("reserved", ctypes.c_int * 9),
    )


FIELDS: Final = {
    "overruns": ("overrun", "buf_overrun"),
    "framing_errors": ("frame",),
    "parity_errors": ("parity",),
}
"""Fields of the kernel by the name of the counter that has their sum."""


class LineErrors:
    """Counts the errors of one open port since it was opened.

    Args:
        port: the port. One without counters, such as a network address or a pseudo-terminal, has
            no errors.
    """

    def __init__(self, port: Any) -> None:
        self._port = port
        self._before = self._read()

    def new(self) -> Counter[str]:
        """Errors since the previous call, or since the port was opened.

        Returns:
            Counts by the names of FIELDS, without those that are zero.
        """
        if self._before is None:
            return Counter()
        now = self._read()
        if now is None:
            return Counter()
        found = {
            name: sum((now[field] - self._before[field]) % COUNTER_RANGE for field in fields)
            for name, fields in FIELDS.items()
        }
        self._before = now
        return Counter({name: count for name, count in found.items() if count})

    def _read(self) -> dict[str, int] | None:
        counts = InterruptCounts()
        try:
            fcntl.ioctl(self._port.fileno(), TIOCGICOUNT, counts)
        except (AttributeError, OSError, TypeError, ValueError):
            # A port without counters, or one that is lost; reading from it reports the loss.
            return None
        return {field: getattr(counts, field) for fields in FIELDS.values() for field in fields}


def overrun_sentence(device: str, port: str, count: int) -> str:
    """What it means that bytes were read too late, and the remedy.

    Args:
        device: type and name of the device.
        port: its port.
        count: number of overruns.

    Returns:
        Sentences for the operator.
    """
    return (
        f"The {device} at {port}: the computer read its serial port too late, and lost bytes "
        f"{count} times. Reduce its load, switch off messages that are not needed, or use a USB "
        "adapter, which has a larger buffer."
    )
