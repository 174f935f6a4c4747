"""Every recorded log against a reading of its bytes by the interface description alone.

What the drivers make of the recordings is held message by message against offsets written down
here, which share no code with them: u-blox M8 (UBX-13003221) and OEM7 (OM-20000169). Where else a
recording is compared with another decoder is stated in `LOGS`.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.contract import NavSample
from drivers.receivers.novatel.decoder import NovatelDecoder
from drivers.receivers.ublox.decoder import UbxDecoder

NAV = Path(__file__).parent / "data"
WEEK_NS = 604_800 * 10**9
LEAP_NS = 18 * 10**9

LOGS = {
    "gpsd/u-blox-m8t-time.log": "here; leap seconds in test_ublox_recordings (pyubx2)",
    "gpsd/ublox-neo-m8l.log": "here; test_ublox_recordings (pyubx2), test_gpsd (gpsd)",
    "gpsd/ublox-zed-f9r.log": "here; test_ublox_recordings, test_nmea (pynmeagps), test_gpsd",
    "novatel/ins2.gps": "here; test_novatel (NovAtel's own decoder)",
    "novatel/binary_sync_error.BIN": "test_novatel: nothing but sync errors",
}


def ubx_frames(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Class and identity in one number, and payload, of every whole frame."""
    at = 0
    while (at := data.find(b"\xb5\x62", at)) >= 0:
        (length,) = struct.unpack_from("<H", data, at + 4)
        body = data[at + 2 : at + 6 + length]
        a = b = 0
        for byte in body:
            a = (a + byte) & 0xFF
            b = (b + a) & 0xFF
        if data[at + 6 + length : at + 8 + length] == bytes((a, b)):
            yield body[0] << 8 | body[1], body[4:]
            at += 8 + length
        else:
            at += 2


PVT, TIMEGPS, TIMELS, TIM_TP, ATT = 0x0107, 0x0120, 0x0126, 0x0D01, 0x2801


def gps_ns_of_timegps(payload: bytes) -> int:
    itow_ms, ftow_ns, week = struct.unpack_from("<Iih", payload)
    return int(week * WEEK_NS + itow_ms * 10**6 + ftow_ns)


def test_every_recording_is_held_against_another_reading() -> None:
    assert {str(path.relative_to(NAV)) for path in NAV.glob("*/*")} == set(LOGS)


@pytest.mark.parametrize(
    ("name", "frames", "samples"),
    [("u-blox-m8t-time", 1511, 0), ("ublox-neo-m8l", 1388, 19), ("ublox-zed-f9r", 277, 30)],
)
def test_positions_times_and_counts_of_a_ublox_log(name: str, frames: int, samples: int) -> None:
    data = (NAV / "gpsd" / f"{name}.log").read_bytes()
    decoder = UbxDecoder(name)
    got = [r for r in decoder.feed(data, 0) if isinstance(r, NavSample)]
    messages = list(ubx_frames(data))
    counts = Counter(identity for identity, _ in messages)
    assert decoder.frames == len(messages) == frames
    assert decoder.bad_messages == 0
    seen = {PVT: "NAV-PVT", TIMEGPS: "NAV-TIMEGPS", TIMELS: "NAV-TIMELS", ATT: "HNR-ATT"}
    assert {i: decoder.seen[n] for i, n in seen.items()} == {i: counts[i] for i in seen}
    times = {
        struct.unpack_from("<I", p)[0]: gps_ns_of_timegps(p) for i, p in messages if i == TIMEGPS
    }
    pvts = [payload for identity, payload in messages if identity == PVT]
    assert len(got) == len(pvts) == samples
    for sample, payload in zip(got, pvts, strict=True):
        (itow_ms,) = struct.unpack_from("<I", payload)
        fix_type, satellites = payload[20], payload[23]
        lon, lat, height_mm, _, h_acc_mm, v_acc_mm = struct.unpack_from("<iiiiII", payload, 24)
        velocity_mm_s = struct.unpack_from("<iii", payload, 48)
        # The receiver's UTC is off GPS by some nanoseconds in addition to the leap seconds.
        assert abs(sample.gps_ns - times[itow_ms]) <= 10
        assert sample.latitude_deg == pytest.approx(lat * 1e-7, abs=1e-12)
        assert sample.longitude_deg == pytest.approx(lon * 1e-7, abs=1e-12)
        assert sample.height_m == pytest.approx(height_mm * 1e-3)
        assert sample.horizontal_sigma_m == pytest.approx(h_acc_mm * 1e-3)
        assert sample.vertical_sigma_m == pytest.approx(v_acc_mm * 1e-3)
        assert sample.velocity_ned_mps == pytest.approx([v * 1e-3 for v in velocity_mm_s])
        assert sample.satellites == satellites
        assert (sample.fix == "3d") == (fix_type in (3, 4))


