"""Raw observations and navigation messages of u-blox receivers: RXM-RAWX, RXM-SFRBX.

Source: u-blox F9 interface description, UBX-18010854, RXM-RAWX and RXM-SFRBX; RINEX 3.04, tables 9
to 15.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from typing import Final

from drivers.receivers.broadcast_ephemeris import (
    RawPage,
    beidou_page,
    galileo_page,
    glonass_page,
)
from drivers.receivers.gps_ephemeris import Subframe, subframe_of_words
from drivers.receivers.observations import (
    WEEK_NS,
    Observation,
    ObservationCounts,
    ObservationEpoch,
    present,
)
from drivers.receivers.ublox.framing import UbxFramer

RAWX: Final = (0x02, 0x15)
SFRBX: Final = (0x02, 0x13)
_SFRBX_HEAD_NBYTES: Final = 8
_HEAD: Final = struct.Struct("<dHbBBB2x")
_SIGNAL: Final = struct.Struct("<ddfBBBBHBBBBBx")

_CODES: Final[Mapping[tuple[int, int], tuple[str, str]]] = {
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
_NUMBER_OFFSETS: Final = {"S": 100, "J": 0}


def ublox_observations(data: bytes, counts: ObservationCounts) -> Iterator[ObservationEpoch]:
    """Epochs of RXM-RAWX in a recording.

    Args:
        data: bytes as received.
        counts: are counted up.

    Yields:
        Epochs in the order received.
    """
    for frame in UbxFramer().feed(data):
        if (frame[2], frame[3]) != RAWX:
            continue
        epoch = _rawx(frame[6:-2], counts)
        if epoch is None:
            counts.unreadable += 1
        else:
            counts.epochs += 1
            yield epoch


_UNREAD: Final = {
    (0, 3): "GPS CNAV", (0, 4): "GPS CNAV", (0, 6): "GPS CNAV", (0, 7): "GPS CNAV",
    (2, 3): "Galileo F/NAV", (2, 4): "Galileo F/NAV", (3, 5): "BeiDou CNAV", (3, 6): "BeiDou CNAV",
    (3, 7): "BeiDou CNAV", (3, 8): "BeiDou CNAV", (5, 4): "QZSS CNAV", (5, 5): "QZSS CNAV",
    (5, 8): "QZSS CNAV", (5, 9): "QZSS CNAV", (7, 0): "NavIC",
}  # fmt: skip
_LEGACY: Final = {0: "G", 5: "J"}
"""Systems with the legacy message of GPS."""


def ublox_subframes(data: bytes) -> Iterator[Subframe]:
    """Subframes of GPS and QZSS L1 C/A, of RXM-SFRBX in a recording.

    Args:
        data: bytes as received; the receiver has checked parities.

    Yields:
        Subframes in the order received.
    """
    for system, satellite, signal, words, _ in _sfrbx(data):
        if system in _LEGACY and signal == 0:
            subframe = subframe_of_words(satellite, words, _LEGACY[system])
            if subframe is not None:
                yield subframe


def ublox_pages(data: bytes) -> Iterator[RawPage]:
    """Pages of Galileo, GLONASS and BeiDou, of RXM-SFRBX in a recording.

    Args:
        data: bytes as received; the receiver has checked parities.

    Yields:
        Pages in the order received; I/NAV of E1-B, strings, D1 and D2.
    """
    for system, satellite, signal, words, channel in _sfrbx(data):
        bits = 0
        for word in words:
            bits = bits << 32 | word
        page = None
        if system == 2 and signal in (0, 1) and len(words) in (8, 9):
            bits >>= 32 * (len(words) - 8)
            # Two parts of 128 bits, of which the first 114 are data.
            page = galileo_page(satellite, bits >> 142, bits >> 14 & ((1 << 114) - 1))
        elif system == 6 and len(words) == 4:
            page = glonass_page(satellite, bits >> 43, channel - 7)
        elif system == 3 and signal in (0, 1, 2, 3) and len(words) == 10:
            bits = 0
            for word in words:
                bits = bits << 30 | word & 0x3FFFFFFF
            page = beidou_page(satellite, bits)
        if page is not None:
            yield page


def ublox_unread(data: bytes) -> tuple[str, ...]:
    """Navigation messages in a recording that are not read.

    Args:
        data: bytes as received.

    Returns:
        Their names, each once.
    """
    kinds = {(system, signal) for system, _, signal, _, _ in _sfrbx(data)}
    return tuple(sorted({_UNREAD[kind] for kind in kinds & _UNREAD.keys()}))


def _sfrbx(data: bytes) -> Iterator[tuple[int, int, int, tuple[int, ...], int]]:
    """System, satellite, signal, words and frequency number of each RXM-SFRBX."""
    for frame in UbxFramer().feed(data):
        payload = frame[6:-2]
        if (frame[2], frame[3]) != SFRBX or len(payload) < _SFRBX_HEAD_NBYTES:
            continue
        system, satellite, signal, channel, count = payload[:5]
        if len(payload) != _SFRBX_HEAD_NBYTES + 4 * count:
            continue
        words = struct.unpack_from(f"<{count}I", payload, _SFRBX_HEAD_NBYTES)
        yield system, satellite, signal, words, channel


def _rawx(payload: bytes, counts: ObservationCounts) -> ObservationEpoch | None:
    if len(payload) < _HEAD.size:
        return None
    tow_s, week, _, count, _, _ = _HEAD.unpack_from(payload)
    if len(payload) != _HEAD.size + count * _SIGNAL.size or not 0.0 <= tow_s < 604_800.0:
        return None
    found = []
    for at in range(_HEAD.size, len(payload), _SIGNAL.size):
        values = _SIGNAL.unpack_from(payload, at)
        pseudorange, phase, doppler, system, number, signal, frequency, lock_ms, cno = values[:9]
        status = values[12]
        known = _CODES.get((system, signal))
        offset = _NUMBER_OFFSETS.get(known[0], 0) if known else 0
        if known is None or not 1 <= number - offset <= 99:
            counts.unknown_signals += 1
            continue
        found.append(
            Observation(
                f"{known[0]}{number - offset:02d}",
                known[1],
                present(pseudorange) if status & 1 else None,
                present(phase) if status & 2 else None,
                present(doppler),
                float(cno) if cno else None,
                lock_ms * 1e-3,
                half_cycle=bool(status & 2 and not status & 4),
                channel=frequency - 7 if known[0] == "R" else None,
            )
        )
    return ObservationEpoch(week * WEEK_NS + round(tow_s * 1e9), tuple(found))
