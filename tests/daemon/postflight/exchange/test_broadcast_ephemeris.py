"""Ephemerides of Galileo, GLONASS and BeiDou: against RTKLIB's convbin, from emulated messages.

Fields are written here one after the other, as the interface documents have them; every field has
a value of its own, so that exchanged fields are seen.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from daemon.postflight.exchange.rinex_navigation import navigation_text
from drivers.receivers.broadcast_ephemeris import BroadcastEphemeris, broadcast_ephemerides
from drivers.receivers.septentrio.observations import septentrio_pages
from drivers.receivers.ublox.observations import ublox_pages
from tests.daemon.postflight.exchange.emulated_gnss import GPS_EPOCH, rawx
from tests.daemon.postflight.exchange.test_rinex import (
    START_NS,
    TOE_S,
    WEEK_NS,
    antenna_at,
    program,
    run,
)
from tests.daemon.postflight.exchange.test_rinex_navigation import MADE, numbers

WEEK = START_NS // WEEK_NS
TOW = START_NS % WEEK_NS // 1_000_000_000
NOW = GPS_EPOCH + timedelta(seconds=START_NS // 1_000_000_000)


def joined(*pairs: tuple[float, int]) -> tuple[int, int]:
    """A number of the fields' bits, and how many these are."""
    whole = total = 0
    for value, bits in pairs:
        whole, total = whole << bits | (round(value) & ((1 << bits) - 1)), total + bits
    return whole, total


def crc24q(data: bytes) -> int:
    crc = 0
    for byte in data:
        crc ^= byte << 16
        for _ in range(8):
            crc <<= 1
            if crc & 0x1000000:
                crc ^= 0x1864CFB
    return crc


def galileo_parts(
    prn: int,
    *,
    iod: int = 77,
    toe_s: float = TOE_S,
    tow: int = TOW,
    week: int = WEEK,
    toc_s: float | None = None,
) -> list[tuple[int, int]]:
    """Even and odd part, 114 bits each, in the order of E1: words 2, 4, 6, 1, 3, 5, 0."""
    words = [
        joined((0, 6), (2, 2), (0, 88), ((week - 1024) % 4096, 12), (tow, 20)),
        joined((1, 6), (iod, 10), (toe_s / 60, 14), (-123_456_789, 32), (0.0003 * 2**33, 32),
               (5440.6 * 2**19, 32), (0, 2)),
        joined((2, 6), (iod, 10), (987_654_321 + prn, 32), (655_000_000, 32), (-333_333_333, 32),
               (-117, 14), (0, 2)),
        joined((3, 6), (iod, 10), (-15_500, 24), (9_100, 16), (-2_200, 16), (4_400, 16),
               (5_500, 16), (-660, 16), (107, 8)),
        joined((4, 6), (iod, 10), (prn, 6), (-29, 16), (31, 16),
               (toe_s / 60 + 10 if toc_s is None else toc_s / 60, 14),
               (-7_654_321, 31), (-8_765, 21), (-3, 6), (0, 2)),
        joined((5, 6), (3, 11), (4, 11), (5, 14), (0, 5), (-21, 10), (23, 10), (2, 2), (1, 2),
               (1, 1), (0, 1), ((week - 1024) % 4096, 12), (tow, 20), (0, 23)),
        joined((6, 6), (0, 122)),
    ]  # fmt: skip
    parts = []
    for data, total in (words[k] for k in (2, 4, 6, 1, 3, 5, 0)):
        assert total == 128
        even = data >> 16
        odd = 0b10 << 16 | data & 0xFFFF  # odd part, nominal
        first, count = joined((0, 2), (even, 112), (odd, 18), (0x2AAAAAAAAAAAAAAA, 64))
        assert count == 196
        check = crc24q(first.to_bytes(25, "big"))
        parts.append((even, odd << 96 | 0x2AAAAAAAAAAAAAAA << 32 | check << 8 | 0xA5))
    return parts


MASKS = """
    55555AAAAAAAB5556AD808 66666CCCCCCCD999B36810 87878F0F0F0F1E1E3C7020 07F80FF00FF01FE03F8040
    F8000FFFF0001FFFC00080 00000FFFFFFFE000000100 FFFFF0000000000000020 FFFFFFFFFFFFFFFFFFFFF8
"""
"""Which bits each check of a string covers (GLONASS ICD, 4.7), the idle bit first."""


