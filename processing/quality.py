"""The quality report of one exposure: flags, the figures behind them, and the verdict."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field


class Flag(enum.IntFlag):
    """The documented bit set of DESIGN 5.11. A bit keeps its place for ever."""

    FRAME_MISSING = 1 << 0
    FRAME_LATE = 1 << 1
    FRAME_DUPLICATE = 1 << 2
    FRAME_CORRUPT = 1 << 3
    MARK_MISSING = 1 << 4
    MARK_AMBIGUOUS = 1 << 5
    TIME_SIGMA = 1 << 6
    TEMPERATURE_MISSING = 1 << 7
    TEMPERATURE_STALE = 1 << 8
    TEMPERATURE_RANGE = 1 << 9
    DC_DISAGREEMENT = 1 << 10
    TIE_POINTS = 1 << 11
    SIGMA0 = 1 << 12
    DISPLACED_SENSOR = 1 << 13
    CALIBRATION_EXPIRED = 1 << 14
    UNDEREXPOSED = 1 << 15
    OVEREXPOSED = 1 << 16
    BLUR = 1 << 17
    TILT = 1 << 18
    DRIFT = 1 << 19
    OVERLAP = 1 << 20
    GNSS = 1 << 21
    DISK_LOW = 1 << 22
    PROCESSING_BEHIND = 1 << 23
    SIMULATED = 1 << 24
    NOT_PROCESSED = 1 << 25


class Verdict(enum.Enum):
    GOOD = "good"
    USABLE = "usable"
    REFLY = "refly"


@dataclass(frozen=True)
class Finding:
    """One raised flag: which, how grave, the figure against its threshold, and what to do."""

    flag: Flag
    verdict: Verdict
    sentence: str
    value: float | None = None
    threshold: float | None = None


@dataclass(frozen=True)
class QualityReport:
    """What is known about one exposure. `figures` are numbers by documented name."""

    verdict: Verdict
    flags: Flag
    findings: tuple[Finding, ...]
    figures: Mapping[str, float | int | str | None] = field(default_factory=dict)
