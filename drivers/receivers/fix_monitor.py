"""Description of a receiver's fix for the operator, and events on its changes.

Each decoder determines fix and satellites (`drivers.receivers.message_decoder`).
"""

from __future__ import annotations

from typing import Final

from drivers.base.event_emitter import EventEmitter
from drivers.contract import POSITION_FIXES, NavSample
from drivers.timescales.clock import Clock

LOST_FOR_NS: Final = 2_000_000_000
"""Shorter losses of the fix are not reported."""


def missing_for_flight(sample: NavSample) -> str | None:
    """What a sample does not have that an exposure needs.

    Args:
        sample: the sample.

    Returns:
        "position", "usable time" or "height", the first that is missing; None if nothing is.

    Example:
        >>> from dataclasses import replace
        >>> flat = NavSample("gnss", 0, 0, "2d", 4, 47.5, 8.5, None, *[None] * 7, None, True)
        >>> missing_for_flight(flat)
        'height'
        >>> missing_for_flight(replace(flat, fix="none"))
        'position'
    """
    if sample.position is None:
        return "position"
    if not sample.time_valid:
        return "usable time"
    return "height" if sample.height_m is None else None


def fix_description(fix: str | None, satellites: int | None) -> str:
    """A receiver's fix in words.

    Args:
        fix: fix status as in NavSample; None if it was not received.
        satellites: satellites in use; None if unknown.

    Returns:
        Such as "searching, 0 satellites" or "3d, 9 satellites".

    Example:
        >>> fix_description("none", 0), fix_description("3d", None)
        ('searching, 0 satellites', '3d')
    """
    text = str(fix) if fix in POSITION_FIXES else "searching"
    if satellites is None:
        return text
    return f"{text}, {satellites} satellite{'' if satellites == 1 else 's'}"


class FixMonitor:
    """Reports when a receiver searches, and when it has a fix again.

    Before its first fix at once, later when the fix was lost for two seconds. A receiver that has
    a fix from the beginning is not reported.
    """

    def __init__(self, emitter: EventEmitter, clock: Clock, receiver: str) -> None:
        self._emitter = emitter
        self._clock = clock
        self._receiver = receiver
        self._had_fix = False
        self._lost_ns: int | None = None
        self._is_searching = False

    def reset(self) -> None:
        """The line was reopened: the present state is reported again."""
        self._lost_ns, self._is_searching = None, False

    def update(self, fix: str | None, satellites: int | None) -> None:
        """Note the receiver's latest fix status.

        Args:
            fix: fix status as in NavSample; None before the first.
            satellites: satellites in use; None if unknown.
        """
        if fix is None:
            return
        now_ns = self._clock.mono_ns()
        if fix in POSITION_FIXES:
            self._lost_ns, self._had_fix = None, True
            if self._is_searching:
                self._is_searching = False
                self._emitter.emit(
                    "fixed",
                    f"The receiver {self._receiver} has a fix: {fix_description(fix, satellites)}.",
                )
            return
        if self._lost_ns is None:
            self._lost_ns = now_ns
        if self._is_searching or self._emitter.sink is None:
            return
        if self._had_fix and now_ns - self._lost_ns < LOST_FOR_NS:
            return
        self._is_searching = True
        self._emitter.emit(
            "searching",
            f"The receiver {self._receiver} is {fix_description(fix, satellites)}. Wait; its "
            "antenna needs a clear view of the sky.",
        )
