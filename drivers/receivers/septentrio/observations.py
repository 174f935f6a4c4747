"""Raw observations and navigation messages of Septentrio receivers: MeasEpoch, GPSRawCA and others.

The first signal of a satellite is a block of its own; the others follow it as differences: of the
pseudorange, of the phase from the pseudorange in cycles, of the Doppler scaled by the frequencies.

Source: Septentrio mosaic-X5 reference guide, firmware 4.14, chapter 4, "MeasEpoch", "GPSRawCA",
"Signal type" and "Satellite ID and GLONASS frequency number"; RINEX 3.04, tables 9 to 15.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
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
)
from drivers.receivers.septentrio.blocks import (
    HEADER,
    TOW_UNKNOWN,
    WEEK_MS,
    WEEK_UNKNOWN,
    sbf_framer,
)

MEAS_EPOCH: Final = 4027
GPS_RAW_CA: Final = 4017
GAL_RAW_INAV: Final = 4023
GLO_RAW_CA: Final = 4026
BDS_RAW: Final = 4047
QZS_RAW_L1CA: Final = 4066
_UNREAD: Final = {
    4018: "GPS CNAV", 4019: "GPS CNAV", 4022: "Galileo F/NAV", 4067: "QZSS CNAV", 4068: "QZSS CNAV",
    4093: "NavIC", 4218: "BeiDou CNAV", 4219: "BeiDou CNAV", 4242: "BeiDou CNAV",
}  # fmt: skip
MEAS3_RANGES: Final = 4109
_RAW_CA: Final = struct.Struct("<6xBB4x10I")
_RAW_HEAD: Final = struct.Struct("<6xBBxBBx")
_E1: Final = 17
_RAW_WORDS: Final = {GAL_RAW_INAV: 8, GLO_RAW_CA: 3, BDS_RAW: 10}
LIGHT_MPS: Final = 299_792_458.0
_HEAD: Final = struct.Struct("<IHBBBB")
_FIRST: Final = struct.Struct("<BBBBIiHbBHBB")
_OTHER: Final = struct.Struct("<BBBBbBHHH")
_E6B: Final = 1 << 6
_SCRAMBLED: Final = 1 << 7
_HALF_CYCLE: Final = 1 << 2
_EXTENDED: Final = 31
"""This number of five bits means: 32 more than the upper five bits of ObsInfo."""
_NOT_MEASURED: Final = {"doppler": -0x80000000, "lock": 0xFFFF, "short_lock": 0xFF, "strength": 255}
_PHASE_NOT_MEASURED: Final = (-128, 0)
_CODE_NOT_MEASURED: Final = (-4, 0)
_DOPPLER_NOT_MEASURED: Final = (-16, 0)
_FINE_STRENGTH: Final = (1, 2)
"""Signals whose strength has no offset of 10 dB-Hz: GPS P(Y)."""

_L1, _L2, _L5 = 1_575_420_000.0, 1_227_600_000.0, 1_176_450_000.0
_E5B, _E6 = 1_207_140_000.0, 1_278_750_000.0
_SIGNALS: Final[Mapping[int, tuple[str, str, float]]] = {
    0: ("G", "1C", _L1), 1: ("G", "1W", _L1), 2: ("G", "2W", _L2), 3: ("G", "2L", _L2),
    4: ("G", "5Q", _L5), 5: ("G", "1L", _L1),
    6: ("J", "1C", _L1), 7: ("J", "2L", _L2), 26: ("J", "5Q", _L5), 27: ("J", "6L", _E6),
    32: ("J", "1L", _L1), 33: ("J", "1Z", _L1),
    8: ("R", "1C", 1_602_000_000.0), 9: ("R", "1P", 1_602_000_000.0),
    10: ("R", "2P", 1_246_000_000.0), 11: ("R", "2C", 1_246_000_000.0),
    12: ("R", "3Q", 1_202_025_000.0),
    13: ("C", "1P", _L1), 14: ("C", "5P", _L5), 28: ("C", "2I", 1_561_098_000.0),
    29: ("C", "7I", _E5B), 30: ("C", "6I", 1_268_520_000.0), 34: ("C", "7D", _E5B),
    15: ("I", "5A", _L5),
    17: ("E", "1C", _L1), 19: ("E", "6C", _E6), 20: ("E", "5Q", _L5), 21: ("E", "7Q", _E5B),
    22: ("E", "8Q", 1_191_795_000.0),
    24: ("S", "1C", _L1), 25: ("S", "5I", _L5),
}  # fmt: skip
"""RINEX system and code, and the frequency in Hz, by signal number."""
_CHANNEL_HZ: Final = {"1": 562_500.0, "2": 437_500.0}
"""Steps of GLONASS's frequencies by band."""
_SATELLITES: Final = (
    (1, 37, "G", 0), (38, 61, "R", 37), (63, 68, "R", 38), (71, 106, "E", 70),
    (120, 140, "S", 100), (141, 180, "C", 140), (181, 190, "J", 180), (191, 197, "I", 190),
    (198, 215, "S", 157), (216, 222, "I", 208), (223, 245, "C", 182),
)  # fmt: skip
"""First and last SVID, system, and what is subtracted for its number."""


