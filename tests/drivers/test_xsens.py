"""MTData2: recorded messages against the decoder of another author, and synthetic ones."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.contract import EventMark, NavSample
from drivers.receivers.message_decoder import Nav
from drivers.receivers.xsens.decoder import XsensDecoder
from drivers.receivers.xsens.framing import data_of
from drivers.timescales.gps_time import SECOND_NS, WEEK_NS, UtcFields, utc_ns
from sim_hw.receivers import xsens_messages
from sim_hw.receivers.emulated_receiver import ReceiverAccuracy
from tests.sim_hw.receiver_state import START_GPS_NS, STATE

# Recorded from an MTi-G-710 by Einride AB, xsens-go, testdata/1/messages.golden, MIT licence;
# what their own decoder reads is in testdata/1/output.client.golden.
GNSS = bytes.fromhex(
    "faff367c70105e02f5c92a07e301140d2f1837000000050ee32a2403010b00071522e822612f5500013f71"
    "0000a92a000008d300000818ffffffe50000000afffffffe0000001d000000000000015e00e5519a000200"
    "00009a008b0044007000530037003e10100c0ee6b28007e301140d2f18371060040314f254102002a99808"
)
POSITION = bytes.fromhex(
    "faff3692102002a99b1060040314f52310100c132fcde007e301140d2f1837e020040180000520300cc2c6"
    "f96e3da38a06c3332aee40200c3c8dc8f7c11accf0bfd1bbe540100c3934af58bdc6256cbc8631d780200c"
    "bb90c016bb3dac81baa794818030103f800001b7b947ccb772c853b6d680a35040084266b7c1413e1f0250"
    "200442a38dedd0100c3c0ed2bfbcc400743ae3dc4fb3"
)
RECORDED_UTC = UtcFields(2019, 1, 20, 13, 47, 24, 0)

NAVIGATING = 3 << 23 | 1 << 2 | 1 << 1
UTC = UtcFields(2026, 11, 1, 10, 0, 0, 0)
GPS_NS = (utc_ns(UTC) or 0) + 18 * SECOND_NS
MONO_NS = 5 * SECOND_NS
FINE = 1_000_000


def message(*data: tuple[int, bytes]) -> bytes:
    body = b"".join(struct.pack(">HB", identity, len(part)) + part for identity, part in data)
    head = b"\xff\x36" + (
        bytes([len(body)]) if len(body) < 255 else b"\xff" + struct.pack(">H", len(body))
    )
    return b"\xfa" + head + body + bytes([-sum(head + body) & 0xFF])


def utc(milliseconds: int = 0, flags: int = 7, second: int = 0) -> tuple[int, bytes]:
    return 0x1010, struct.pack(">IH6B", milliseconds * 1_000_000, 2026, 11, 1, 10, 0, second, flags)


def fine(ticks: int = FINE) -> tuple[int, bytes]:
    return 0x1060, struct.pack(">I", ticks % (1 << 32))


def trigger(ticks: int, channel: int = 1, polarity: int = 1) -> tuple[int, bytes]:
    return 0x4800 | channel << 4, struct.pack(">BBIH", channel, polarity, ticks % (1 << 32), 9)


def status(word: int = NAVIGATING) -> tuple[int, bytes]:
    return 0xE020, struct.pack(">I", word)


def place(latitude: float = 48.0, longitude: float = 11.0) -> tuple[int, bytes]:
    return 0x5043, struct.pack(">2d", latitude, longitude)


def decode(*messages: bytes, edge: str = "rising") -> tuple[XsensDecoder, list[Nav]]:
    decoder = XsensDecoder("mti", edge=edge)
    return decoder, [r for data in messages for r in decoder.feed(data, MONO_NS)]


def marks(*messages: bytes) -> list[EventMark]:
    return [r for r in decode(*messages)[1] if isinstance(r, EventMark)]


def samples(*messages: bytes) -> list[NavSample]:
    return [r for r in decode(*messages)[1] if isinstance(r, NavSample)]


def test_a_recorded_message_is_what_another_decoder_reads_in_it() -> None:
    data = data_of(POSITION)
    assert data is not None
    assert data["SampleTimeFine"].values == (51705123,)
    assert data["PacketCounter"].values == (43419,)
    assert data["LatLon"].values == (57.679447174072266, 11.882570266723633)
    assert data["AltitudeEllipsoid"].values[0] == pytest.approx(81.7771987915039, abs=1e-12)
    assert data["EulerAngles"].values == (
        -99.48716735839844, 0.0798531025648117, -179.16769409179688,
    )  # fmt: skip
    assert data["StatusWord"].values == (0b00000001100000000000000000000101,)
    assert data["VelocityXYZ"].values == (
        0.00871723797172308, -0.02392599731683731, 0.0017384382663294673,
    )  # fmt: skip


def test_a_recorded_receiver_is_read_with_its_leap_seconds_and_sigmas() -> None:
    decoder = XsensDecoder("mti")
    assert decoder.feed(GNSS, 0) == []
    # 2019-01-20, 13:47:24.249768 UTC is 49,662.250 s into its GPS week.
    assert (decoder.leap_seconds, decoder._satellites) == (18, 11)
    (sample,) = decoder.feed(POSITION, 0)
    assert isinstance(sample, NavSample)
    expected_ns = (utc_ns(RECORDED_UTC) or 0) + 321_900_000 + 18 * SECOND_NS
    assert abs(sample.gps_ns - expected_ns) < 100_000
    assert sample.time_valid
    assert sample.fix == "none", "its filter was not aligned: bit 1 of the status word is clear"
    assert sample.latitude_deg is None and sample.roll_rad is None
    aligned = bytearray(POSITION)
    at = POSITION.index(bytes.fromhex("e02004")) + 3
    aligned[at + 3] |= 2
    aligned[-1] = -sum(aligned[1:-1]) & 0xFF
    (sample,) = decoder.feed(bytes(aligned), 0)
    assert sample.fix == "3d"
    assert sample.latitude_deg == 57.679447174072266
    assert sample.horizontal_sigma_m == pytest.approx(2.259, abs=0.02)
    assert sample.vertical_sigma_m == 2.072
    # GnssPvtData of 70 ms before: north -0.027, east 0.010, down -0.002 m/s.
    assert sample.velocity_ned_mps == pytest.approx((-0.0239, 0.0087, -0.0017), abs=1e-4)


def test_a_trigger_is_the_time_of_the_message_less_the_ticks_since() -> None:
    (mark,) = marks(message(utc(500), fine(), trigger(FINE - 123)))
    assert mark.gps_ns == GPS_NS + 500_000_000 - 12_300_000
    assert (mark.channel, mark.time_valid, mark.accuracy_ns) == (1, True, 100_000)
    later = message(utc(500), fine(5), trigger(-10), trigger(4, channel=2))
    assert [(m.channel, m.gps_ns - GPS_NS) for m in marks(later)] == [
        (1, 498_500_000), (2, 499_900_000),
    ]  # fmt: skip


@pytest.mark.parametrize(("flags", "is_valid"), [(7, True), (3, False), (5, False), (6, False)])
def test_a_mark_before_utc_is_resolved_is_not_valid(flags: int, is_valid: bool) -> None:
    data = message(utc(0, flags), fine(), trigger(FINE), status(), place())
    assert [r.time_valid for r in decode(data)[1]] == [is_valid, is_valid]


def test_a_mark_without_utc_or_without_fine_time_is_counted() -> None:
    decoder, records = decode(message(fine(), trigger(FINE)), message(utc(), trigger(FINE)))
    assert records == []
    assert decoder.counters["marks_without_time"] == 2


def test_marks_of_the_other_edge_are_counted_and_left() -> None:
    falling = message(utc(), fine(), trigger(FINE, polarity=2))
    decoder, records = decode(falling, falling)
    assert (records, decoder.counters["marks_other_edge"], decoder.other_edges) == ([], 2, 2)
    assert len(decode(falling, edge="falling")[1]) == 1


def test_a_repeated_trigger_is_one_mark_and_a_far_one_is_not_valid() -> None:
    first = message(utc(500), fine(), trigger(FINE - 100))
    again = message(utc(510), fine(FINE + 100), trigger(FINE - 100))
    decoder, records = decode(first, again)
    assert (len(records), decoder.counters["marks_duplicate"]) == (1, 1)
    decoder, records = decode(message(utc(), fine(200_001), trigger(0)))
    assert [m.time_valid for m in records if isinstance(m, EventMark)] == [False]
    assert decoder.counters["marks_far"] == 1


def test_leap_seconds_are_of_the_receiver_or_of_the_table() -> None:
    (by_table,) = samples(message(utc(), status(), place()))
    assert (by_table.gps_ns, by_table.leap_source, by_table.leap_seconds) == (GPS_NS, "table", None)
    by_receiver = samples(GNSS, message(utc(), status(), place()))[0]
    assert (by_receiver.leap_source, by_receiver.leap_seconds) == ("receiver", 18)


@pytest.mark.parametrize(
    ("word", "fix"),
    [
        (NAVIGATING, "3d"),
        (NAVIGATING & ~(1 << 2), "dead-reckoning"),
        (1 << 23 | 1 << 1, "dead-reckoning"),
        (0 << 23 | 1 << 1, "none"),
        (NAVIGATING & ~(1 << 1), "none"),
    ],
)
def test_the_status_word_is_the_fix(word: int, fix: str) -> None:
    (sample,) = samples(message(utc(), status(word), place()))
    assert sample.fix == fix
    assert (sample.latitude_deg is None) == (fix == "none")


def test_a_message_without_a_status_has_no_position() -> None:
    assert [s.fix for s in samples(message(utc(), place()))] == ["none"]


@pytest.mark.parametrize(
    ("digit", "angles", "expected_deg"),
    [
        (0x4, (3.0, 5.0, 100.0), (3.0, 5.0, 100.0)),
        (0x0, (3.0, -5.0, -10.0), (3.0, 5.0, 100.0)),
        (0x8, (3.0, -5.0, -100.0), (3.0, 5.0, 100.0)),
    ],
)
def test_attitude_and_velocity_are_those_of_forward_right_down(
    digit: int, angles: tuple[float, ...], expected_deg: tuple[float, ...]
) -> None:
    north, east, down = 60.0, 5.0, -1.0
    velocity = {0x4: (north, east, down), 0x0: (east, north, -down), 0x8: (north, -east, -down)}
    data = message(
        utc(), status(), place(), (0x2030 | digit, struct.pack(">3f", *angles)),
        (0xD010 | digit, struct.pack(">3f", *velocity[digit])),
    )  # fmt: skip
    (sample,) = samples(data)
    read = (sample.roll_rad, sample.pitch_rad, sample.heading_rad)
    assert read == pytest.approx([math.radians(a) for a in expected_deg], abs=1e-6)
    assert sample.velocity_ned_mps == (north, east, down)


@pytest.mark.parametrize(
    ("digit", "content"),
    [
        (0, struct.pack(">f", 1234.5)),
        (1, struct.pack(">i", round(1234.5 * (1 << 20)))),
        (2, struct.pack(">Ih", 1 << 31, 1234)),
        (3, struct.pack(">d", 1234.5)),
    ],
)
def test_each_format_of_a_number_is_read(digit: int, content: bytes) -> None:
    (sample,) = samples(message(utc(), status(), place(), (0x5020 | digit, content)))
    assert sample.height_m == 1234.5


def test_the_published_number_in_fixed_point_is_read() -> None:
    # xsens-go, mtdata2_test.go: 24 39 58 10 00 03 is 3.1415.
    height = (0x5022, bytes.fromhex("24 39 58 10 00 03"))
    (sample,) = samples(message(utc(), status(), place(), height))
    assert sample.height_m == pytest.approx(3.1415, abs=1e-4)


@pytest.mark.parametrize(
    "data",
    [
        ((0x5043, bytes(15)),),
        ((0x504C, bytes(8)),),
        ((0x5043, struct.pack(">2d", 91.0, 0.0)),),
        ((0x5043, struct.pack(">2d", math.nan, 0.0)),),
        ((0x1010, bytes(11)),),
        ((0x1010, struct.pack(">IH6B", 0, 2026, 13, 1, 0, 0, 0, 7)),),
        ((0xE020, bytes(3)),),
    ],
)
def test_data_of_a_wrong_length_or_of_no_sense_are_bad(data: tuple[tuple[int, bytes], ...]) -> None:
    decoder, records = decode(message(*data))
    assert (records, decoder.bad_messages) == ([], 1)


def test_a_long_message_and_damaged_ones() -> None:
    filler = [(0x8020, bytes(200)), (0x8021, bytes(200))]
    good = message(utc(), status(), place(), *filler)
    damaged = bytearray(good)
    damaged[20] ^= 1
    decoder, records = decode(bytes(damaged), good[:50], message(utc(10), status(), place()), good)
    assert [r.gps_ns - GPS_NS for r in records] == [10_000_000, 0]
    assert decoder.bad_messages >= 1


@settings(max_examples=100, deadline=None)
@given(data=st.binary(max_size=300), cut=st.integers(1, 40))
def test_noise_raises_nothing_and_costs_no_later_message(data: bytes, cut: int) -> None:
    decoder = XsensDecoder("mti")
    last = message(utc(20), fine(), trigger(FINE))
    stream = data + bytes(2100) + GNSS + POSITION + last + WEEK_NS.to_bytes(8, "big") + last
    records = [
        r for at in range(0, len(stream), cut) for r in decoder.feed(stream[at : at + cut], 0)
    ]
    assert [r.gps_ns for r in records if isinstance(r, EventMark)] == [GPS_NS + 20_000_000]


def test_the_emulator_encodes_what_was_recorded_byte_by_byte() -> None:
    recorded = data_of(POSITION)
    assert recorded is not None
    nano, *_, flags = recorded["UtcTime"].values
    gps_ns = (utc_ns(RECORDED_UTC) or 0) + nano + 18 * SECOND_NS
    again = xsens_messages.message(
        (0x1020, struct.pack(">H", *recorded["PacketCounter"].values)),
        xsens_messages.sample_time_fine(*recorded["SampleTimeFine"].values),
        xsens_messages.utc_time(gps_ns, 18, flags),
        xsens_messages.status_word(*recorded["StatusWord"].values),
    )
    data = again[4:-1]
    assert len(data) == 5 + 7 + 15 + 7
    assert data == POSITION[4:][: len(data)]
    assert xsens_messages.message((0x0000, bytes(range(254))))[:6] == bytes.fromhex("faff36ff0101")


def test_the_emulator_writes_fixed_point_as_the_manual_defines_it() -> None:
    # MT0101P: the fraction as an unsigned number of 32 bits, then the signed whole number.
    assert xsens_messages.fixed_point(1.5, -0.25) == bytes.fromhex("800000000001c0000000ffff")


def test_a_solution_comes_out_in_si_units() -> None:
    pvt = xsens_messages.gnss_pvt(START_GPS_NS, STATE, ReceiverAccuracy(), 15, 18)
    times = xsens_messages.utc_time(START_GPS_NS, 18), xsens_messages.sample_time_fine(7)
    status = xsens_messages.status_word()
    solution = xsens_messages.message(*times, *xsens_messages.navigation(STATE), status)
    decoder, (sample,) = decode(xsens_messages.message(pvt), solution)
    assert isinstance(sample, NavSample)
    assert (sample.gps_ns, sample.fix, sample.satellites) == (START_GPS_NS, "3d", 15)
    assert sample.latitude_deg == pytest.approx(STATE.latitude_deg, abs=1e-9)
    assert sample.longitude_deg == pytest.approx(STATE.longitude_deg, abs=1e-9)
    assert sample.height_m == pytest.approx(STATE.height_m, abs=1e-9)
    assert sample.velocity_ned_mps == pytest.approx(STATE.velocity_ned_mps, abs=1e-9)
    assert sample.roll_rad == pytest.approx(math.radians(STATE.roll_deg), abs=1e-9)
    assert sample.pitch_rad == pytest.approx(math.radians(STATE.pitch_deg), abs=1e-9)
    assert sample.heading_rad == pytest.approx(math.radians(STATE.heading_deg), abs=1e-9)
    assert sample.horizontal_sigma_m == pytest.approx(0.02)
    assert sample.vertical_sigma_m == pytest.approx(0.03)
    assert sample.speed_sigma_mps == pytest.approx(0.03)
    assert (sample.time_valid, decoder.leap_seconds, sample.leap_source) == (True, 18, "receiver")


@pytest.mark.parametrize("left_out", ["height", "velocity", "position"])
def test_sigmas_are_absent_without_their_values(left_out: str) -> None:
    pvt = xsens_messages.gnss_pvt(START_GPS_NS, STATE, ReceiverAccuracy(), 15, 18)
    angles, height, place, velocity = xsens_messages.navigation(STATE)
    data = [xsens_messages.utc_time(START_GPS_NS, 18), angles, place]
    data += [] if left_out == "height" else [height]
    data += [] if left_out == "velocity" else [velocity]
    data.append(xsens_messages.status_word(0 if left_out == "position" else NAVIGATING))
    (sample,) = samples(xsens_messages.message(pvt), xsens_messages.message(*data))
    assert (sample.vertical_sigma_m is None) == (left_out in ("height", "position"))
    assert (sample.speed_sigma_mps is None) == (left_out in ("velocity", "position"))
    assert (sample.horizontal_sigma_m is None) == (left_out == "position")
    assert (sample.longitude_deg is None) == (left_out == "position")


def test_leap_seconds_are_not_taken_from_a_time_that_is_not_resolved() -> None:
    kind, content = xsens_messages.gnss_pvt(START_GPS_NS, STATE, ReceiverAccuracy(), 15, 18)
    for flags, leap in ((7, 18), (3, None)):
        changed = content[:11] + bytes([flags]) + content[12:]
        assert decode(xsens_messages.message((kind, changed)))[0].leap_seconds == leap


def test_a_datum_whose_head_is_cut_is_bad_and_an_empty_one_is_passed_over() -> None:
    def raw(body: bytes) -> bytes:
        covered = b"\xff\x36" + bytes([len(body)]) + body
        return b"\xfa" + covered + bytes([-sum(covered) & 0xFF])

    for cut in (b"\x00", b"\x00\x10"):
        decoder, records = decode(raw(cut))
        assert (records, decoder.bad_messages) == ([], 1)
    decoder, records = decode(raw(b"\x00\x10\x00"))
    assert (records, decoder.bad_messages) == ([], 0)
