"""Navigation messages of Galileo, GLONASS and BeiDou: raw pages into ephemerides.

Receivers' own messages are taken apart next to their drivers and come as `RawPage`. Read are I/NAV
of Galileo's E1-B, strings 1 to 4 of GLONASS, and D1 of BeiDou, of geostationary satellites D2;
F/NAV and CNAV are not.

Source: Galileo OS SIS ICD 2.1, 4.3 and 5.1; GLONASS ICD L1, L2, edition 5.1, 4.4; BDS-SIS-ICD-B1I
3.0, 5.2 and 5.3; RINEX 3.04, tables A8, A10 and A14.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Final

from drivers.receivers.gps_ephemeris import PI

URA_M: Final = (2.0, 2.8, 4.0, 5.7, 8.0, 11.3, 16.0, 32.0, 64.0, 128.0, 256.0, 512.0, 1024.0,
                2048.0, 4096.0, 8192.0)  # fmt: skip
WEEK_S: Final = 604_800.0
DAY_S: Final = 86_400.0
_GPS_EPOCH: Final = datetime(1980, 1, 6, tzinfo=UTC)
_BEIDOU_EPOCH: Final = datetime(2006, 1, 1, tzinfo=UTC)
_FOUR_YEARS: Final = 1461
_GALILEO_WEEK: Final = 1024
"""GPS week in which the weeks of Galileo begin to be counted."""
_GALILEO_WEEKS: Final = 4096
_MOSCOW_S: Final = 10_800.0
_DATA_SOURCE: Final = float(1 << 0 | 1 << 9)
"""I/NAV of E1-B, clock of E5b and E1."""


@dataclass(frozen=True)
class RawPage:
    """What a receiver sends of one page, string or subframe, without parity.

    `system` is RINEX's letter. `bits` are 128 of a Galileo word, 85 of a GLONASS string, 224 of a
    BeiDou subframe, the first one highest; `channel` is GLONASS's frequency number.
    """

    system: str
    satellite: int
    bits: int
    channel: int = 0


@dataclass(frozen=True)
class BroadcastEphemeris:
    """One record of a RINEX navigation file: `values` are its numbers in order.

    `clock_time` is the reference time of the clock in the calendar of the system: GST, UTC of
    GLONASS, BDT. `message` is RINEX 4's name. `status` is the line that RINEX 4 adds for GLONASS.
    """

    satellite: str
    message: str
    clock_time: datetime
    values: tuple[float, ...]
    status: tuple[float, ...] = ()


def _layout(text: str) -> tuple[tuple[str, int, bool], ...]:
    """Fields in order as name:bits; minus is two's complement."""
    pairs = (word.split(":") for word in text.split())
    return tuple((name, abs(int(bits)), bits.startswith("-")) for name, bits in pairs)


