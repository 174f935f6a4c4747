"""The legacy navigation message of GPS and QZSS: subframes into ephemerides.

Receivers send subframes as words of 24 bits without parity; their own messages are taken apart next
to their drivers. Subframes 1 to 3 of one issue of data make an ephemeris.

Source: IS-GPS-200N, 20.3.3.3 and 20.3.3.4, figure 20-1, tables 20-I, 20-III and 20-XII;
IS-QZSS-PNT-005, 4.1.2, which has the same fields; RINEX 3.04, tables A6 and A12.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

PI: Final = 3.1415926535898
"""The value that the message is defined with."""
WORD_BITS: Final = 24
WORDS: Final = 10
WEEKS: Final = 1024
_SATELLITES: Final = {"G": 32, "J": 10}
_URA_M: Final = (2.0, 2.8, 4.0, 5.7, 8.0, 11.3, 16.0, 32.0, 64.0, 128.0, 256.0, 512.0, 1024.0,
                 2048.0, 4096.0, 8192.0)  # fmt: skip
_FIT_H: Final = (
    (range(240, 248), 8.0), (range(248, 256), 14.0), (range(496, 497), 14.0),
    (range(497, 504), 26.0), (range(1021, 1024), 26.0), (range(504, 511), 50.0),
    (range(511, 512), 74.0), (range(752, 757), 74.0), (range(757, 758), 98.0),
)  # fmt: skip
"""Length of the curve fit by issue of data, where the flag states more than four hours."""


@dataclass(frozen=True)
class Subframe:
    """One subframe of one satellite: `bits` are its ten words of 24 bits, the first one highest.

    `system` is RINEX's letter, G or J.
    """

    satellite: int
    bits: int
    system: str = "G"

    def field(self, word: int, first: int, count: int, *, signed: bool = False) -> int:
        """A field.

        Args:
            word: number of the word where it begins, from 1.
            first: its first bit in that word, from 1.
            count: of bits; a field goes on in the next word.
            signed: two's complement.

        Returns:
            The number.
        """
        last = (word - 1) * WORD_BITS + first - 1 + count
        value = self.bits >> (WORDS * WORD_BITS - last) & ((1 << count) - 1)
        return value - (1 << count) if signed and value >> (count - 1) else value

    @property
    def number(self) -> int:
        """1 to 5; others are damaged."""
        return self.field(2, 20, 3)

    @property
    def tow_s(self) -> float:
        """Time of week of the beginning of the next subframe, s."""
        return self.field(2, 1, 17) * 6.0


@dataclass(frozen=True)
class GpsEphemeris:
    """Elements of an orbit and a clock in the message's units, angles in radians.

    `values` are in the order of a RINEX record: clock (3), then seven lines of four numbers, the
    last one of two.
    """

    satellite: int
    week: int
    toc_s: float
    toe_s: float
    values: tuple[float, ...]
    system: str = "G"


def subframe_of_words(satellite: int, words: Sequence[int], system: str = "G") -> Subframe | None:
    """A subframe from words of 30 bits.

    Args:
        satellite: number, 1 to 32 of GPS, 1 to 10 of QZSS.
        words: ten, each with the data in bits 29 to 6, its parity in bits 5 to 0.
        system: G or J.

    Returns:
        The subframe; None where number or words are none of such a satellite.
    """
    if not 1 <= satellite <= _SATELLITES[system] or len(words) != WORDS:
        return None
    bits = 0
    for word in words:
        bits = bits << WORD_BITS | (word >> 6 & 0xFFFFFF)
    return Subframe(satellite, bits, system)


def ephemerides_of(subframes: Iterable[Subframe], near_week: int) -> Iterator[GpsEphemeris]:
    """Ephemerides from subframes in the order received, each issue once.

    Args:
        subframes: of all satellites.
        near_week: GPS week without rollover, which decides the week of 1,024.

    Yields:
        An ephemeris as soon as its third subframe has come.
    """
    parts: dict[tuple[str, int], dict[int, Subframe]] = {}
    emitted: set[tuple[str, int, float, int]] = set()
    for subframe in subframes:
        if subframe.number not in (1, 2, 3):
            continue
        own = parts.setdefault((subframe.system, subframe.satellite), {})
        own[subframe.number] = subframe
        if len(own) < 3:
            continue
        issue = own[2].field(3, 1, 8)
        if issue != own[3].field(10, 1, 8) or issue != own[1].field(8, 1, 8):
            continue
        found = _ephemeris(own, near_week)
        key = (found.system, found.satellite, found.toe_s, issue)
        if key not in emitted:
            emitted.add(key)
            yield found


def _ephemeris(own: dict[int, Subframe], near_week: int) -> GpsEphemeris:
    one, two, three = own[1], own[2], own[3]

    def scaled(
        part: Subframe, at: tuple[int, int, int], power: int, *, signed: bool = True
    ) -> float:
        return part.field(*at, signed=signed) * float(2.0**power)

    def angle(part: Subframe, at: tuple[int, int, int], power: int) -> float:
        return scaled(part, at, power) * PI

    issue = one.field(3, 23, 2) << 8 | one.field(8, 1, 8)
    toc_s, toe_s = one.field(8, 9, 16) * 16.0, two.field(10, 1, 16) * 16.0
    values = (
        scaled(one, (10, 1, 22), -31), scaled(one, (9, 9, 16), -43), scaled(one, (9, 1, 8), -55),
        float(two.field(3, 1, 8)), scaled(two, (3, 9, 16), -5), angle(two, (4, 1, 16), -43),
        angle(two, (4, 17, 32), -31),
        scaled(two, (6, 1, 16), -29), scaled(two, (6, 17, 32), -33, signed=False),
        scaled(two, (8, 1, 16), -29), scaled(two, (8, 17, 32), -19, signed=False),
        toe_s, scaled(three, (3, 1, 16), -29), angle(three, (3, 17, 32), -31),
        scaled(three, (5, 1, 16), -29),
        angle(three, (5, 17, 32), -31), scaled(three, (7, 1, 16), -5),
        angle(three, (7, 17, 32), -31), angle(three, (9, 1, 24), -43),
        angle(three, (10, 9, 14), -43), float(one.field(3, 11, 2)),
        float(_week(one.field(3, 1, 10), near_week, one.tow_s, toe_s)), float(one.field(4, 1, 1)),
        _URA_M[one.field(3, 13, 4)], float(one.field(3, 17, 6)), scaled(one, (7, 17, 8), -31),
        float(issue),
        one.tow_s, _fit(one.system, issue, is_long=bool(two.field(10, 17, 1))),
    )  # fmt: skip
    return GpsEphemeris(one.satellite, round(values[21]), toc_s, toe_s, values, one.system)


def _week(sent: int, near_week: int, tow_s: float, toe_s: float) -> int:
    """Week of the reference time: near the end of a week it may be in the next one."""
    week = near_week + (sent - near_week + WEEKS // 2) % WEEKS - WEEKS // 2
    return week + round((tow_s - toe_s) / 604_800.0)


def _fit(system: str, issue: int, *, is_long: bool) -> float:
    """Curve fit: hours of GPS, the flag itself of QZSS."""
    if system == "J":
        return float(is_long)
    if not is_long:
        return 4.0
    return next((hours for issues, hours in _FIT_H if issue in issues), 6.0)
