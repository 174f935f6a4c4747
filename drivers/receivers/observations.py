"""Raw observations of receivers: pseudorange, phase, Doppler and signal strength, by signal.

What a receiver's own message means is decoded here for u-blox (RXM-RAWX) and NovAtel (RANGE). The
service does not use it: bytes are recorded as they come, and converted after landing.

Source: u-blox F9 interface description, UBX-18010854, RXM-RAWX; NovAtel OM-20000169, RANGE and
"Channel Tracking Status"; RINEX 3.04, tables 9 to 15.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from drivers.receivers.novatel.framing import log_of, novatel_framer
from drivers.receivers.ublox.framing import UbxFramer

WEEK_NS: Final = 604_800_000_000_000
UBX_RAWX: Final = (0x02, 0x15)
NOVATEL_RANGE: Final = (43, "RANGE")
_UBX_HEAD: Final = struct.Struct("<dHbBBB2x")
_UBX_SIGNAL: Final = struct.Struct("<ddfBBBBHBBBBBx")
_RANGE_SIGNAL: Final = struct.Struct("<HHdfdffffI")

_UBX_CODES: Final[Mapping[tuple[int, int], tuple[str, str]]] = {
    (0, 0): ("G", "1C"), (0, 3): ("G", "2L"), (0, 4): ("G", "2S"),
    (0, 6): ("G", "5I"), (0, 7): ("G", "5Q"),
    (1, 0): ("S", "1C"),
    (2, 0): ("E", "1C"), (2, 1): ("E", "1B"), (2, 3): ("E", "5I"), (2, 4): ("E", "5Q"),
    (2, 5): ("E", "7I"), (2, 6): ("E", "7Q"),
    (3, 0): ("C", "2I"), (3, 1): ("C", "2I"), (3, 2): ("C", "7I"), (3, 3): ("C", "7I"),
    (3, 5): ("C", "1P"), (3, 6): ("C", "1D"), (3, 7): ("C", "5P"), (3, 8): ("C", "5D"),
    (5, 0): ("J", "1C"), (5, 1): ("J", "1Z"), (5, 4): ("J", "2S"), (5, 5): ("J", "2L"),
    (5, 8): ("J", "5I"), (5, 9): ("J", "5Q"),
    (6, 0): ("R", "1C"), (6, 2): ("R", "2C"),
    (7, 0): ("I", "5A"),
}  # fmt: skip
"""RINEX system and code of (gnssId, sigId)."""
_NOVATEL_CODES: Final[Mapping[tuple[int, int], tuple[str, str]]] = {
    (0, 0): ("G", "1C"), (0, 5): ("G", "2P"), (0, 9): ("G", "2W"), (0, 14): ("G", "5Q"),
    (0, 16): ("G", "1L"), (0, 17): ("G", "2S"),
    (1, 0): ("R", "1C"), (1, 1): ("R", "2C"), (1, 5): ("R", "2P"), (1, 6): ("R", "3Q"),
    (2, 0): ("S", "1C"), (2, 6): ("S", "5I"),
    (3, 2): ("E", "1C"), (3, 6): ("E", "6B"), (3, 7): ("E", "6C"), (3, 12): ("E", "5Q"),
    (3, 17): ("E", "7Q"), (3, 20): ("E", "8Q"),
    (4, 0): ("C", "2I"), (4, 4): ("C", "2I"), (4, 1): ("C", "7I"), (4, 5): ("C", "7I"),
    (4, 2): ("C", "6I"), (4, 6): ("C", "6I"), (4, 7): ("C", "1P"), (4, 9): ("C", "5P"),
    (5, 0): ("J", "1C"), (5, 14): ("J", "5Q"), (5, 16): ("J", "1L"), (5, 17): ("J", "2S"),
}  # fmt: skip
"""RINEX system and code of (satellite system, signal type) of the tracking status."""
_NUMBER_OFFSETS: Final = {"S": 100, "J": 0}


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
    """Messages decoded, signals that RINEX has no code for, and messages that cannot be decoded."""

    epochs: int = 0
    unknown_signals: int = 0
    unreadable: int = 0


def ublox_observations(data: bytes, counts: ObservationCounts) -> Iterator[ObservationEpoch]:
    """Epochs of RXM-RAWX in a recording.

    Args:
        data: bytes as received.
        counts: are counted up.

    Yields:
        Epochs in the order received.
    """
    for frame in UbxFramer().feed(data):
        if (frame[2], frame[3]) != UBX_RAWX:
            continue
        epoch = _rawx(frame[6:-2], counts)
        if epoch is None:
            counts.unreadable += 1
        else:
            counts.epochs += 1
            yield epoch


def novatel_observations(data: bytes, counts: ObservationCounts) -> Iterator[ObservationEpoch]:
    """Epochs of binary RANGE logs in a recording.

    Args:
        data: bytes as received.
        counts: are counted up.

    Yields:
        Epochs in the order received.
    """
    for frame in novatel_framer().feed(data):
        try:
            log = log_of(frame)
        except ValueError:
            counts.unreadable += 1
            continue
        if log.identity not in NOVATEL_RANGE:
            continue
        epoch = None
        if isinstance(log.body, bytes):
            epoch = _range(log.week * WEEK_NS + log.tow_ns, log.body, counts)
        if epoch is None:
            counts.unreadable += 1
        else:
            counts.epochs += 1
            yield epoch


def _rawx(payload: bytes, counts: ObservationCounts) -> ObservationEpoch | None:
    if len(payload) < _UBX_HEAD.size:
        return None
    tow_s, week, _, count, _, _ = _UBX_HEAD.unpack_from(payload)
    if len(payload) != _UBX_HEAD.size + count * _UBX_SIGNAL.size or not 0.0 <= tow_s < 604_800.0:
        return None
    found = []
    for at in range(_UBX_HEAD.size, len(payload), _UBX_SIGNAL.size):
        values = _UBX_SIGNAL.unpack_from(payload, at)
        pseudorange, phase, doppler, system, number, signal, frequency, lock_ms, cno = values[:9]
        status = values[12]
        known = _UBX_CODES.get((system, signal))
        offset = _NUMBER_OFFSETS.get(known[0], 0) if known else 0
        if known is None or not 1 <= number - offset <= 99:
            counts.unknown_signals += 1
            continue
        found.append(
            Observation(
                f"{known[0]}{number - offset:02d}",
                known[1],
                _finite(pseudorange) if status & 1 else None,
                _finite(phase) if status & 2 else None,
                _finite(doppler),
                float(cno) if cno else None,
                lock_ms * 1e-3,
                half_cycle=bool(status & 2 and not status & 4),
                channel=frequency - 7 if known[0] == "R" else None,
            )
        )
    return ObservationEpoch(week * WEEK_NS + round(tow_s * 1e9), tuple(found))


def _range(gps_ns: int, body: bytes, counts: ObservationCounts) -> ObservationEpoch | None:
    if len(body) < 4:
        return None
    (count,) = struct.unpack_from("<I", body)
    if len(body) != 4 + count * _RANGE_SIGNAL.size:
        return None
    found = []
    for at in range(4, len(body), _RANGE_SIGNAL.size):
        number, channel, pseudorange, _, phase, _, doppler, strength, lock_s, status = (
            _RANGE_SIGNAL.unpack_from(body, at)
        )
        known = _NOVATEL_CODES.get((status >> 16 & 7, status >> 21 & 31))
        satellite = _novatel_satellite(known[0], number) if known else None
        if known is None or satellite is None:
            counts.unknown_signals += 1
            continue
        has_phase, has_code = bool(status & 1 << 10), bool(status & 1 << 12)
        found.append(
            Observation(
                satellite,
                known[1],
                _finite(pseudorange) if has_code else None,
                _minus(_finite(phase)) if has_phase else None,
                _finite(doppler),
                _finite(strength),
                float(lock_s),
                half_cycle=has_phase and not status & 1 << 11,
                channel=channel - 7 if known[0] == "R" else None,
            )
        )
    return ObservationEpoch(gps_ns, tuple(found))


def _novatel_satellite(system: str, number: int) -> str | None:
    first = {"R": 37, "S": 100, "J": 192}.get(system, 0)
    return f"{system}{number - first:02d}" if 1 <= number - first <= 99 else None


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) and value != 0.0 else None


def _minus(value: float | None) -> float | None:
    return None if value is None else -value
