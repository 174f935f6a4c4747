"""Raw observations of receivers: pseudorange, phase, Doppler and signal strength, by signal.

What a receiver's own message means is decoded next to its driver: `ublox.observations` (RXM-RAWX),
`novatel.observations` (RANGE), `septentrio.observations` (MeasEpoch). The service does not use
them: bytes are recorded as they come, and converted after landing.

Source: RINEX 3.04, tables 9 to 15.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

WEEK_NS: Final = 604_800_000_000_000


@dataclass(frozen=True)
class Observation:
    """One signal of one satellite; None where the receiver calls a value invalid.

    `satellite` is RINEX's, such as G05; `lock_s` how long the phase has been tracked, and
    `half_cycle` whether it may be off by half a cycle; `channel` is GLONASS's frequency number.
    """

    satellite: str
    code: str
    pseudorange_m: float | None
    phase_cycles: float | None
    doppler_hz: float | None
    strength_dbhz: float | None
    lock_s: float
    half_cycle: bool = False
    channel: int | None = None


@dataclass(frozen=True)
class ObservationEpoch:
    """The observations of one instant of the receiver's clock, GPS time."""

    gps_ns: int
    observations: tuple[Observation, ...]


@dataclass
class ObservationCounts:
    """Messages decoded, signals that RINEX has no code for, and messages that cannot be decoded.

    `other_antennas` are signals of a second antenna, which are left out.
    """

    epochs: int = 0
    unknown_signals: int = 0
    unreadable: int = 0
    other_antennas: int = 0


def present(value: float) -> float | None:
    """A value of a message.

    Args:
        value: as unpacked.

    Returns:
        The value; None where it is zero or no number, which receivers send for "not measured".

    Example:
        >>> present(float("nan")), present(0.0), present(2.5)
        (None, None, 2.5)
    """
    return float(value) if math.isfinite(value) and value != 0.0 else None