_GALILEO: Final = {
    1: _layout("type:6 iod:10 toe:14 m0:-32 e:32 root_a:32 spare:2"),
    2: _layout("type:6 iod:10 node:-32 i0:-32 omega:-32 idot:-14 spare:2"),
    3: _layout("type:6 iod:10 node_rate:-24 dn:-16 cuc:-16 cus:-16 crc:-16 crs:-16 sisa:8"),
    4: _layout("type:6 iod:10 sv:6 cic:-16 cis:-16 toc:14 af0:-31 af1:-21 af2:-6 spare:2"),
    5: _layout(
        "type:6 ionosphere:41 bgd_a:-10 bgd_b:-10 hs_b:2 hs_1:2 dvs_b:1 dvs_1:1 week:12 tow:20 "
        "spare:23"
    ),
}
_BEIDOU: Final = {
    1: _layout(
        "preamble:11 spare:4 id:3 sow:20 health:1 aodc:5 ura:4 week:13 toc:17 tgd1:-10 tgd2:-10 "
        "ionosphere:64 a2:-11 a0:-24 a1:-22 aode:5"
    ),
    2: _layout(
        "preamble:11 spare:4 id:3 sow:20 dn:-16 cuc:-18 m0:-32 e:32 cus:-18 crc:-18 crs:-18 "
        "root_a:32 toe_high:2"
    ),
    3: _layout(
        "preamble:11 spare:4 id:3 sow:20 toe_low:15 i0:-32 cic:-18 node_rate:-24 cis:-18 idot:-14 "
        "node:-32 omega:-32 spare2:1"
    ),
}
_HEAD_D2: Final = "preamble:11 spare:4 id:3 sow:20 page:4 "
_BEIDOU_D2: Final = {
    1: _layout(_HEAD_D2 + "health:1 aodc:5 ura:4 week:13 toc:17 tgd1:-10 tgd2:-10"),
    3: _layout(_HEAD_D2 + "spare2:38 a0:-24 a1_high:-4"),
    4: _layout(_HEAD_D2 + "a1_low:18 a2:-11 aode:5 dn:-16 cuc_high:-14"),
    5: _layout(_HEAD_D2 + "cuc_low:4 m0:-32 cus:-18 e_high:10"),
    6: _layout(_HEAD_D2 + "e_low:22 root_a:32 cic_high:-10"),
    7: _layout(_HEAD_D2 + "cic_low:8 cis:-18 toe:17 i0_high:-21"),
    8: _layout(_HEAD_D2 + "i0_low:11 crc:-18 crs:-18 node_rate_high:-19"),
    9: _layout(_HEAD_D2 + "node_rate_low:5 node:-32 omega_high:-27"),
    10: _layout(_HEAD_D2 + "omega_low:5 idot:-14"),
}
"""Pages of subframe 1; the second one has the ionosphere."""
_LOW_BITS: Final = {
    "a1": 18, "cuc": 4, "e": 22, "cic": 8, "i0": 11, "node_rate": 5, "omega": 5,
}  # fmt: skip
"""Bits in the later one of two pages that share a number."""
_GLONASS: Final = {
    1: _layout("idle:1 number:4 spare:2 p1:2 hours:5 minutes:6 half:1 v:24 a:5 x:27 check:8"),
    2: _layout("idle:1 number:4 bn:3 p2:1 tb:7 spare:5 v:24 a:5 x:27 check:8"),
    3: _layout("idle:1 number:4 p3:1 gamma:11 spare:1 p:2 ln:1 v:24 a:5 x:27 check:8"),
    4: _layout(
        "idle:1 number:4 tau:22 delta:5 age:5 spare:14 p4:1 ft:4 spare2:3 day:11 slot:5 m:2 check:8"
    ),
}
_SIGNED_MAGNITUDE: Final = {"v": 24, "a": 5, "x": 27, "gamma": 11, "tau": 22, "delta": 5}
_GALILEO_BITS, _BEIDOU_BITS, _GLONASS_BITS = 128, 224, 85
_BEIDOU_SUBFRAME_S: Final = 6
_BEIDOU_FRAME_D2_S: Final = 3
_BEIDOU_MAX: Final = 63
_BEIDOU_PREAMBLE: Final = 0b11100010010
_FIRST_D1, _LAST_D1 = 6, 58
_SLOTS: Final = 24


def galileo_page(satellite: int, even: int, odd: int) -> RawPage | None:
    """A word of I/NAV from the two parts of a nominal page.

    Args:
        satellite: number, 1 to 36.
        even: 114 bits, without the tail.
        odd: 114 bits, without the tail.

    Returns:
        The page; None for an alert page, parts in another order, or a wrong checksum.

    Source: Galileo OS SIS ICD 2.1, 4.3.2.3 and 5.1.9.4.
    """
    kinds = (even >> 112 & 3, odd >> 112 & 3)
    if kinds != (0b00, 0b10) or not 1 <= satellite <= 36:
        return None
    checked = even << 82 | odd >> 32
    if _crc24q(checked) != odd >> 8 & 0xFFFFFF:
        return None
    return RawPage("E", satellite, (even & ((1 << 112) - 1)) << 16 | odd >> 96 & 0xFFFF)


