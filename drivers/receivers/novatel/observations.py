"""Raw observations and navigation messages of NovAtel receivers: binary RANGE, RAWEPHEM.

Source: NovAtel OM-20000169, RANGE, "Channel Tracking Status", RAWEPHEM; RINEX 3.04, tables 9 to 15.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from typing import Final

from drivers.receivers.gps_ephemeris import Subframe
from drivers.receivers.novatel.framing import log_of, novatel_framer
from drivers.receivers.observations import (
    WEEK_NS,
    Observation,
    ObservationCounts,
    ObservationEpoch,
    present,
)

RANGE: Final = (43, "RANGE")
RAWEPHEM: Final = (41, "RAWEPHEM")
_RAWEPHEM_HEAD_NBYTES: Final = 12
_SUBFRAME_NBYTES: Final = 30
_SIGNAL: Final = struct.Struct("<HHdfdffffI")

_CODES: Final[Mapping[tuple[int, int], tuple[str, str]]] = {
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
        if log.identity not in RANGE:
            continue
        epoch = None
        if isinstance(log.body, bytes):
            epoch = _range(log.week * WEEK_NS + log.tow_ns, log.body, counts)
        if epoch is None:
            counts.unreadable += 1
        else:
            counts.epochs += 1
            yield epoch


def novatel_subframes(data: bytes) -> Iterator[Subframe]:
    """Subframes 1 to 3 of GPS, of binary RAWEPHEM logs in a recording.

    Args:
        data: bytes as received.

    Yields:
        Subframes in the order received.
    """
    for frame in novatel_framer().feed(data):
        try:
            log = log_of(frame)
        except ValueError:
            continue
        body = log.body
        if log.identity not in RAWEPHEM or not isinstance(body, bytes):
            continue
        if len(body) < _RAWEPHEM_HEAD_NBYTES + 3 * _SUBFRAME_NBYTES:
            continue
        satellite = int.from_bytes(body[:4], "little")
        if not 1 <= satellite <= 32:
            continue
        for k in range(3):
            at = _RAWEPHEM_HEAD_NBYTES + k * _SUBFRAME_NBYTES
            yield Subframe(satellite, int.from_bytes(body[at : at + _SUBFRAME_NBYTES], "big"))


def _range(gps_ns: int, body: bytes, counts: ObservationCounts) -> ObservationEpoch | None:
    if len(body) < 4:
        return None
    (count,) = struct.unpack_from("<I", body)
    if len(body) != 4 + count * _SIGNAL.size:
        return None
    found = []
    for at in range(4, len(body), _SIGNAL.size):
        number, channel, pseudorange, _, phase, _, doppler, strength, lock_s, status = (
            _SIGNAL.unpack_from(body, at)
        )
        known = _CODES.get((status >> 16 & 7, status >> 21 & 31))
        satellite = _satellite(known[0], number) if known else None
        if known is None or satellite is None:
            counts.unknown_signals += 1
            continue
        has_phase, has_code = bool(status & 1 << 10), bool(status & 1 << 12)
        found.append(
            Observation(
                satellite,
                known[1],
                present(pseudorange) if has_code else None,
                _minus(present(phase)) if has_phase else None,
                present(doppler),
                present(strength),
                float(lock_s),
                half_cycle=has_phase and not status & 1 << 11,
                channel=channel - 7 if known[0] == "R" else None,
            )
        )
    return ObservationEpoch(gps_ns, tuple(found))


def _satellite(system: str, number: int) -> str | None:
    first = {"R": 37, "S": 100, "J": 192}.get(system, 0)
    return f"{system}{number - first:02d}" if 1 <= number - first <= 99 else None


def _minus(value: float | None) -> float | None:
    return None if value is None else -value