def test_the_m8t_announces_the_next_pulse_in_utc_and_is_not_trusted_without_a_check() -> None:
    """TIM-TP and NAV-TIMEGPS of one second: 18 s apart for UTC, one more for what is to come."""
    data = (NAV / "gpsd" / "u-blox-m8t-time.log").read_bytes()
    decoder = UbxDecoder("m8t")
    announced_ns: int | None = None
    pairs = 0
    for identity, payload in ubx_frames(data):
        frame = _framed(identity, payload)
        if identity == TIM_TP:
            tow_ms, _, _, week, flags = struct.unpack_from("<IIiHB", payload)
            assert flags & 1 == 1, "the time base of this receiver's pulse is UTC"
            announced_ns = week * WEEK_NS + tow_ms * 10**6
        before = decoder._gps_ns
        decoder.feed(frame, 0)
        if identity == TIM_TP:
            assert decoder._gps_ns == before, "an announced pulse is no time"
        if identity == TIMEGPS and announced_ns is not None:
            second_ns = round(gps_ns_of_timegps(payload) / 10**9) * 10**9
            assert decoder._gps_ns == gps_ns_of_timegps(payload)
            assert second_ns - announced_ns == LEAP_NS - 10**9
            assert announced_ns + LEAP_NS == second_ns + 10**9
            pairs += 1
            announced_ns = None
    assert pairs == 151
    assert decoder.leap_seconds == 18


def _framed(identity: int, payload: bytes) -> bytes:
    body = bytes((identity >> 8, identity & 0xFF)) + struct.pack("<H", len(payload)) + payload
    a = b = 0
    for byte in body:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    return b"\xb5\x62" + body + bytes((a, b))


def test_positions_times_and_counts_of_the_span_log() -> None:
    data = (NAV / "novatel" / "ins2.gps").read_bytes()
    decoder = NovatelDecoder("span")
    got = [r for r in decoder.feed(data, 0) if isinstance(r, NavSample)]
    solutions = []
    at = messages = 0
    while (at := data.find(b"\xaa\x44", at)) >= 0 and at + 12 <= len(data):
        if data[at + 2] == 0x13:
            size, header = 12 + data[at + 3], 12
        elif data[at + 2] == 0x12:
            size, header = data[at + 3] + struct.unpack_from("<H", data, at + 8)[0], data[at + 3]
        else:
            at += 2
            continue
        crc = zlib.crc32(data[at : at + size], 0xFFFFFFFF) ^ 0xFFFFFFFF
        if data[at + size : at + size + 4] != struct.pack("<I", crc):
            at += 2
            continue
        messages += 1
        if struct.unpack_from("<H", data, at + 4)[0] == 508:  # INSPVAS
            solutions.append(struct.unpack_from("<Id3d3d3dI", data, at + header))
        at += size + 4
    assert decoder.frames == messages
    assert len(got) == len(solutions) == 62
    for sample, (week, seconds, lat, lon, height, north, east, up, roll, *_) in zip(
        got, solutions, strict=True
    ):
        assert sample.gps_ns == week * WEEK_NS + round(seconds * 1e9)
        assert (sample.latitude_deg, sample.longitude_deg) == (lat, lon)
        assert sample.height_m == height
        assert sample.velocity_ned_mps == (north, east, -up)
        assert sample.roll_rad == math.radians(roll)
