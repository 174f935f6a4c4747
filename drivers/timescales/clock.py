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
        """The present time.

        Returns:
            CLOCK_MONOTONIC, ns.
        """

    def wait(self, event: threading.Event, timeout_s: float) -> bool:
        """Wait for an event.

        Args:
            event: what is waited for.
            timeout_s: longest wait, s.

        Returns:
            Whether the event is set.
        """


class MonotonicClock:
    """CLOCK_MONOTONIC of the host."""

    def mono_ns(self) -> int:
        """The present time.

        Returns:
            CLOCK_MONOTONIC, ns.
        """
        return time.monotonic_ns()

    def wait(self, event: threading.Event, timeout_s: float) -> bool:
        """Wait for an event.

        Args:
            event: what is waited for.
            timeout_s: longest wait, s.

        Returns:
            Whether the event is set.
        """
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
        """The pause before the next attempt; doubles the following one.

        Returns:
            BACK_OFF_FIRST_S to BACK_OFF_LIMIT_S, s.
        """
        pause_s = self._next_s
        self._next_s = min(2 * pause_s, BACK_OFF_LIMIT_S)
        return pause_s

    def reset(self) -> None:
        """Begin again with the shortest pause."""
        self._next_s = BACK_OFF_FIRST_S