def with_check(data: int) -> int:
    """A string of 77 bits with its eight check bits, 85 in all."""
    masks = [int(text.ljust(22, "0"), 16) >> 3 for text in MASKS.split()]
    for check in range(256):
        whole = data << 8 | check
        if all((whole & mask).bit_count() % 2 == 0 for mask in masks):
            return whole
    raise AssertionError("no check bits fit")


def signed(value: int, bits: int) -> int:
    """Sign and magnitude."""
    return abs(value) | (1 << (bits - 1) if value < 0 else 0)


def glonass_strings(slot: int, *, day: int | None = None, tb: int = 0) -> list[int]:
    moscow = NOW - timedelta(seconds=18) + timedelta(hours=3)
    first = datetime(moscow.year // 4 * 4, 1, 1, tzinfo=UTC)
    day = (moscow - first).days + 1 if day is None else day
    tb = tb or (moscow.hour * 60 + moscow.minute) // 15 + 1
    strings = [
        joined((0, 1), (1, 4), (0, 2), (1, 2), (moscow.hour, 5), (moscow.minute, 6), (1, 1),
               (signed(-1_234_567, 24), 24), (signed(-3, 5), 5), (signed(22_222_222, 27), 27)),
        joined((0, 1), (2, 4), (4, 3), (1, 1), (tb, 7), (0, 5), (signed(2_345_678, 24), 24),
               (signed(2, 5), 5), (signed(-33_333_333, 27), 27)),
        joined((0, 1), (3, 4), (1, 1), (signed(-77, 11), 11), (0, 1), (3, 2), (0, 1),
               (signed(-3_456_789, 24), 24), (signed(1, 5), 5), (signed(11_111_111, 27), 27)),
        joined((0, 1), (4, 4), (signed(-45_678, 22), 22), (signed(-5, 5), 5), (9, 5), (0, 14),
               (1, 1), (6, 4), (0, 3), (day, 11), (slot, 5), (1, 2)),
    ]  # fmt: skip
    assert all(count == 77 for _, count in strings)
    return [with_check(data) for data, _ in strings]


def beidou_subframes(
    prn: int, *, sow: int | None = None, toe_s: float | None = None, later: int = 0
) -> list[int]:
    """Subframes 1 to 3 of D1, 300 bits each; parity bits are ones.

    The clock's reference time is `later` units of 8 s behind that of the orbit; convbin takes equal
    ones only.
    """
    sow = TOW - 14 if sow is None else sow
    toe_s = TOE_S - 8.0 if toe_s is None else toe_s
    toe = round(toe_s / 8)

    def head(number: int) -> tuple[tuple[float, int], ...]:
        return (0b11100010010, 11), (0, 4), (number, 3), (sow + 6 * (number - 1), 20)

    frames = [
        joined(*head(1), (1, 1), (9, 5), (3, 4), (WEEK - 1356, 13), (toe + later, 17), (-142, 10),
               (87, 10), (0x1234567890ABCDEF, 64), (-7, 11), (-1_234_567, 24), (98_765, 22),
               (13, 5)),
        joined(*head(2), (8_100, 16), (-30_003, 18), (-123_456_789 - prn, 32),
               (0.0007 * 2**33, 32), (44_004, 18), (55_005, 18), (-66_006, 18),
               (5282.6 * 2**19, 32), (toe >> 15, 2)),
        joined(*head(3), (toe & 0x7FFF, 15), (655_555_555, 32), (-71, 18), (-19_191, 24), (83, 18),
               (-211, 14), (-987_654_321, 32), (456_789_123, 32), (0, 1)),
    ]  # fmt: skip
    whole = []
    for data, total in frames:
        assert total == 224
        bits, left = 0, 224
        for word in range(10):
            count = 26 if word == 0 else 22
            left -= count
            value = data >> left & ((1 << count) - 1)
            bits = bits << 30 | value << (30 - count) | ((1 << (30 - count)) - 1)
        whole.append(bits)
    return whole


def sfrbx(system: int, satellite: int, signal: int, words: list[int], channel: int = 0) -> bytes:
    payload = struct.pack("<8B", system, satellite, signal, channel, len(words), 0, 2, 0)
    payload += struct.pack(f"<{len(words)}I", *words)
    body = struct.pack("<BBH", 0x02, 0x13, len(payload)) + payload
    a = b = 0
    for byte in body:
        a = (a + byte) & 255
        b = (b + a) & 255
    return b"\xb5\x62" + body + bytes((a, b))


def words_of(bits: int, total: int, width: int = 32) -> list[int]:
    return [bits >> total - width * (k + 1) & ((1 << width) - 1) for k in range(total // width)]


def ubx_stream() -> bytes:
    """A minute of observations, and the messages of some satellites."""
    stream = b""
    noise = np.random.default_rng(1)
    for second in range(0, 60, 6):
        instant = START_NS + second * 1_000_000_000
        stream += rawx(antenna_at(instant), instant, TOE_S, noise)
        if second == 0:
            for prn in (3, 11):
                for even, odd in galileo_parts(prn):
                    words = words_of(even << 142 | odd << 14, 256)
                    # Receivers of generation 8 send a ninth word, which convbin expects.
                    stream += sfrbx(2, prn, 1, [*words, 0x12345678])
            for slot in (5, 24):
                for string in glonass_strings(slot):
                    stream += sfrbx(6, slot, 0, words_of(string << 43, 128), channel=7 - 3)
            for prn in (6, 30):
                for subframe in beidou_subframes(prn):
                    stream += sfrbx(3, prn, 0, words_of(subframe, 300, 30))
    return stream


def records(text: str) -> dict[tuple[str, str], list[float]]:
    found: dict[tuple[str, str], list[float]] = {}
    key = None
    for line in text.split("END OF HEADER")[1].splitlines()[1:]:
        if line[:1] in "GERC" and line[1:3].isdigit():
            key = line[:3], line[4:23]
            found[key] = numbers(line, 23)
        elif line[:1] == " " and key:
            found[key] += numbers(line, 4)
    return found


def found_in(data: bytes, pages: Callable, week: int = WEEK) -> list[BroadcastEphemeris]:
    return list(broadcast_ephemerides(pages(data), week))


def text_of(found: list[BroadcastEphemeris], version: str = "3.04") -> str:
    return navigation_text(found, version=version, made=MADE, comments=())


@pytest.mark.peer
def test_emulated_messages_give_the_ephemerides_of_convbin(tmp_path: Path) -> None:
    data = ubx_stream()
    ours = records(text_of(found_in(data, ublox_pages)))
    (tmp_path / "in.bin").write_bytes(data)
    at = f"{NOW:%Y/%m/%d %H:%M:%S}".split()
    run(
        program("convbin"), "-r", "ubx", "-v", "3.04", "-tr", *at, "-o", "theirs.obs", "-n",
        "theirs.nav", "in.bin", folder=tmp_path,
    )  # fmt: skip
    theirs = records((tmp_path / "theirs.nav").read_text())
    assert {name for name, _ in theirs} == {"E03", "E11", "R05", "R24", "C06", "C30"}
    assert theirs.keys() == ours.keys()
    for key, expected in theirs.items():
        values = list(ours[key])
        assert len(values) <= len(expected)
        expected = expected[: len(values)]
        near = np.isclose(values, expected, rtol=1e-11, atol=1e-25)
        assert near.all(), (key, [(k, values[k], expected[k]) for k in np.flatnonzero(~near)])


def sbf(
    block: int,
    number: int,
    words: list[int],
    *,
    is_right: int = 1,
    channel: int = 0,
    source: int = 17,
) -> bytes:
    content = struct.pack("<IH6B", TOW * 1000, WEEK, number, is_right, 0, source, channel, 1)
    content += struct.pack(f"<{len(words)}I", *words)
    checked = struct.pack("<HH", block, 8 + len(content)) + content
    return b"$@" + struct.pack("<H", binascii.crc_hqx(checked, 0)) + checked


def sbf_stream(**more: int) -> bytes:
    stream = b""
    for even, odd in galileo_parts(3):
        stream += sbf(4023, 73, words_of((even << 120 | odd << 6) << 22, 256), **more)
    for string in glonass_strings(5):
        stream += sbf(4026, 42, words_of(string << 11, 96), **{"channel": 8 - 3} | more)
    for subframe in beidou_subframes(30):
        stream += sbf(4047, 170, words_of(subframe << 20, 320), **more)
    return stream


def test_septentrio_gives_the_ephemerides_of_u_blox() -> None:
    found = {one.satellite: one for one in found_in(sbf_stream(), septentrio_pages)}
    other = {one.satellite: one for one in found_in(ubx_stream(), ublox_pages)}
    assert found.keys() == {"E03", "R05", "C30"}
    assert all(found[name] == other[name] for name in found)
    assert found_in(sbf_stream(is_right=0), septentrio_pages) == []
    # The other signal's pages come interleaved: E5b is not read.
    assert "E03" not in {one.satellite for one in found_in(sbf_stream(source=21), septentrio_pages)}
    pysbf2 = pytest.importorskip("pysbf2")
    one = pysbf2.SBFReader.parse(sbf(4023, 73, [1] * 8))
    assert (one.identity, one.SVID, one.CRCPassed) == ("GALRawINAV", 73, 1)
    one = pysbf2.SBFReader.parse(sbf(4026, 42, [1] * 3, channel=5))
    assert (one.identity, one.SVID, one.FreqNr) == ("GLORawCA", 42, 5)


def test_version_4_has_its_messages_and_the_status_of_glonass() -> None:
    text = text_of(found_in(ubx_stream(), ublox_pages), "4.00")
    for line in ("> EPH E03 INAV\nE03 ", "> EPH R05 FDMA\nR05 ", "> EPH C30 D1\nC30 "):
        assert line in text
    assert "M: Mixed" in text.splitlines()[0]
    assert max(map(len, text.splitlines())) == 80
    glonass = text.split("> EPH R05 FDMA\n")[1].split(">")[0].splitlines()
    assert len(glonass) == 5
    # Status flags, group delay between L2 and L1, accuracy index, health of string 3.
    flags = float(1 | 1 << 2 | 1 << 3 | 1 << 6 | 3 << 7)
    assert numbers(glonass[4], 4) == pytest.approx([flags, -5 * 2.0**-30, 6.0, 0.0])
    assert len(text_of(found_in(ubx_stream(), ublox_pages)).split("R05")[1].splitlines()) >= 4


def galileo_stream(parts: list[tuple[int, int]], prn: int = 3) -> bytes:
    return b"".join(sfrbx(2, prn, 1, words_of(e << 142 | o << 14, 256)) for e, o in parts)


def test_words_of_different_issues_are_not_mixed() -> None:
    one, other = galileo_parts(3), galileo_parts(3, iod=78)
    assert len(found_in(galileo_stream(one), ublox_pages)) == 1
    for k in (0, 1, 3, 4):
        mixed = [*one[:k], other[k], *one[k + 1 :]]
        assert found_in(galileo_stream(mixed), ublox_pages) == [], k
    assert len(found_in(galileo_stream([*one, *one]), ublox_pages)) == 1
    later = galileo_parts(3, iod=79, toe_s=TOE_S + 600.0)
    assert len(found_in(galileo_stream([*one, *later]), ublox_pages)) == 2
    # Another satellite's word 4 does not make an ephemeris of this one.
    assert found_in(galileo_stream(galileo_parts(4), prn=3), ublox_pages) == []


def test_damaged_and_alert_pages_of_galileo_are_left_out() -> None:
    parts = galileo_parts(3)
    even, odd = parts[3]
    for flipped in ((even ^ 1 << 50, odd), (even, odd ^ 1 << 100), (even | 1 << 112, odd)):
        damaged = [*parts[:3], flipped, *parts[4:]]
        assert found_in(galileo_stream(damaged), ublox_pages) == []
    swapped = [*parts[:3], (odd, even), *parts[4:]]
    assert found_in(galileo_stream(swapped), ublox_pages) == []


def test_the_week_of_an_orbit_across_the_end_of_the_week() -> None:
    tow = 604_800 - 30
    (one,) = found_in(galileo_stream(galileo_parts(3, toe_s=0.0, tow=tow)), ublox_pages)
    assert (one.values[11], one.values[21]) == (0.0, WEEK + 1)
    assert one.clock_time == GPS_EPOCH + timedelta(weeks=WEEK + 1, seconds=600)
    for years_off in (-400, 400):
        (same,) = found_in(
            galileo_stream(galileo_parts(3, toe_s=0.0, tow=tow)), ublox_pages, WEEK + years_off
        )
        assert same == one, "the message has 4,096 weeks"
    frames = beidou_subframes(30, sow=604_800 - 60, toe_s=0.0, later=1)
    stream = b"".join(sfrbx(3, 30, 0, words_of(bits, 300, 30)) for bits in frames)
    (one,) = found_in(stream, ublox_pages)
    assert (one.values[11], one.values[21]) == (0.0, WEEK - 1356 + 1)
    beidou = datetime(2006, 1, 1, tzinfo=UTC)
    assert one.clock_time == beidou + timedelta(weeks=WEEK - 1356 + 1, seconds=8)


def test_a_clock_before_the_end_of_the_week_of_an_orbit_after_it() -> None:
    parts = galileo_parts(3, toe_s=0.0, tow=604_800 - 30, toc_s=604_200.0)
    (one,) = found_in(galileo_stream(parts), ublox_pages)
    assert one.values[21] == WEEK + 1
    assert one.clock_time == GPS_EPOCH + timedelta(weeks=WEEK, seconds=604_200)
    frames = beidou_subframes(30, sow=604_800 - 60, toe_s=0.0, later=604_792 // 8)
    stream = b"".join(sfrbx(3, 30, 0, words_of(bits, 300, 30)) for bits in frames)
    (one,) = found_in(stream, ublox_pages)
    assert one.values[21] == WEEK - 1356 + 1
    beidou = datetime(2006, 1, 1, tzinfo=UTC)
    assert one.clock_time == beidou + timedelta(weeks=WEEK - 1356, seconds=604_792)


def glonass_stream(strings: list[int], slot: int = 5) -> bytes:
    return b"".join(sfrbx(6, slot, 0, words_of(string << 43, 128), channel=4) for string in strings)


def test_strings_and_subframes_of_different_frames_are_not_mixed() -> None:
    strings, later = glonass_strings(5), glonass_strings(5, tb=40)
    assert len(found_in(glonass_stream(strings), ublox_pages)) == 1
    assert found_in(glonass_stream([*strings[:2], *later[1:]]), ublox_pages) == []
    assert found_in(glonass_stream([strings[0], *strings[2:]]), ublox_pages) == []
    assert len(found_in(glonass_stream([*strings[:2], *later]), ublox_pages)) == 1
    frames, next_frames = beidou_subframes(30), beidou_subframes(30, sow=TOW + 16)
    for mixed in ([*frames[:2], next_frames[2]], [frames[0], *next_frames[1:]]):
        stream = b"".join(sfrbx(3, 30, 0, words_of(bits, 300, 30)) for bits in mixed)
        assert found_in(stream, ublox_pages) == []


def test_the_day_of_glonass_is_moscow_s() -> None:
    """At half past one in Moscow it is still the day before in UTC."""
    (one,) = found_in(glonass_stream(glonass_strings(5, day=1, tb=6)), ublox_pages)
    first = datetime(NOW.year // 4 * 4, 1, 1, tzinfo=UTC)
    near = min(
        (first.replace(year=first.year + k) for k in (-4, 0, 4)), key=lambda day: abs(day - NOW)
    )
    assert one.clock_time == near - timedelta(hours=1, minutes=30)
    assert found_in(glonass_stream(glonass_strings(5, day=0)), ublox_pages) == []
    assert found_in(glonass_stream(glonass_strings(6), slot=5), ublox_pages) == []


def test_geostationary_satellites_and_random_words_cost_nothing_else() -> None:
    stream = b"".join(sfrbx(3, 3, 1, words_of(bits, 300, 30)) for bits in beidou_subframes(3))
    assert found_in(stream, ublox_pages) == []
    random = np.random.default_rng(5)
    for _ in range(300):
        system = int(random.choice([2, 3, 6]))
        count = {2: 8, 3: 10, 6: 4}[system]
        words = [int(v) for v in random.integers(0, 1 << 32, count)]
        stream += sfrbx(system, int(random.integers(0, 64)), 0, words, int(random.integers(14)))
    text_of(found_in(stream + ubx_stream(), ublox_pages), "4.00")
    assert {one.satellite for one in found_in(stream + ubx_stream(), ublox_pages)} >= {"E11"}