def _crc24q(bits: int) -> int:
    """Checksum of 196 bits, zeros in front (Galileo OS SIS ICD 2.1, 5.1.9.4)."""
    crc = 0
    for byte in bits.to_bytes(25, "big"):
        crc ^= byte << 16
        for _ in range(8):
            crc = (crc << 1) ^ (0x1864CFB if crc & 0x800000 else 0)
    return crc & 0xFFFFFF


def beidou_page(satellite: int, bits: int) -> RawPage | None:
    """A subframe of D1 or D2 from its 300 bits, parity taken out.

    Args:
        satellite: number, 1 to 63.
        bits: ten words of 30.

    Returns:
        The page; None for other preambles.

    Source: BDS-SIS-ICD-B1I 3.0, 5.1.3 and 5.2.1.
    """
    if not 1 <= satellite <= _BEIDOU_MAX or bits >> 289 != _BEIDOU_PREAMBLE:
        return None
    data = 0
    for word in range(10):
        value = bits >> 30 * (9 - word) & 0x3FFFFFFF
        data = data << (26 if word == 0 else 22) | value >> (4 if word == 0 else 8)
    return RawPage("C", satellite, data)


def glonass_page(satellite: int, bits: int, channel: int) -> RawPage | None:
    """A string from its 85 bits.

    Args:
        satellite: slot, 1 to 24.
        bits: idle bit first.
        channel: frequency number.

    Returns:
        The page; None where the slot is not known.
    """
    return RawPage("R", satellite, bits, channel) if 1 <= satellite <= _SLOTS else None


def broadcast_ephemerides(pages: Iterable[RawPage], near_week: int) -> Iterator[BroadcastEphemeris]:
    """Ephemerides from pages in the order received, each once.

    Args:
        pages: of all systems and satellites.
        near_week: GPS week without rollover, which decides what a message counts modulo.

    Yields:
        An ephemeris as soon as its last page has come.
    """
    parts: dict[tuple[str, int], dict[int, dict[str, int]]] = {}
    emitted: set[tuple[str, datetime, tuple[float, ...]]] = set()
    for page in pages:
        own = parts.setdefault((page.system, page.satellite), {})
        found = _READERS[page.system](page, own, near_week)
        if found is None:
            continue
        # The time of transmission changes with each repetition: it is not part of the issue.
        key = (found.satellite, found.clock_time, found.values[:20])
        if key not in emitted:
            emitted.add(key)
            yield found


def _fields(bits: int, total: int, layout: tuple[tuple[str, int, bool], ...]) -> dict[str, int]:
    found, left = {}, total
    for name, count, is_signed in layout:
        left -= count
        value = bits >> left & ((1 << count) - 1)
        found[name] = value - (1 << count) if is_signed and value >> (count - 1) else value
    return found