@dataclass(frozen=True)
class _Signal:
    code: str
    hertz: float
    channel: int | None
    is_fine: bool


def septentrio_observations(data: bytes, counts: ObservationCounts) -> Iterator[ObservationEpoch]:
    """Epochs of MeasEpoch in a recording, of the main antenna.

    Args:
        data: bytes as received.
        counts: are counted up.

    Yields:
        Epochs in the order received.
    """
    for frame in sbf_framer().feed(data):
        if int.from_bytes(frame[4:6], "little") & 0x1FFF != MEAS_EPOCH:
            continue
        try:
            epoch = _epoch(frame[HEADER.size :], counts)
        except struct.error:
            epoch = None
        if epoch is None:
            counts.unreadable += 1
        else:
            counts.epochs += 1
            yield epoch


def septentrio_subframes(data: bytes) -> Iterator[Subframe]:
    """Subframes of GPS and QZSS L1 C/A, of GPSRawCA and QZSRawL1CA in a recording.

    Those with wrong parity are left out.

    Args:
        data: bytes as received.

    Yields:
        Subframes in the order received.
    """
    for frame in sbf_framer().feed(data):
        block = int.from_bytes(frame[4:6], "little") & 0x1FFF
        if block not in (GPS_RAW_CA, QZS_RAW_L1CA):
            continue
        body = frame[HEADER.size :]
        if len(body) < _RAW_CA.size:
            continue
        number, is_right, *words = _RAW_CA.unpack_from(body)
        name = _name(number) or "S0"
        if name[0] != ("G" if block == GPS_RAW_CA else "J"):
            continue
        subframe = subframe_of_words(int(name[1:]), words, name[0])
        if is_right and subframe is not None:
            yield subframe


def septentrio_pages(data: bytes) -> Iterator[RawPage]:
    """Pages of GALRawINAV, GLORawCA and BDSRaw in a recording.

    Those with wrong checksums are left out.

    Args:
        data: bytes as received.

    Yields:
        Pages in the order received.

    Source: Septentrio mosaic-X5 reference guide, firmware 4.14, chapter 4, "GALRawINAV",
        "GLORawCA", "BDSRaw".
    """
    for frame in sbf_framer().feed(data):
        block = int.from_bytes(frame[4:6], "little") & 0x1FFF
        body = frame[HEADER.size :]
        count = _RAW_WORDS.get(block, 0)
        if not count or len(body) < _RAW_HEAD.size + 4 * count:
            continue
        number, is_right, source, channel = _RAW_HEAD.unpack_from(body)
        name = _name(number)
        if not is_right or name is None:
            continue
        bits = 0
        for word in struct.unpack_from(f"<{count}I", body, _RAW_HEAD.size):
            bits = bits << 32 | word
        page = None
        if block == GAL_RAW_INAV and name[0] == "E" and source & 31 == _E1:
            # 114 bits of one part, 120 of the other, without the tail of the first.
            parts = bits >> 142, bits >> 28 & ((1 << 114) - 1)
            even, odd = parts if not parts[0] >> 113 else parts[::-1]
            page = galileo_page(int(name[1:]), even, odd)
        elif block == GLO_RAW_CA and name[0] == "R":
            page = glonass_page(int(name[1:]), bits >> 11, channel - 8)
        elif block == BDS_RAW and name[0] == "C":
            page = beidou_page(int(name[1:]), bits >> 20)
        if page is not None:
            yield page


def septentrio_unread(data: bytes) -> tuple[str, ...]:
    """Navigation messages in a recording that are not read.

    Args:
        data: bytes as received.

    Returns:
        Their names, each once.
    """
    blocks = {int.from_bytes(frame[4:6], "little") & 0x1FFF for frame in sbf_framer().feed(data)}
    return tuple(sorted({_UNREAD[block] for block in blocks & _UNREAD.keys()}))


def has_meas3(data: bytes) -> bool:
    """Whether a recording has Meas3Ranges, whose compressed observations are not read.

    Args:
        data: bytes as received.

    Returns:
        True with the first such block.
    """
    return any(
        int.from_bytes(frame[4:6], "little") & 0x1FFF == MEAS3_RANGES
        for frame in sbf_framer().feed(data)
    )


