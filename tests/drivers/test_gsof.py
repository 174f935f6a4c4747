"""GSOF: records of the antenna and of the inertial solution, pages, and event markers."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.contract import EventMark, NavSample
from drivers.receivers.gsof.decoder import GsofDecoder
from drivers.receivers.message_decoder import Nav
from drivers.timescales.gps_time import SECOND_NS, WEEK_NS

WEEK = 2443
TOW_MS = 36_018_000
GPS_NS = WEEK * WEEK_NS + TOW_MS * 1_000_000
MONO_NS = 100 * SECOND_NS
FIXED = 0b1111
VALID = 0b101
FULL_NAVIGATION, ALIGNED, DEGRADED, LEVELLING = 4, 3, 2, 1


def record(number: int, body: bytes) -> bytes:
    return bytes((number, len(body))) + body


def packet(data: bytes) -> bytes:
    covered = bytes((0x08, 0x40, len(data))) + data
    return b"\x02" + covered + bytes((sum(covered) & 0xFF, 0x03))


def packets(content: bytes, number: int = 1, page_nbytes: int = 240) -> bytes:
    pages = [content[at : at + page_nbytes] for at in range(0, len(content), page_nbytes)]
    last = len(pages) - 1
    return b"".join(packet(bytes((number, n, last)) + page) for n, page in enumerate(pages))


def time(tow_ms: int = TOW_MS, week: int = WEEK, flags: int = FIXED) -> bytes:
    return record(1, struct.pack(">IHBBBB", tow_ms, week, 14, flags, 0, 3))


def llh(latitude_deg: float = 48.0, longitude_deg: float = 11.0) -> bytes:
    place = math.radians(latitude_deg), math.radians(longitude_deg), 1500.0
    return record(2, struct.pack(">3d", *place))


def velocity(flags: int = VALID, more: bytes = b"") -> bytes:
    return record(8, struct.pack(">B3f", flags, 50.0, math.radians(30.0), 2.0) + more)


def sigma() -> bytes:
    return record(12, struct.pack(">9fH", 9.0, 0.03, 0.04, 0.5, 0.06, 1.0, 1.0, 0.0, 1.0, 7))


def utc(offset_s: int = 18, flags: int = 3) -> bytes:
    return record(16, struct.pack(">IHhB", TOW_MS, WEEK, offset_s, flags))


def ins(
    tow_ms: int = TOW_MS,
    week: int = WEEK,
    alignment: int = FULL_NAVIGATION,
    quality: int = 4,
    latitude: float = 48.0,
) -> bytes:
    numbers = (latitude, 11.0, 1500.0, 60.0, 5.0, -1.0, 60.2, 1.5, -2.5, 359.0, 4.7, *[0.0] * 6)
    return record(49, struct.pack(">HIBB3d4f4d6f", week, tow_ms, alignment, quality, *numbers))


def rms() -> bytes:
    numbers = 0.03, 0.04, 0.06, 0.01, 0.02, 0.02, 0.1, 0.1, 0.2
    return record(50, struct.pack(">HIBB9f", WEEK, TOW_MS, FULL_NAVIGATION, 4, *numbers))


def event(number: int, seconds: float = TOW_MS / 1000, port: int = 1, week: int = WEEK) -> bytes:
    return record(51, struct.pack(">BHdI", port, week, seconds, number))


EPOCH = time() + llh() + velocity() + sigma() + utc()
INS = ins() + rms()


def decode(*contents: bytes) -> tuple[GsofDecoder, list[Nav]]:
    decoder = GsofDecoder("bd")
    stream = [packets(content, n) for n, content in enumerate(contents)]
    return decoder, [r for piece in stream for r in decoder.feed(piece, MONO_NS)]


def marks(*contents: bytes) -> list[EventMark]:
    return [r for r in decode(*contents)[1] if isinstance(r, EventMark)]


def samples(*contents: bytes) -> list[NavSample]:
    return [r for r in decode(*contents)[1] if isinstance(r, NavSample)]


def test_a_solution_of_the_antenna_comes_out_in_si_units() -> None:
    decoder, (sample,) = decode(utc(), EPOCH)
    assert isinstance(sample, NavSample)
    assert sample.gps_ns == GPS_NS
    assert sample.latitude_deg == pytest.approx(48.0, abs=1e-12)
    assert sample.longitude_deg == pytest.approx(11.0, abs=1e-12)
    assert sample.height_m == 1500.0
    north, east = 50 * math.cos(math.radians(30)), 50 * math.sin(math.radians(30))
    assert sample.velocity_ned_mps == pytest.approx((north, east, -2.0), rel=1e-6)
    assert sample.horizontal_sigma_m == pytest.approx(0.05)
    assert sample.vertical_sigma_m == pytest.approx(0.06)
    assert (sample.fix, sample.satellites, sample.time_valid) == ("3d", 14, True)
    assert (sample.roll_rad, sample.heading_rad, sample.speed_sigma_mps) == (None, None, None)
    assert (decoder.leap_seconds, sample.sigma_source) == (18, "receiver")
    assert (decoder.fix, decoder.satellites) == ("3d", 14)


def test_an_inertial_solution_comes_out_in_si_units_and_once() -> None:
    (sample,) = samples(EPOCH + INS)
    assert sample.gps_ns == GPS_NS
    assert (sample.latitude_deg, sample.longitude_deg, sample.height_m) == (48.0, 11.0, 1500.0)
    assert sample.velocity_ned_mps == (60.0, 5.0, -1.0)
    assert (sample.roll_rad, sample.pitch_rad, sample.heading_rad) == (
        math.radians(1.5), math.radians(-2.5), math.radians(359.0),
    )  # fmt: skip
    assert sample.horizontal_sigma_m == pytest.approx(0.05)
    assert sample.vertical_sigma_m == pytest.approx(0.06)
    assert sample.speed_sigma_mps == pytest.approx(0.03)
    assert (sample.fix, sample.satellites, sample.time_valid) == ("3d", 14, True)
    assert sample.leap_seconds == 18


@pytest.mark.parametrize(
    ("quality", "fix", "is_valid"),
    [(0, "none", False), (1, "3d", True), (4, "3d", True), (5, "3d", True),
     (6, "dead-reckoning", False), (7, "none", False)],
)  # fmt: skip
def test_the_quality_is_the_fix_and_only_gnss_proves_the_time(
    quality: int, fix: str, is_valid: bool
) -> None:
    found = decode(ins(quality=quality) + event(1))[1]
    assert [r.time_valid for r in found] == [is_valid, is_valid]
    (sample,) = samples(ins(quality=quality) + rms())
    assert sample.fix == fix
    assert (sample.latitude_deg is None) == (fix == "none")
    assert (sample.velocity_ned_mps is None) == (fix == "none")
    assert (sample.horizontal_sigma_m is None) == (fix == "none")
    assert sample.sigma_source == ("none" if fix == "none" else "receiver")


@pytest.mark.parametrize(
    ("alignment", "has_roll", "has_heading"),
    [(0, False, False), (LEVELLING, False, False), (DEGRADED, True, False), (ALIGNED, True, True),
     (FULL_NAVIGATION, True, True)],
)  # fmt: skip
def test_attitude_is_given_as_far_as_the_unit_is_aligned(
    alignment: int, has_roll: bool, has_heading: bool
) -> None:
    (sample,) = samples(ins(alignment=alignment))
    assert (sample.roll_rad is not None, sample.pitch_rad is not None) == (has_roll, has_roll)
    assert (sample.heading_rad is not None) == has_heading


@pytest.mark.parametrize(
    ("flags", "fix", "is_valid"),
    [(FIXED, "3d", True), (0b0111, "2d", True), (0b1101, "3d", False), (0b0011, "none", True)],
)
def test_position_flags_are_the_fix_and_the_clock(flags: int, fix: str, is_valid: bool) -> None:
    (sample,) = samples(time(flags=flags) + llh() + sigma() + velocity())
    assert (sample.fix, sample.time_valid) == (fix, is_valid)
    assert (sample.latitude_deg is None) == (fix == "none")
    assert (sample.height_m is None) == (fix != "3d")
    assert (sample.vertical_sigma_m is None) == (fix != "3d")
    assert (sample.velocity_ned_mps is None) == (fix == "none")


@pytest.mark.parametrize("flags", [0b000, 0b001, 0b100])
def test_a_velocity_that_is_not_valid_is_absent(flags: int) -> None:
    (sample,) = samples(time() + llh() + velocity(flags))
    assert sample.velocity_ned_mps is None
    assert (sample.horizontal_sigma_m, sample.sigma_source) == (None, "none")


def test_fields_that_newer_firmware_appends_are_left() -> None:
    (sample,) = samples(time() + llh() + velocity(more=b"\x7f\x80\0\0"))
    assert sample.velocity_ned_mps is not None


@pytest.mark.parametrize(
    ("offset_s", "flags", "leap"),
    [(18, 3, 18), (18, 1, None), (-18, 3, None), (101, 3, None), (0, 3, None)],
)
def test_leap_seconds_are_taken_while_they_are_valid(
    offset_s: int, flags: int, leap: int | None
) -> None:
    decoder, _ = decode(utc(), utc(offset_s, flags))
    assert decoder.leap_seconds == leap


def test_sigmas_of_the_inertial_solution_hold_for_two_seconds() -> None:
    decoder = GsofDecoder("bd")
    decoder.feed(packets(rms()), MONO_NS)
    (near,) = decoder.feed(packets(ins()), MONO_NS + 2 * SECOND_NS)
    (late,) = decoder.feed(packets(ins()), MONO_NS + 2 * SECOND_NS + 1)
    assert isinstance(near, NavSample) and isinstance(late, NavSample)
    assert near.horizontal_sigma_m is not None
    assert (late.horizontal_sigma_m, late.sigma_source) == (None, "none")


def test_marks_have_port_number_and_the_time_of_the_event() -> None:
    (mark,) = marks(EPOCH, event(9, TOW_MS / 1000 + 0.123456789, port=2))
    assert (mark.channel, mark.count, mark.count_bits) == (2, 9, 16)
    assert abs(mark.gps_ns - GPS_NS - 123_456_789) <= 8, "the resolution of 64 bits"
    assert (mark.time_valid, mark.accuracy_ns) == (True, 1000)


def test_lost_and_repeated_marks_are_counted_by_port() -> None:
    decoder, records = decode(
        EPOCH, event(1), event(1), event(4), event(2), event(7, port=2), event(0x1_0005)
    )
    found = [(r.channel, r.count) for r in records if isinstance(r, EventMark)]
    assert found == [(1, 1), (1, 4), (1, 2), (2, 7), (1, 5)]
    assert decoder.counters["marks_duplicate"] == 1
    assert decoder.counters["marks_lost"] == 2 + 2


def test_a_mark_is_valid_for_five_seconds_after_a_fixed_clock_and_near_navigation() -> None:
    decoder = GsofDecoder("bd")
    assert not decoder.feed(packets(event(1)), MONO_NS)[0].time_valid
    decoder.feed(packets(EPOCH), MONO_NS)
    assert decoder.feed(packets(event(2)), MONO_NS + 5 * SECOND_NS)[0].time_valid
    assert not decoder.feed(packets(event(3)), MONO_NS + 5 * SECOND_NS + 1)[0].time_valid
    decoder.feed(packets(EPOCH), MONO_NS)
    assert not decoder.feed(packets(event(4, TOW_MS / 1000 + 3601)), MONO_NS)[0].time_valid
    assert decoder.counters["marks_far"] == 1
    decoder.reset()
    assert not decoder.feed(packets(event(5)), MONO_NS)[0].time_valid


def test_without_a_week_there_is_no_time() -> None:
    decoder, records = decode(time(week=0) + llh(), ins(week=0), time(week=0))
    assert records == []
    assert decoder.counters["samples_without_time"] == 2
    assert decoder.fix == "none"
    assert not marks(time(week=0), event(1))[0].time_valid


def test_the_week_of_a_mark_is_its_own() -> None:
    late = time(604_799_500) + llh()
    (mark,) = marks(late, event(1, 0.25, week=WEEK + 1))
    assert mark.gps_ns == (WEEK + 1) * WEEK_NS + 250_000_000
    assert mark.time_valid


def test_pages_are_joined_and_a_missing_page_costs_its_transmission_only() -> None:
    content = EPOCH + event(1)
    decoder = GsofDecoder("bd")
    found = decoder.feed(packets(content, 5, 50), MONO_NS)
    assert [type(r) for r in found] == [NavSample, EventMark]
    cut = [content[at : at + 50] for at in range(0, len(content), 50)]
    last = len(cut) - 1
    assert last >= 2
    numbered = [packet(bytes((6, n, last)) + page) for n, page in enumerate(cut)]
    for missing in range(len(numbered)):
        decoder = GsofDecoder("bd")
        stream = b"".join(p for n, p in enumerate(numbered) if n != missing) + packets(EPOCH, 7)
        (sample,) = decoder.feed(stream, MONO_NS)
        assert isinstance(sample, NavSample)
        assert decoder.counters["transmissions_incomplete"] == 1, missing
        assert decoder.bad_messages == 0


def test_pages_of_two_transmissions_are_not_mixed() -> None:
    first = packet(bytes((1, 0, 1)) + EPOCH[:40])
    second = packet(bytes((2, 1, 1)) + EPOCH[40:])
    decoder = GsofDecoder("bd")
    assert decoder.feed(first + second + packets(EPOCH, 3), MONO_NS) != []
    assert decoder.counters["samples"] == 1
    assert decoder.counters["transmissions_incomplete"] >= 1


@pytest.mark.parametrize(
    "wrong",
    [
        time() + llh(91.0),
        time() + llh(48.0, 400.0),
        time(604_800_000) + llh(),
        ins(latitude=90.1),
        ins(latitude=math.nan),
        event(1, -1.0),
        event(1, 604_800.0),
        event(1, week=0),
        record(51, b"\1"),
        b"\1",
        b"\x01\x0a\0",
        time()[:-1],
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_a_bad_record(wrong: bytes) -> None:
    decoder, records = decode(wrong)
    assert (records, decoder.bad_messages) == ([], 1)


def test_other_packets_other_records_and_damage_are_left() -> None:
    damaged = bytearray(packets(event(1)))
    damaged[20] ^= 4
    other = b"\x02\x00\x57\x02\x00\x00\x59\x03"
    decoder = GsofDecoder("bd")
    stream = packets(EPOCH) + other + bytes(damaged) + packets(record(9, bytes(16)) + event(3), 2)
    records = decoder.feed(stream, MONO_NS)
    assert [r.count for r in records if isinstance(r, EventMark)] == [3]
    assert decoder.bad_messages >= 1
    for page in (b"\1", bytes((1, 2, 1)) + event(4)):
        bad = decoder.bad_messages
        assert decoder.feed(packet(page), MONO_NS) == []
        assert decoder.bad_messages == bad + 1


def test_an_empty_page_is_no_bad_record() -> None:
    decoder = GsofDecoder("bd")
    assert decoder.feed(packet(bytes((1, 0, 0))), MONO_NS) == []
    assert decoder.bad_messages == 0


@settings(max_examples=100, deadline=None)
@given(data=st.binary(max_size=300), cut=st.integers(1, 40))
def test_noise_raises_nothing_and_costs_no_later_transmission(data: bytes, cut: int) -> None:
    decoder = GsofDecoder("bd")
    stream = data + bytes(270) + packets(EPOCH, 250) + packets(event(7), 251)
    records = [
        r for at in range(0, len(stream), cut) for r in decoder.feed(stream[at : at + cut], 0)
    ]
    assert [r.count for r in records if isinstance(r, EventMark)][-1:] == [7]
