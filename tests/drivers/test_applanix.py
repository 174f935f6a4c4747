"""Applanix groups: times in GPS and UTC seconds of the week, events by their pulse number."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.contract import EventMark, NavSample
from drivers.receivers.applanix.decoder import ApplanixDecoder
from drivers.receivers.message_decoder import Nav
from drivers.timescales.gps_time import SECOND_NS, WEEK_NS

WEEK = 2443
TOW_S = 36_018.0
GPS_NS = WEEK * WEEK_NS + 36_018 * SECOND_NS
MONO_NS = 100 * SECOND_NS
POS, GPS, UTC = 0, 1, 2


def frame(number: int, content: bytes, sync: bytes = b"$GRP") -> bytes:
    content += bytes(-len(content) % 4)
    head = sync + struct.pack("<HH", number, len(content) + 4) + content
    total = sum(struct.unpack(f"<{len(head) // 2}H", head)) + int.from_bytes(b"$#", "little")
    return head + struct.pack("<H", -total & 0xFFFF) + b"$#"


def group(
    number: int, body: bytes, tow_s: float = TOW_S, kinds: tuple[int, int] = (GPS, POS)
) -> bytes:
    times = struct.pack("<3dBB", tow_s, 5000.0, 0.0, kinds[0] | kinds[1] << 4, 0)
    return frame(number, times + body)


def gnss(tow_s: float = TOW_S, week: int = WEEK, offset_s: float = 18.0, **more: object) -> bytes:
    channels = bytes(20)
    body = struct.pack("<bBH", 5, 14, len(channels)) + channels
    body += struct.pack("<3fHIdffHI", 0.9, 1.2, 0.0, 0, week, offset_s, 0.1, 46.0, 18, 0)
    # Any field of the group by name.
    return group(3, body, tow_s, **more)  # type: ignore[arg-type]


def pps(status: int = 2) -> bytes:
    return group(7, struct.pack("<IB", 77, status) + bytes(3))


def nav(tow_s: float = TOW_S, alignment: int = 0, latitude: float = 48.0, **more: object) -> bytes:
    body = struct.pack("<3d3f4d8fB", latitude, 11.0, 1500.0, 60.0, 5.0, -1.0, 1.5, -2.5, 359.0, 0.0,
                       4.7, 60.2, *[0.0] * 6, alignment)  # fmt: skip
    # Any field of the group by name.
    return group(1, body, tow_s, **more)  # type: ignore[arg-type]


def performance() -> bytes:
    return group(2, struct.pack("<12f", 0.03, 0.04, 0.06, 0.01, 0.02, 0.02, *[0.01] * 6))


def event(pulse: int, tow_s: float = TOW_S, number: int = 5, **more: object) -> bytes:
    # Any field of the group by name.
    return group(number, struct.pack("<I", pulse), tow_s, **more)  # type: ignore[arg-type]


BEGUN = gnss() + pps()


def decode(*pieces: bytes) -> tuple[ApplanixDecoder, list[Nav]]:
    decoder = ApplanixDecoder("pos")
    return decoder, [r for piece in pieces for r in decoder.feed(piece, MONO_NS)]


def marks(*pieces: bytes) -> list[EventMark]:
    return [r for r in decode(*pieces)[1] if isinstance(r, EventMark)]


def samples(*pieces: bytes) -> list[NavSample]:
    return [r for r in decode(*pieces)[1] if isinstance(r, NavSample)]


def test_a_solution_comes_out_in_si_units() -> None:
    decoder, (sample,) = decode(BEGUN, performance(), nav(TOW_S + 0.005))
    assert isinstance(sample, NavSample)
    assert sample.gps_ns == GPS_NS + 5_000_000
    assert (sample.latitude_deg, sample.longitude_deg, sample.height_m) == (48.0, 11.0, 1500.0)
    assert sample.velocity_ned_mps == (60.0, 5.0, -1.0)
    assert (sample.roll_rad, sample.pitch_rad, sample.heading_rad) == (
        math.radians(1.5), math.radians(-2.5), math.radians(359.0),
    )  # fmt: skip
    assert sample.horizontal_sigma_m == pytest.approx(0.05)
    assert sample.vertical_sigma_m == pytest.approx(0.06)
    assert sample.speed_sigma_mps == pytest.approx(0.03)
    assert (sample.fix, sample.satellites, sample.time_valid) == ("3d", 14, True)
    assert decoder.leap_seconds == 18


@pytest.mark.parametrize("kinds", [(UTC, POS), (POS, UTC)])
def test_utc_of_the_week_becomes_gps_time(kinds: tuple[int, int]) -> None:
    def in_utc(number: int, body: bytes) -> bytes:
        pair = (TOW_S - 18, 5000.0) if kinds[0] == UTC else (5000.0, TOW_S - 18)
        return frame(number, struct.pack("<3dBB", *pair, 0.0, kinds[0] | kinds[1] << 4, 0) + body)

    begun = in_utc(3, gnss()[34:-4]) + pps()
    (mark,) = marks(begun, in_utc(5, struct.pack("<I", 3)))
    assert (mark.gps_ns, mark.count, mark.time_valid) == (GPS_NS, 3, True)


@pytest.mark.parametrize(
    ("number", "channel"), [(5, 1), (6, 2), (30, 3), (31, 4), (32, 5), (33, 6)]
)
def test_each_event_group_is_an_input(number: int, channel: int) -> None:
    (mark,) = marks(BEGUN, nav(), event(9, TOW_S + 0.123456789, number))
    assert (mark.channel, mark.count, mark.count_bits) == (channel, 9, 32)
    assert abs(mark.gps_ns - GPS_NS - 123_456_789) <= 8, "the resolution of 64 bits"


def test_lost_and_repeated_pulses_are_counted() -> None:
    decoder, records = decode(BEGUN, event(1), event(1), event(4, TOW_S + 1), event(2, TOW_S + 2))
    assert [r.count for r in records if isinstance(r, EventMark)] == [1, 4, 2]
    assert decoder.counters["marks_duplicate"] == 1
    assert decoder.counters["marks_lost"] == 2


@pytest.mark.parametrize(("status", "is_valid"), [(2, True), (3, False), (1, False), (0, False)])
def test_a_mark_while_time_is_not_synchronized_is_not_valid(status: int, is_valid: bool) -> None:
    found = decode(gnss(), pps(status), nav(), event(1))[1]
    assert [r.time_valid for r in found] == [is_valid, is_valid]


def test_without_the_pps_group_no_time_is_valid_and_it_holds_for_five_seconds() -> None:
    assert [m.time_valid for m in marks(gnss(), event(1))] == [False]
    decoder = ApplanixDecoder("pos")
    decoder.feed(BEGUN, MONO_NS)
    assert decoder.feed(event(1), MONO_NS + 5 * SECOND_NS)[0].time_valid
    assert not decoder.feed(event(2, TOW_S + 5), MONO_NS + 5 * SECOND_NS + 1)[0].time_valid


def test_without_a_week_there_is_no_time() -> None:
    for begun in (pps(), gnss(week=0) + pps(), gnss(kinds=(POS, 3)) + pps()):
        decoder, records = decode(begun, nav(), event(1))
        assert records == []
        assert decoder.counters["samples_without_time"] == 1
        assert decoder.counters["marks_without_time"] == 1
    decoder = ApplanixDecoder("pos")
    decoder.feed(BEGUN, MONO_NS)
    assert decoder.feed(event(1), MONO_NS + 61 * SECOND_NS) == []


def test_a_time_since_power_on_is_no_time() -> None:
    decoder, records = decode(BEGUN, event(1, kinds=(POS, 3)))
    assert (records, decoder.counters["marks_without_time"]) == ([], 1)


def test_the_week_ends_between_two_groups() -> None:
    late = gnss(604_799.5) + pps()
    (mark,) = marks(late, event(1, 0.25))
    assert mark.gps_ns == (WEEK + 1) * WEEK_NS + 250_000_000
    early = gnss(0.5, WEEK + 1) + pps()
    (mark,) = marks(early, event(1, 604_799.75))
    assert mark.gps_ns == (WEEK + 1) * WEEK_NS - 250_000_000


@pytest.mark.parametrize(
    ("alignment", "fix", "has_heading"),
    [(0, "3d", True), (1, "3d", True), (2, "3d", False), (5, "3d", False), (6, "none", False),
     (8, "none", False)],
)  # fmt: skip
def test_the_alignment_is_the_fix(alignment: int, fix: str, has_heading: bool) -> None:
    (sample,) = samples(BEGUN, nav(alignment=alignment))
    assert sample.fix == fix
    assert (sample.heading_rad is not None) == has_heading
    assert (sample.latitude_deg is None) == (fix == "none")


def test_a_mark_an_hour_from_navigation_is_not_valid() -> None:
    decoder, records = decode(BEGUN, nav(), event(1, TOW_S + 3601))
    assert [r.time_valid for r in records if isinstance(r, EventMark)] == [False]
    assert decoder.counters["marks_far"] == 1


@pytest.mark.parametrize(
    "wrong", [nav(latitude=91.0), nav(latitude=math.nan), nav(604_801.0), nav(-1.0), group(5, b"")]
)
def test_what_makes_no_sense_is_a_bad_group(wrong: bytes) -> None:
    decoder, records = decode(BEGUN, wrong)
    assert (records, decoder.bad_messages) == ([], 1)


def test_messages_other_groups_and_damage_are_left() -> None:
    damaged = bytearray(event(1))
    damaged[20] ^= 4
    decoder, records = decode(
        BEGUN, frame(20, bytes(8), b"$MSG"), group(10, bytes(40)), bytes(damaged), event(2)[:30],
        event(3),
    )  # fmt: skip
    assert [r.count for r in records if isinstance(r, EventMark)] == [3]
    assert decoder.bad_messages >= 1


@settings(max_examples=100, deadline=None)
@given(data=st.binary(max_size=300), cut=st.integers(1, 40))
def test_noise_raises_nothing_and_costs_no_later_group(data: bytes, cut: int) -> None:
    decoder = ApplanixDecoder("pos")
    stream = data + bytes(4200) + BEGUN + event(7)
    records = [
        r for at in range(0, len(stream), cut) for r in decoder.feed(stream[at : at + cut], 0)
    ]
    assert [r.count for r in records if isinstance(r, EventMark)] == [7]
