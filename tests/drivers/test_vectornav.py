"""VectorNav binary outputs: the manual's example, marks by their count, and times that are not
valid."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.contract import EventMark, NavSample
from drivers.receivers.message_decoder import Nav
from drivers.receivers.vectornav.decoder import VectornavDecoder
from drivers.receivers.vectornav.framing import SIZES, fields_of, vectornav_framer
from sim_hw.receivers import vectornav_messages as vectornav
from sim_hw.receivers.emulated_receiver import ReceiverAccuracy
from tests.sim_hw.receiver_state import NS, START_GPS_NS, STATE, WEEK_NS

MONO_NS = 5 * NS
EXAMPLE = bytes.fromhex("fa 01 08 00 93 50 2e 42 83 3e f1 3f 48 b5 04 bb 92 88")
"""VectorNav VN-100 user manual, section 5.3.7, example 1: yaw, pitch and roll."""


def nav(
    gps_ns: int = START_GPS_NS,
    *,
    time_status: int = vectornav.ALL_TIMES_OK,
    ins_status: int = vectornav.TRACKING | vectornav.GNSS_FIX,
) -> bytes:
    return vectornav.navigation(gps_ns, STATE, ReceiverAccuracy(), 16, 18, time_status, ins_status)


def decode(
    *pieces: bytes, decoder: VectornavDecoder | None = None
) -> tuple[VectornavDecoder, list[Nav]]:
    decoder = decoder or VectornavDecoder("ins")
    return decoder, [r for piece in pieces for r in decoder.feed(piece, MONO_NS)]


def marks(*pieces: bytes) -> list[EventMark]:
    return [r for r in decode(*pieces)[1] if isinstance(r, EventMark)]


def samples(*pieces: bytes) -> list[NavSample]:
    return [r for r in decode(*pieces)[1] if isinstance(r, NavSample)]


def sync(count: int, later_ns: int = 0, since_ns: int = 1_000_000, status: int = 7) -> bytes:
    """A mark at START_GPS_NS + later_ns."""
    return vectornav.sync_in(START_GPS_NS + later_ns + since_ns, since_ns, count, status)


def test_the_example_of_the_manual_is_a_message() -> None:
    framer = vectornav_framer()
    assert framer.feed(EXAMPLE) == [EXAMPLE]
    assert fields_of(EXAMPLE)["YawPitchRoll"] == pytest.approx(
        (43.578686, 1.884720, -0.002025), abs=1e-6
    )
    assert vectornav.output({0: {3: EXAMPLE[4:16]}}) == EXAMPLE
    assert framer.feed(EXAMPLE[:-1] + b"\x91") == []
    assert framer.bad_frames == 1


def test_the_sizes_of_the_fields_are_those_of_the_vendors_library() -> None:
    # Lengths of the groups with all fields, as users of VectorNav's library sum them up.
    assert {group: sum(s for s in SIZES[group] if s > 0) for group in ("common", "gnss1")} == {
        "common": 198,
        "gnss1": 142,
    }
    assert sum(SIZES["ins"][:11]) == 130
    assert sum(SIZES["time"]) == 59
    assert sum(SIZES["imu"][:12]) == 112


def test_a_solution_comes_out_in_si_units() -> None:
    decoder, (sample,) = decode(nav())
    assert isinstance(sample, NavSample)
    assert (sample.gps_ns, sample.fix, sample.satellites) == (START_GPS_NS, "3d", 16)
    assert (sample.latitude_deg, sample.longitude_deg, sample.height_m) == (
        STATE.latitude_deg, STATE.longitude_deg, STATE.height_m,
    )  # fmt: skip
    assert sample.velocity_ned_mps == pytest.approx(STATE.velocity_ned_mps, abs=1e-5)
    assert sample.roll_rad == pytest.approx(math.radians(STATE.roll_deg))
    assert sample.pitch_rad == pytest.approx(math.radians(STATE.pitch_deg))
    assert sample.heading_rad == pytest.approx(math.radians(STATE.heading_deg))
    assert sample.horizontal_sigma_m == sample.vertical_sigma_m == pytest.approx(0.02)
    assert sample.speed_sigma_mps == pytest.approx(0.03)
    assert sample.time_valid
    assert decoder.leap_seconds == 18


def test_a_quaternion_with_its_scalar_last_is_the_attitude() -> None:
    half = math.radians(100.0) / 2
    message = vectornav.output(
        {
            0: {
                1: struct.pack("<Q", START_GPS_NS),
                4: struct.pack("<4f", 0.0, 0.0, math.sin(half), math.cos(half)),
                6: struct.pack("<3d", 48.0, 11.0, 500.0),
                12: struct.pack("<H", 6),
            }
        }
    )
    (sample,) = samples(message)
    assert sample.heading_rad == pytest.approx(math.radians(100.0), abs=1e-6)
    assert (sample.roll_rad, sample.pitch_rad) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert not sample.time_valid, "there is no status of the time"


@pytest.mark.parametrize(
    ("status", "fix", "has_roll", "has_heading"),
    [
        (2 | 4, "3d", True, True),
        (2, "dead-reckoning", True, True),
        (1 | 4, "3d", True, False),
        (1, "none", True, False),
        (0 | 4, "none", False, False),
        (3 | 4, "none", False, False),
    ],
)
def test_the_status_of_the_filter_is_the_fix(
    status: int, fix: str, has_roll: bool, has_heading: bool
) -> None:
    (sample,) = samples(nav(ins_status=status))
    assert sample.fix == fix
    assert (sample.roll_rad is not None, sample.heading_rad is not None) == (has_roll, has_heading)
    assert (sample.latitude_deg is None) == (fix == "none")


def test_a_mark_is_the_time_less_the_time_since_the_edge() -> None:
    first, second = marks(nav(), sync(7, 100_000_000), nav(START_GPS_NS + 1), sync(8, 300_000_000))
    assert (first.gps_ns, first.count, first.count_bits) == (START_GPS_NS + 100_000_000, 7, 32)
    assert (second.gps_ns, second.count, second.time_valid) == (START_GPS_NS + 300_000_000, 8, True)
    assert first.accuracy_ns == 1000 + 20, "20 ppm of the millisecond since the edge"


def test_a_mark_that_is_reported_in_many_messages_is_one() -> None:
    repeated = [sync(1, since_ns=age_ms * 1_000_000) for age_ms in (1, 6, 11, 16)]
    assert len(marks(nav(), *repeated, sync(2, 500_000_000))) == 2


def test_two_marks_between_two_messages_are_one_and_a_lost_one() -> None:
    decoder, records = decode(nav(), sync(1), sync(3, 500_000_000))
    assert [r.count for r in records if isinstance(r, EventMark)] == [1, 3]
    assert decoder.counters["marks_lost"] == 1


def test_the_count_of_a_unit_that_was_restarted_loses_no_mark() -> None:
    decoder, records = decode(nav(), sync(500), sync(1, 500_000_000))
    assert len([r for r in records if isinstance(r, EventMark)]) == 2
    assert decoder.counters["marks_lost"] == 0


def test_an_edge_before_the_first_message_is_no_mark() -> None:
    assert marks(nav(), sync(12, -2 * NS, since_ns=2 * NS)) == []
    assert marks(nav(), sync(0)) == []
    assert len(marks(nav(), sync(12, -2 * NS, since_ns=2 * NS), sync(13, 100))) == 1


@pytest.mark.parametrize(
    ("status", "is_valid"), [(7, True), (3, True), (2, True), (1, False), (0, False), (5, False)]
)
def test_a_mark_while_the_date_is_not_known_is_not_valid(status: int, is_valid: bool) -> None:
    assert [m.time_valid for m in marks(sync(1, status=status))] == [is_valid]
    assert [s.time_valid for s in samples(nav(time_status=status))] == [is_valid]


def test_a_status_of_the_time_holds_for_two_seconds_only() -> None:
    def bare(count: int, later_ns: int) -> bytes:
        return vectornav.output(
            {
                0: {
                    1: struct.pack("<Q", START_GPS_NS + later_ns),
                    2: struct.pack("<Q", 0),
                    13: struct.pack("<I", count),
                }
            }
        )

    decoder = VectornavDecoder("ins")
    assert not decoder.feed(bare(1, 0), MONO_NS)[0].time_valid
    decoder.feed(nav(), MONO_NS)
    assert decoder.feed(bare(2, NS), MONO_NS + 2 * NS)[0].time_valid
    assert not decoder.feed(bare(3, 2 * NS), MONO_NS + 2 * NS + 1)[0].time_valid
    decoder.reset()
    assert not decoder.feed(bare(4, 3 * NS), MONO_NS)[0].time_valid


def test_a_count_without_a_time_is_a_mark_without_time() -> None:
    bare = [vectornav.output({1: {7: struct.pack("<I", n)}}) for n in (4, 5)]
    decoder, records = decode(*bare)
    assert records == []
    assert decoder.counters["marks_without_time"] == 1


def test_a_mark_far_from_navigation_or_of_the_first_week_is_not_valid() -> None:
    decoder, records = decode(nav(), sync(1, 2 * 3600 * NS))
    assert [r.time_valid for r in records if isinstance(r, EventMark)] == [False]
    assert decoder.counters["marks_far"] == 1
    assert [m.time_valid for m in marks(vectornav.sync_in(WEEK_NS - 1, 0, 1))] == [False]


def test_a_field_in_two_groups_must_be_the_same() -> None:
    def both(since_ns: int) -> bytes:
        common = {1: struct.pack("<Q", START_GPS_NS), 2: struct.pack("<Q", 5), 13: b"\1\0\0\0"}
        return vectornav.output({0: common, 1: {4: struct.pack("<Q", since_ns)}})

    assert len(marks(both(5))) == 1
    decoder, records = decode(both(6))
    assert (records, decoder.bad_messages) == ([], 1)


@pytest.mark.parametrize("group", [3, 6])
def test_a_message_with_items_in_it_is_as_long_as_they_are(group: int) -> None:
    satellites = bytes((3, 0)) + bytes(3 * 8)
    raw = struct.pack("<dHBB", 1.0, 2443, 2, 0) + bytes(2 * 28)
    message = vectornav.output({group: {3: b"\x09", 14: satellites, 15: raw}})
    decoder, _ = decode(message + nav())
    assert (decoder.frames, decoder.bad_bytes, decoder.bad_messages) == (2, 0, 0)
    cut = VectornavDecoder("ins")
    for at in range(len(message)):
        cut.feed(message[at : at + 1], 0)
    assert cut.frames == 1


@pytest.mark.parametrize(
    "message",
    [
        vectornav.output({7: {0: b"\0"}}),
        vectornav.output({1: {10: b"\0"}}),
        vectornav.output({0: {15: b"\0\0"}}),
    ],
)
def test_groups_and_fields_of_unknown_length_are_bad_bytes(message: bytes) -> None:
    decoder, records = decode(message, nav())
    assert len(records) == 1
    assert decoder.bad_bytes == len(message)


@pytest.mark.parametrize("latitude_deg", [91.0, math.nan, math.inf])
def test_a_position_that_is_none_is_a_bad_output(latitude_deg: float) -> None:
    wrong = replace(STATE, latitude_deg=latitude_deg)
    message = vectornav.navigation(START_GPS_NS, wrong, ReceiverAccuracy(), 9, 18)
    decoder, records = decode(message)
    assert (records, decoder.bad_messages) == ([], 1)


def test_one_instant_in_two_outputs_is_one_sample() -> None:
    decoder, records = decode(nav(), nav(), nav(START_GPS_NS + 1))
    assert (len(records), decoder.counters["samples_duplicate"]) == (2, 1)


@settings(max_examples=100, deadline=None)
@given(data=st.binary(max_size=300), cut=st.integers(1, 40))
def test_noise_raises_nothing_and_costs_no_later_message(data: bytes, cut: int) -> None:
    decoder = VectornavDecoder("ins")
    stream = data + bytes(4096) + nav() + sync(1) + sync(2, 1_000_000) + sync(3, 2_000_000)
    records = [
        r for at in range(0, len(stream), cut) for r in decoder.feed(stream[at : at + cut], 0)
    ]
    assert [r.count for r in records if isinstance(r, EventMark)][-1:] == [3]


@pytest.mark.parametrize(
    ("status", "leap", "found"),
    [(7, 18, 18), (3, 18, None), (7, 99, 99), (7, 100, None), (7, -1, None), (7, 0, 0)],
)
def test_leap_seconds_are_taken_while_utc_is_valid(
    status: int, leap: int, found: int | None
) -> None:
    message = vectornav.output({3: {12: struct.pack("<Bb", status, leap)}})
    decoder, _ = decode(message)
    assert decoder.leap_seconds == found


def test_what_names_no_group_or_a_second_byte_of_groups_is_no_message() -> None:
    extended = bytearray(vectornav.output({0: {1: struct.pack("<Q", START_GPS_NS)}}))
    extended[1] |= 0x80
    extended[-2:] = struct.pack(">H", vectornav.crc16(bytes(extended[1:-2])))
    for start in (bytes(extended), b"\xfa\x00\x00\x00"):
        framer = vectornav_framer()
        assert framer.feed(start + nav()) == [nav()]
