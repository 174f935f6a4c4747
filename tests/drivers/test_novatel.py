"""NovAtel logs: inertial solutions and marks at GPS time, checked by NovAtel's own decoder."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from novatel_edie import oem

from drivers.contract import EventMark, NavSample
from drivers.receivers.message_decoder import Nav
from drivers.receivers.novatel.decoder import NovatelDecoder
from drivers.receivers.novatel.framing import crc32
from drivers.timescales.gps_time import WEEK_NS

NAV = Path(__file__).parent / "data"
EXCERPT = Path(__file__).parent / "data" / "novatel-ins2-excerpt.gps"
FINESTEERING, UNKNOWN = 180, 20
WEEK = 2445


def log(identity: int, body: bytes, *, week: int = WEEK, ms: int = 0, status: int = 180) -> bytes:
    head = struct.pack("<3sBHBBHHBBHiIHH", b"\xaa\x44\x12", 28, identity, 0, 32, len(body), 0, 0,
                       status, week, ms, 0, 0, 16000)  # fmt: skip
    return head + body + crc32(head + body).to_bytes(4, "little")


def mark_time(seconds: float, offset: float = 0.0, *, week: int = WEEK) -> bytes:
    return log(1130, struct.pack("<I4dI", week, seconds, offset, 3e-9, -18.0, 0))


def pva(identity: int, seconds: float, *, week: int = WEEK, status: int = 3) -> bytes:
    body = struct.pack("<I10dI", week, seconds, 47.5, 8.5, 1000.0, 60.0, 3.0, 1.0, 1.5, -2.0, 359.0,
                       status)  # fmt: skip
    return log(identity, body, week=week, ms=round(seconds * 1000))


def decode(data: bytes, piece: int = 0) -> tuple[NovatelDecoder, list[Nav]]:
    decoder = NovatelDecoder("span")
    records: list[Nav] = []
    for at in range(0, len(data), piece or len(data) or 1):
        records += decoder.feed(data[at : at + (piece or len(data))], 77)
    return decoder, records


def marks(data: bytes) -> list[EventMark]:
    return [r for r in decode(data)[1] if isinstance(r, EventMark)]


def test_an_inertial_solution_comes_out_in_si_units() -> None:
    (sample,) = decode(pva(507, 360_018.25))[1]
    assert isinstance(sample, NavSample)
    assert sample.gps_ns == WEEK * WEEK_NS + 360_018_250_000_000
    assert sample.velocity_ned_mps == (60.0, 3.0, -1.0)
    assert (sample.roll_rad, sample.heading_rad) == (math.radians(1.5), math.radians(359.0))
    assert (sample.fix, sample.time_valid) == ("3d", True)


def test_the_published_mark_line_is_that_of_novatels_decoder() -> None:
    line = (
        b"#MARK1PVAA,USB1,0,92.0,EXACT,1753,238273.050,00000000,0000,470;1753,238273.050000025,"
        b"37.856359728,-122.494864165,110.390118713,16.041177523,-24.789919285,-1.752024973,"
        b"-3.954175540,4.393638450,32.292000751,INS_SOLUTION_GOOD*016857cc\r\n"
    )
    parser = oem.Parser()
    parser.write(line)
    (theirs,) = list(parser)
    (mark,) = marks(line)
    assert mark.gps_ns == theirs.week * WEEK_NS + round(theirs.seconds * 1e9)
    assert mark.gps_ns % WEEK_NS == 238_273_050_000_025
    assert (mark.channel, mark.time_valid) == (1, True)


def test_the_clock_offset_is_taken_off_a_mark_time_and_its_mark_pva_is_no_second_mark() -> None:
    data = mark_time(100.5 + 2e-6, offset=2e-6) + pva(1067, 100.5) + mark_time(100.5, 0.0)
    (mark,) = marks(data)
    assert mark.gps_ns == WEEK * WEEK_NS + 100_500_000_000
    parser = oem.Parser()
    parser.write(data)
    theirs = [m for m in parser if "MARK1TIME" in type(m).__name__]
    assert [m.week for m in theirs] == [WEEK, WEEK]


def test_a_late_mark_of_the_week_before_keeps_its_own_week() -> None:
    data = pva(507, 0.5, week=WEEK + 1) + mark_time(604_799.75)
    (mark,) = marks(data)
    assert mark.gps_ns == (WEEK + 1) * WEEK_NS - 250_000_000
    assert mark.time_valid


def test_a_rolled_over_week_and_a_time_that_is_not_known_are_not_valid() -> None:
    assert [m.time_valid for m in marks(pva(507, 9.0) + mark_time(9.0, week=WEEK - 1024))] == [
        False
    ]
    body = struct.pack("<I4dI", WEEK, 9.0, 0.0, 0.0, -18.0, 0)
    assert [m.time_valid for m in marks(log(1130, body, status=UNKNOWN))] == [False]


def test_leap_seconds_come_from_a_valid_time_log_only() -> None:
    def time(utc_status: int) -> bytes:
        return log(
            101, struct.pack("<I3dIBBBBII", 0, 0, 0, -18.0, 2026, 11, 21, 9, 0, 0, utc_status)
        )

    assert decode(time(0))[0].leap_seconds is None
    assert decode(time(1))[0].leap_seconds == 18


@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_damage_and_noise_raise_nothing_and_cost_no_later_message(data: st.DataObject) -> None:
    stream = bytearray(b"".join(pva(507, n / 10) + mark_time(n / 10) for n in range(4)))
    for _ in range(data.draw(st.integers(0, 8))):
        stream[data.draw(st.integers(0, len(stream) - 1))] = data.draw(st.integers(0, 255))
    stream_bytes = (
        bytes(stream) + data.draw(st.binary(max_size=200)) + mark_time(50.0) + mark_time(51.0)
    )
    decoder_whole, records = decode(stream_bytes)
    seconds = [r.gps_ns - WEEK * WEEK_NS for r in records]
    assert seconds[-1:] == [51 * 10**9]
    pieces, same = decode(stream_bytes, data.draw(st.integers(1, 60)))
    assert same == records
    assert (pieces.frames, pieces.bad_bytes) == (decoder_whole.frames, decoder_whole.bad_bytes)


@pytest.mark.parametrize("path", [EXCERPT, NAV / "novatel" / "ins2.gps"])
def test_every_recorded_solution_is_that_of_novatels_decoder(path: Path) -> None:
    decoder, records = decode(path.read_bytes())
    parser = oem.Parser()
    parser.write(path.read_bytes())
    theirs = [m for m in parser if type(m).__name__.startswith("INSPVAS")]
    assert len(records) == len(theirs) > 0
    assert decoder.bad_messages == 0
    for sample, their in zip(records, theirs, strict=True):
        assert isinstance(sample, NavSample)
        assert sample.gps_ns == their.week * WEEK_NS + round(their.seconds * 1e9)
        assert (sample.latitude_deg, sample.longitude_deg) == (their.latitude, their.longitude)
        assert sample.height_m == their.height
        assert sample.roll_rad == math.radians(their.roll)


def test_a_stream_that_is_nothing_but_sync_errors_gives_nothing_and_is_not_retained() -> None:
    path = NAV / "novatel" / "binary_sync_error.BIN"
    data = path.read_bytes()
    decoder, records = decode(data, 500)
    assert (records, decoder.frames, decoder.bad_bytes) == ([], 0, len(data))


def test_without_an_inertial_solution_the_position_comes_from_bestpos() -> None:
    position = struct.pack("<II3dfI3f4s2f8B", 0, 50, 47.5, 8.5, 952.5, 47.5, 61, 0.03, 0.04, 0.09,
                           b"0001", 0.0, 0.0, 17, 16, 0, 0, 0, 0, 0, 0)  # fmt: skip
    velocity = struct.pack("<II2f3df", 0, 8, 0.0, 0.0, 60.0, 90.0, 1.0, 0.0)
    data = log(99, velocity, ms=5000) + log(42, position, ms=5000)
    (sample,) = decode(data)[1]
    assert isinstance(sample, NavSample)
    assert (sample.latitude_deg, sample.height_m, sample.satellites) == (47.5, 1000.0, 16)
    assert sample.velocity_ned_mps == pytest.approx((0.0, 60.0, -1.0))
    assert sample.horizontal_sigma_m == pytest.approx(0.05)
    parser = oem.Parser()
    parser.write(data)
    _, theirs = list(parser)
    assert (theirs.latitude, theirs.num_soln_svs) == (47.5, 16)


@pytest.mark.parametrize("name", ["TIME", "BESTPOS", "BESTVEL", "INSPVAX", "MARK1TIME", "INSPVA"])
@pytest.mark.parametrize("body", ["a," * 30 + "a", "", "1e999," * 24 + "nan", "VALID," * 12 + "1"])
def test_a_checked_line_of_nonsense_raises_nothing(name: str, body: str) -> None:
    stream_bytes = f"{name}A,COM1,0,1,FINESTEERING,2445,1.0,0,0,1;{body}".encode()
    decoder, records = decode(b"#" + stream_bytes + b"*%08x\r\n" % crc32(stream_bytes))
    assert decoder.frames == 1
    assert records == []


INSPVAX_FIELDS = (
    "INS_SOLUTION_GOOD,INS_RTKFIXED,47.5,8.5,952.5,47.5000,60.0,3.0,1.0,1.5,-2.0,359.0,"
    "0.0300,0.0400,0.0900,0.01,0.01,1.0e-02,0.02,0.02,0.05,{status},0"
)


def line(name: str, body: str, *, week: str = str(WEEK), seconds: str = "360018.250") -> bytes:
    stream_bytes = f"{name}A,COM1,0,1.0,FINESTEERING,{week},{seconds},02000000,0,1;{body}".encode()
    return b"#" + stream_bytes + b"*%08x\r\n" % crc32(stream_bytes)


@pytest.mark.trust
@pytest.mark.parametrize("status", ["2e000343", "00000000", "1e5", "12345678", "e2000343", "nan"])
def test_a_solution_in_text_is_read_whatever_its_hexadecimal_status(status: str) -> None:
    stream_bytes = line("INSPVAX", INSPVAX_FIELDS.format(status=status))
    decoder, records = decode(stream_bytes)
    (sample,) = records
    assert isinstance(sample, NavSample)
    assert sample.gps_ns == WEEK * WEEK_NS + 360_018_250_000_000
    assert (sample.latitude_deg, sample.height_m, sample.fix) == (47.5, 1000.0, "3d")
    assert sample.velocity_ned_mps == (60.0, 3.0, -1.0)
    assert sample.horizontal_sigma_m == pytest.approx(0.05)
    assert decoder.bad_messages == 0


TEXT = {
    "INSPVAX": INSPVAX_FIELDS.format(status="2e000343"),
    "INSPVA": f"{WEEK},360018.25,47.5,8.5,1000.0,60.0,3.0,1.0,1.5,-2.0,359.0,INS_SOLUTION_GOOD",
    "BESTPOS": 'SOL_COMPUTED,NARROW_INT,47.5,8.5,952.5,47.5,WGS84,0.03,0.04,0.09,"",0.0,0.0,17,16,'
    "16,16,0,2e,7f,37",
    "BESTVEL": "SOL_COMPUTED,DOPPLER_VELOCITY,0.0,0.0,60.0,90.0,1.0,0.0",
    "TIME": "VALID,1.667187222e-10,9.641617960e-10,-18.00000000000,2026,11,21,9,0,0,VALID",
    "MARK1TIME": f"{WEEK},360018.25,1.5e-07,3.0e-09,-18.0,VALID",
    "MARK1PVA": f"{WEEK},360018.25,47.5,8.5,1000.0,60.0,3.0,1.0,1.5,-2.0,359.0,INS_SOLUTION_GOOD",
}
NOT_READ = {"INSPVAX": (21, 22), "BESTPOS": (6, 10, *range(15, 21)), "BESTVEL": (7,)}
ENUMERATED_FIELDS = {
    "BESTPOS": (0, 1), "BESTVEL": (0, 1), "INSPVAX": (0, 1), "TIME": (0, 10), "INSPVA": (11,),
    "MARK1TIME": (5,), "MARK1PVA": (11,),
}  # fmt: skip


@pytest.mark.trust
@pytest.mark.parametrize("name", TEXT)
def test_a_number_in_text_that_is_none_makes_a_bad_log_and_never_a_value(name: str) -> None:
    decoder_whole, records = decode(line(name, TEXT[name]))
    assert (decoder_whole.bad_messages, decoder_whole.seen[name]) == (0, 1)
    fields = TEXT[name].split(",")
    for position in range(len(fields)):
        is_read = position not in (*NOT_READ.get(name, ()), *ENUMERATED_FIELDS[name])
        for damaged in (
            "",
            "nan",
            "inf",
            "-inf",
            "1e999",
            "1_0",
            "2e000343",
            "0x10",
            " 1",
            "1.5.2",
        ):
            stream_bytes = [*fields[:position], damaged, *fields[position + 1 :]]
            decoder, decoded = decode(line(name, ",".join(stream_bytes)))
            if is_read:
                assert (decoder.bad_messages, decoded) == (1, []), (position, damaged)
            elif position not in ENUMERATED_FIELDS[name]:
                assert (decoder.bad_messages, decoded) == (0, records), (position, damaged)


@pytest.mark.trust
@pytest.mark.parametrize(
    "header",
    [
        {"week": "2_445"},
        {"week": "70000"},
        {"week": ""},
        {"seconds": "nan"},
        {"seconds": "1e999"},
        {"seconds": "-5"},
    ],
)
def test_a_header_in_text_with_a_number_that_is_none_makes_a_bad_log(
    header: dict[str, str],
) -> None:
    decoder, records = decode(line("BESTPOS", TEXT["BESTPOS"], **header))
    assert (decoder.bad_messages, records) == (1, [])


@pytest.mark.parametrize(("nbytes", "is_framed"), [(8_192, True), (8_193, False)])
def test_a_log_has_a_body_of_8192_bytes_at_most(nbytes: int, is_framed: bool) -> None:
    long = log(4_242, bytes(nbytes))
    decoder, _ = decode(long + mark_time(10.0))
    # A longer one costs itself, and no log behind it.
    assert (decoder.bad_bytes == 0) is is_framed
    assert len(marks(long + mark_time(10.0))) == 1


def position_mark(identity: int, ms: int, *, status: int = 180) -> bytes:
    body = struct.pack("<II3df4x3f4x2fBB6x", 0, 16, 47.5, 8.5, 950.0, 50.0, 3.0, 4.0, 0.9, 0.0, 0.0,
                       20, 17)  # fmt: skip
    return log(identity, body, ms=ms, status=status)


def test_a_mark_time_of_oem6_is_a_mark_of_the_first_input() -> None:
    data = log(231, struct.pack("<I4dI", WEEK, 100.25, 1e-6, 3e-9, -18.0, 0))
    (mark,) = marks(data)
    assert (mark.channel, mark.gps_ns) == (1, WEEK * WEEK_NS + 100_250_000_000 - 1000)
    parser = oem.Parser()
    parser.write(data)
    (theirs,) = list(parser)
    assert (type(theirs).__name__.partition("_")[0], theirs.seconds) == ("MARKTIME", 100.25)
    twice = data + mark_time(100.25, 1e-6)
    assert len(marks(twice)) == 1


@pytest.mark.parametrize(("identity", "channel"), [(181, 1), (615, 2), (1738, 3), (1739, 4)])
def test_a_mark_position_alone_is_a_coarse_mark_a_second_later(identity: int, channel: int) -> None:
    data = position_mark(identity, 100_250)
    decoder, records = decode(data + pva(507, 101.249))
    assert not [r for r in records if isinstance(r, EventMark)]
    (mark,) = [r for r in decoder.feed(pva(507, 101.25), 78) if isinstance(r, EventMark)]
    assert (mark.channel, mark.gps_ns) == (channel, WEEK * WEEK_NS + 100_250_000_000)
    assert (mark.accuracy_ns, mark.time_valid, mark.mono_ns) == (1_000_000, True, 77)
    assert decoder.counters["marks_coarse"] == 1
    parser = oem.Parser()
    parser.write(data)
    (theirs,) = list(parser)
    assert type(theirs).__name__.startswith("MARK") and "POS" in type(theirs).__name__


@pytest.mark.parametrize("order", ["time-first", "position-first"])
def test_a_mark_position_of_a_mark_time_is_no_second_mark(order: str) -> None:
    parts = [mark_time(100.2504), position_mark(181, 100_250)]
    data = b"".join(parts if order == "time-first" else parts[::-1]) + pva(507, 102.0)
    decoder, _ = decode(data)
    assert [m.accuracy_ns for m in marks(data)] == [100]
    assert decoder.counters["marks_coarse"] == 0


def test_a_mark_position_before_the_time_is_good_is_not_valid() -> None:
    data = position_mark(181, 100_250, status=UNKNOWN) + pva(507, 102.0)
    assert [m.time_valid for m in marks(data)] == [False]