def _epoch(body: bytes, counts: ObservationCounts) -> ObservationEpoch | None:
    tow_ms, week, count, size, other_size, flags = _HEAD.unpack_from(body)
    if tow_ms == TOW_UNKNOWN or tow_ms >= WEEK_MS or week == WEEK_UNKNOWN or flags & _SCRAMBLED:
        return None
    if size < _FIRST.size or other_size < _OTHER.size:
        return None
    found: list[Observation] = []
    at = _HEAD.size + 2  # behind CumClkJumps and a reserved byte
    for _ in range(count):
        others = _FIRST.unpack_from(body, at)[-1]
        rows = [at + size + k * other_size for k in range(others)]
        found += _satellite(body, at, rows, counts, has_e6b=bool(flags & _E6B))
        at += size + others * other_size
    return ObservationEpoch(week * WEEK_NS + tow_ms * 1_000_000, tuple(found))


def _satellite(
    body: bytes, at: int, rows: list[int], counts: ObservationCounts, *, has_e6b: bool
) -> Iterator[Observation]:
    """The signals of one satellite: the first one at `at`, the others at `rows`."""
    (_, kind, number, high, low, doppler, phase_low, phase_high, strength, lock_s, info, _) = (
        _FIRST.unpack_from(body, at)
    )
    code_m = ((high & 15) << 32 | low) * 1e-3 or None
    doppler_hz = None if doppler == _NOT_MEASURED["doppler"] else doppler * 1e-4
    name = _name(number)
    first = _signal(kind, info, name, has_e6b=has_e6b)
    is_main = kind >> 5 == 0
    if not is_main:
        counts.other_antennas += 1
    elif first is None or name is None:
        counts.unknown_signals += 1
    else:
        phase = phase_high, phase_low
        lock_s = 0 if lock_s == _NOT_MEASURED["lock"] else lock_s
        yield _observation(name, first, code_m, phase, doppler_hz, strength, lock_s, info)
    for row in rows:
        (kind, lock_s, strength, high, phase_high, info, code_low, phase_low, doppler_low) = (
            _OTHER.unpack_from(body, row)
        )
        signal = _signal(kind, info, name, has_e6b=has_e6b)
        if not is_main or kind >> 5:
            counts.other_antennas += 1
            continue
        if signal is None or name is None:
            counts.unknown_signals += 1
            continue
        offset = _signed(high & 7, 3), code_low
        own_m = None
        if code_m is not None and offset != _CODE_NOT_MEASURED:
            own_m = code_m + (offset[0] * 65_536 + offset[1]) * 1e-3
        change = _signed(high >> 3, 5), doppler_low
        own_hz = None
        if doppler_hz is not None and first is not None and change != _DOPPLER_NOT_MEASURED:
            own_hz = doppler_hz * signal.hertz / first.hertz
            own_hz += (change[0] * 65_536 + change[1]) * 1e-4
        phase = phase_high, phase_low
        lock_s = 0 if lock_s == _NOT_MEASURED["short_lock"] else lock_s
        yield _observation(name, signal, own_m, phase, own_hz, strength, lock_s, info)


def _observation(
    name: str,
    signal: _Signal,
    code_m: float | None,
    phase: tuple[int, int],
    doppler_hz: float | None,
    strength: int,
    lock_s: int,
    info: int,
) -> Observation:
    return Observation(
        name,
        signal.code,
        code_m,
        _phase(signal, code_m, *phase),
        doppler_hz,
        _strength(signal, strength),
        float(lock_s),
        half_cycle=bool(info & _HALF_CYCLE),
        channel=signal.channel,
    )


def _name(number: int) -> str | None:
    for first, last, system, offset in _SATELLITES:
        if first <= number <= last:
            return f"{system}{number - offset:02d}"
    return None


def _signal(kind: int, info: int, name: str | None, *, has_e6b: bool) -> _Signal | None:
    """What a signal number means; None where it is none of the satellite's system."""
    number = kind & 31
    if number == _EXTENDED:
        number = 32 + (info >> 3)
    known = _SIGNALS.get(number)
    if known is None or name is None or known[0] != name[0]:
        return None
    system, code, hertz = known
    if system == "E" and code == "6C" and has_e6b:
        code = "6B"
    channel = None
    if system == "R":
        channel = (info >> 3) - 8
        hertz += channel * _CHANNEL_HZ.get(code[0], 0.0)
    return _Signal(code, hertz, channel, number in _FINE_STRENGTH)


def _phase(signal: _Signal, code_m: float | None, high: int, low: int) -> float | None:
    if code_m is None or (high, low) == _PHASE_NOT_MEASURED:
        return None
    return code_m * signal.hertz / LIGHT_MPS + (high * 65_536 + low) * 1e-3


def _strength(signal: _Signal, value: int) -> float | None:
    if value == _NOT_MEASURED["strength"]:
        return None
    return value * 0.25 + (0.0 if signal.is_fine else 10.0)


def _signed(value: int, bits: int) -> int:
    return value - (1 << bits) if value >> (bits - 1) else value
