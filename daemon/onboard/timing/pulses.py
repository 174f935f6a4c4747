"""What matching is about: a pulse that was given, and what became of a frame or a mark."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass


class Cause(enum.Enum):
    """What became of a frame or a mark. PENDING: not known yet."""

    USED = "used"
    LATE = "late"
    DUPLICATE = "duplicate"
    CORRUPT = "corrupt"
    SPURIOUS = "spurious"
    PENDING = "pending"


@dataclass(frozen=True)
class FiredPulse:
    """A pulse that was given, as the matching needs it.

    `mono_ns` is the moment the delays count from, the middle of the round trip in which the unit
    was asked, `sigma_ns` half of that round trip; `delays_ns` by cone lead to the start of
    exposure; `strobe_delay_ns` to the mid-exposure of the reference cone, which is what the
    receiver stamps. `spread_ns` is how well the delays are kept, as a standard deviation.
    """

    number: int
    mono_ns: int
    sigma_ns: int
    count: int
    delays_ns: Mapping[str, int]
    strobe_delay_ns: int
    spread_ns: int = 1_000


@dataclass(frozen=True)
class MatchResult:
    """Where a frame or mark belongs: `number` is None where it belongs nowhere.

    `possible` are the exposures a frame may be of, where that is for doubt.
    """

    number: int | None
    cause: Cause
    is_ambiguous: bool = False
    possible: tuple[int, ...] = ()