def _galileo(
    page: RawPage, own: dict[int, dict[str, int]], near_week: int
) -> BroadcastEphemeris | None:
    number = page.bits >> (_GALILEO_BITS - 6)
    if number not in _GALILEO:
        return None
    own[number] = _fields(page.bits, _GALILEO_BITS, _GALILEO[number])
    if number != 5 or len(own) < 5 or len({own[k]["iod"] for k in (1, 2, 3, 4)}) > 1:
        return None
    one, two, three, four, five = (own[k] for k in (1, 2, 3, 4, 5))
    if four["sv"] != page.satellite:
        return None
    toe_s, toc_s, tow_s = one["toe"] * 60.0, four["toc"] * 60.0, float(five["tow"])
    sent = five["week"] + _GALILEO_WEEK
    week = near_week + (sent - near_week + _GALILEO_WEEKS // 2) % _GALILEO_WEEKS
    week += round((tow_s - toe_s) / WEEK_S) - _GALILEO_WEEKS // 2
    health = five["dvs_1"] | five["hs_1"] << 1 | five["dvs_b"] << 6 | five["hs_b"] << 7
    values = (
        four["af0"] * 2.0**-34, four["af1"] * 2.0**-46, four["af2"] * 2.0**-59,
        float(one["iod"]), three["crs"] * 2.0**-5, three["dn"] * 2.0**-43 * PI,
        one["m0"] * 2.0**-31 * PI,
        three["cuc"] * 2.0**-29, one["e"] * 2.0**-33, three["cus"] * 2.0**-29,
        one["root_a"] * 2.0**-19,
        toe_s, four["cic"] * 2.0**-29, two["node"] * 2.0**-31 * PI, four["cis"] * 2.0**-29,
        two["i0"] * 2.0**-31 * PI, three["crc"] * 2.0**-5, two["omega"] * 2.0**-31 * PI,
        three["node_rate"] * 2.0**-43 * PI,
        two["idot"] * 2.0**-43 * PI, _DATA_SOURCE, float(week), 0.0,
        _sisa_m(three["sisa"]), float(health), five["bgd_a"] * 2.0**-32, five["bgd_b"] * 2.0**-32,
        tow_s,
    )  # fmt: skip
    at = week + round((toe_s - toc_s) / WEEK_S)
    clock = _GPS_EPOCH + timedelta(seconds=at * WEEK_S + toc_s)
    return BroadcastEphemeris(f"E{page.satellite:02d}", "INAV", clock, values)


def _sisa_m(index: int) -> float:
    """Signal in space accuracy, m; -1 where there is none (Galileo OS SIS ICD, 5.1.12)."""
    for first, last, base, step in (
        (0, 49, 0.0, 0.01),
        (50, 74, 0.5, 0.02),
        (75, 99, 1.0, 0.04),
        (100, 125, 2.0, 0.16),
    ):
        if first <= index <= last:
            return base + (index - first) * step
    return -1.0


def _beidou(
    page: RawPage, own: dict[int, dict[str, int]], near_week: int
) -> BroadcastEphemeris | None:
    if not _FIRST_D1 <= page.satellite <= _LAST_D1:
        return _beidou_d2(page, own)
    number = page.bits >> (_BEIDOU_BITS - 18) & 7
    if number not in _BEIDOU:
        return None
    own[number] = _fields(page.bits, _BEIDOU_BITS, _BEIDOU[number])
    if len(own) < 3:
        return None
    one, two, three = own[1], own[2], own[3]
    # Without an issue in each subframe, those of one frame follow each other.
    if {two["sow"] - one["sow"], three["sow"] - two["sow"]} != {_BEIDOU_SUBFRAME_S}:
        return None
    toe = two["toe_high"] << 15 | three["toe_low"]
    return _of_beidou(page.satellite, "D1", {**three, **two, **one, "toe": toe})


def _beidou_d2(page: RawPage, own: dict[int, dict[str, int]]) -> BroadcastEphemeris | None:
    """Pages of subframe 1 of geostationary satellites, one in each frame of 3 s."""
    number = page.bits >> (_BEIDOU_BITS - 42) & 15
    if page.bits >> (_BEIDOU_BITS - 18) & 7 != 1 or number not in _BEIDOU_D2:
        return None
    own[number] = _fields(page.bits, _BEIDOU_BITS, _BEIDOU_D2[number])
    if number != max(_BEIDOU_D2) or len(own) < len(_BEIDOU_D2):
        return None
    sow = own[1]["sow"]
    if any(part["sow"] - sow != _BEIDOU_FRAME_D2_S * (k - 1) for k, part in own.items()):
        return None
    found: dict[str, int] = {}
    for part in own.values():
        found |= part
    for name, bits in _LOW_BITS.items():
        found[name] = found[f"{name}_high"] << bits | found[f"{name}_low"]
    return _of_beidou(page.satellite, "D2", {**found, "sow": sow})


def _of_beidou(satellite: int, message: str, part: Mapping[str, int]) -> BroadcastEphemeris:
    toe_s, toc_s, sow = part["toe"] * 8.0, part["toc"] * 8.0, float(part["sow"])
    week = part["week"] + round((sow - toe_s) / WEEK_S)
    values = (
        part["a0"] * 2.0**-33, part["a1"] * 2.0**-50, part["a2"] * 2.0**-66,
        float(part["aode"]), part["crs"] * 2.0**-6, part["dn"] * 2.0**-43 * PI,
        part["m0"] * 2.0**-31 * PI,
        part["cuc"] * 2.0**-31, part["e"] * 2.0**-33, part["cus"] * 2.0**-31,
        part["root_a"] * 2.0**-19,
        toe_s, part["cic"] * 2.0**-31, part["node"] * 2.0**-31 * PI, part["cis"] * 2.0**-31,
        part["i0"] * 2.0**-31 * PI, part["crc"] * 2.0**-6, part["omega"] * 2.0**-31 * PI,
        part["node_rate"] * 2.0**-43 * PI,
        part["idot"] * 2.0**-43 * PI, 0.0, float(week), 0.0,
        URA_M[part["ura"]], float(part["health"]), part["tgd1"] * 1e-10, part["tgd2"] * 1e-10,
        sow, float(part["aodc"]),
    )  # fmt: skip
    at = week + round((toe_s - toc_s) / WEEK_S)
    clock = _BEIDOU_EPOCH + timedelta(seconds=at * WEEK_S + toc_s)
    return BroadcastEphemeris(f"C{satellite:02d}", message, clock, values)


def _glonass(
    page: RawPage, own: dict[int, dict[str, int]], near_week: int
) -> BroadcastEphemeris | None:
    number = page.bits >> (_GLONASS_BITS - 5) & 15
    # Without an issue in each string, those of one frame follow each other.
    if number != len(own) + 1:
        own.clear()
    if number != len(own) + 1 or number not in _GLONASS:
        return None
    found = _fields(page.bits, _GLONASS_BITS, _GLONASS[number])
    for name in _SIGNED_MAGNITUDE.keys() & found.keys():
        sign = 1 << (_SIGNED_MAGNITUDE[name] - 1)
        found[name] = -(found[name] - sign) if found[name] & sign else found[name]
    own[number] = found
    if number < 4:
        return None
    one, two, three, four = (dict(own[k]) for k in (1, 2, 3, 4))
    own.clear()
    if four["slot"] not in (0, page.satellite) or not 1 <= four["day"] <= _FOUR_YEARS:
        return None
    day = _glonass_day(four["day"], near_week)
    clock = day + timedelta(seconds=two["tb"] * 900.0 - _MOSCOW_S)
    sent = day + timedelta(
        seconds=one["hours"] * 3600.0 + one["minutes"] * 60.0 + one["half"] * 30.0 - _MOSCOW_S
    )
    frame_s = (sent - _GPS_EPOCH).total_seconds() % WEEK_S
    values = [-four["tau"] * 2.0**-30, three["gamma"] * 2.0**-40, frame_s]
    for part, last in ((one, two["bn"] >> 2), (two, page.channel), (three, four["age"])):
        values += [part["x"] * 2.0**-11, part["v"] * 2.0**-20, part["a"] * 2.0**-30, float(last)]
    flags = one["p1"] | two["p2"] << 2 | three["p3"] << 3 | four["p4"] << 6 | three["p"] << 7
    status = (float(flags), four["delta"] * 2.0**-30, float(four["ft"]), float(three["ln"]))
    return BroadcastEphemeris(f"R{page.satellite:02d}", "FDMA", clock, tuple(values), status)


def _glonass_day(number: int, near_week: int) -> datetime:
    """Midnight of a day that is counted within four years, Moscow's date."""
    near = _GPS_EPOCH + timedelta(weeks=near_week)
    starts = (datetime(year, 1, 1, tzinfo=UTC) for year in range(1996, 2200, 4))
    days = [start + timedelta(days=number - 1) for start in starts]
    return min(days, key=lambda day: abs(day - near))


_Reader = Callable[[RawPage, dict[int, dict[str, int]], int], BroadcastEphemeris | None]
_READERS: Final[Mapping[str, _Reader]] = {"E": _galileo, "R": _glonass, "C": _beidou}
