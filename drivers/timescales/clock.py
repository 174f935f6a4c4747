"""The host's monotonic clock and waits on it, behind a protocol that tests can replace.

Also the back-off between attempts to reopen a lost device. GPS time is in
`drivers.timescales.gps_time`.
"""

from __future__ import annotations

import threading
import time
from typing import Final, Protocol

BACK_OFF_FIRST_S: Final = 0.2
BACK_OFF_LIMIT_S: Final = 5.0


class Clock(Protocol):
    """The clock that a driver uses."""

    def mono_ns(self) -> int:
        """CLOCK_MONOTONIC."""

    def wait(self, event: threading.Event, timeout_s: float) -> bool:
        """Wait for the event, at most `timeout_s`; returns whether it is set."""


class MonotonicClock:
    """CLOCK_MONOTONIC of the host."""

    def mono_ns(self) -> int:
        return time.monotonic_ns()

    def wait(self, event: threading.Event, timeout_s: float) -> bool:
        return event.wait(timeout_s)


class BackOff:
    """Pauses between attempts: 0.2 s, doubled up to 5 s; `reset` restarts the series.

    Example:
        >>> pause = BackOff()
        >>> [pause.next_s() for _ in range(7)]
        [0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0]
    """

    def __init__(self) -> None:
        self._next_s = BACK_OFF_FIRST_S

    def next_s(self) -> float:
        pause_s = self._next_s
        self._next_s = min(2 * pause_s, BACK_OFF_LIMIT_S)
        return pause_s

    def reset(self) -> None:
        self._next_s = BACK_OFF_FIRST_S
