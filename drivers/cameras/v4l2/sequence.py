"""Counting frames by the kernel's sequence number: 32 bits that wrap, skip and start again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

MODULUS: Final = 1 << 32
RESTART_THRESHOLD: Final = 1 << 31
"""A step of more than half of the range is a step back."""


@dataclass(frozen=True)
class SequenceCount:
    """The frame's count from 1, and the number of frames lost before it."""

    counter: int
    missing: int
    is_repeated: bool = False
    is_restart: bool = False


class SequenceCounter:
    """Counts one stream.

    Example:
        >>> count = SequenceCounter()
        >>> [count.advance(n).counter for n in (0, 1, 4)]
        [1, 2, 5]
    """

    def __init__(self) -> None:
        self._last: int | None = None
        self._counter = 0

    def advance(self, sequence: int) -> SequenceCount:
        """Count the next frame.

        A step back counts as one frame, since the true count is unknown.

        Args:
            sequence: the kernel's sequence number, 32 bits.

        Returns:
            The frame's count and the number of frames lost before it.
        """
        if self._last is None:
            # A stream starts at 0; what is missing before the first frame was lost.
            step = (sequence + 1) % MODULUS
        else:
            step = (sequence - self._last) % MODULUS
        started, self._last = self._last is not None, sequence
        if step == 0 and started:
            return SequenceCount(self._counter, 0, is_repeated=True)
        if step == 0 or step >= RESTART_THRESHOLD:
            self._counter += 1
            return SequenceCount(self._counter, 0, is_restart=True)
        self._counter += step
        return SequenceCount(self._counter, step - 1)
