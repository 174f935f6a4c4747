"""A small GPS constellation, and what receivers measure of it: observations and messages.

Satellites follow the broadcast ephemeris model (IS-GPS-200, table 20-IV) with the elements that the
subframes state; signals travel in vacuum, clocks are perfect. Carrier phases have an
arbitrary whole number of cycles.
"""

from __future__ import annotations

import binascii
import struct
import zlib
from datetime import UTC, datetime

import numpy as np

GM, OMEGA_EARTH, C = 3.986005e14, 7.2921151467e-5, 299_792_458.0
L1_HZ = 1_575_420_000.0
SQRT_A = 5153.7
WEEK_NS = 604_800_000_000_000
GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)


def satellites() -> dict[int, tuple[float, float, float]]:
    """Right ascension, inclination and mean anomaly at the reference time, rad, by PRN."""
    planes = [(k * np.pi / 3, np.radians(55.0)) for k in range(6)]
    return {
        1 + 5 * p + s: (node, inclination, 2 * np.pi * (s + 0.37 * p) / 5)
        for p, (node, inclination) in enumerate(planes)
        for s in range(5)
    }


def place(prn: int, tow_s: float, toe_s: float) -> np.ndarray:
    """Earth-fixed position of a satellite at an instant."""
    node, inclination, anomaly = satellites()[prn]
    elapsed = tow_s - toe_s
    u = anomaly + np.sqrt(GM) / SQRT_A**3 * elapsed
    longitude = node - OMEGA_EARTH * elapsed - OMEGA_EARTH * toe_s
    x, y = SQRT_A**2 * np.cos(u), SQRT_A**2 * np.sin(u)
    return np.array(
        [
            x * np.cos(longitude) - y * np.cos(inclination) * np.sin(longitude),
            x * np.sin(longitude) + y * np.cos(inclination) * np.cos(longitude),
            y * np.sin(inclination),
        ]
    )


def ranges(at: np.ndarray, tow_s: float, toe_s: float) -> dict[int, float]:
    """Distances of the satellites above ten degrees, with the earth's turn on the way."""
    up = at / np.linalg.norm(at)
    found = {}
    for prn in satellites():
        travel = 0.075
        for _ in range(4):
            there = place(prn, tow_s - travel, toe_s)
            turn = OMEGA_EARTH * travel
            there = np.array(
                [
                    there[0] * np.cos(turn) + there[1] * np.sin(turn),
                    -there[0] * np.sin(turn) + there[1] * np.cos(turn),
                    there[2],
                ]
            )
            distance = float(np.linalg.norm(there - at))
            travel = distance / C
        if (there - at) @ up / distance > np.sin(np.radians(10.0)):
            found[prn] = distance
    return found


GPS_L1, GPS_L2 = (0, L1_HZ), (3, 1_227_600_000.0)
"""Signals of RXM-RAWX: identifier and frequency of L1 C/A and L2 CL."""


def rawx(
    at: np.ndarray,
    gps_ns: int,
    toe_s: float,
    noise: np.random.Generator,
    *,
    signals: tuple[tuple[int, float], ...] = (GPS_L1,),
    clock_ns: int = 0,
) -> bytes:
    """One RXM-RAWX of GPS; the receiver's clock is fast by `clock_ns`."""
    week, rest = divmod(gps_ns + clock_ns, WEEK_NS)
    tow_s = gps_ns % WEEK_NS * 1e-9
    seen = ranges(at, tow_s, toe_s)
    later = ranges(at, tow_s + 0.5, toe_s)
    count = len(seen) * len(signals)
    payload = struct.pack("<dHbBBB2x", rest * 1e-9, week, 18, count, 1, 1)
    for prn, distance in seen.items():
        doppler_mps = -(later.get(prn, distance) - distance) / 0.5
        for signal, hertz in signals:
            measured = distance + C * clock_ns * 1e-9
            phase = measured * hertz / C + 100_000 * prn + 7_000 * signal
            payload += struct.pack(
                "<ddfBBBBHBBBBBx", measured + noise.normal(0, 0.05),
                phase + noise.normal(0, 0.003), doppler_mps * hertz / C, 0, prn, signal, 0,
                60_000, 45, 3, 1, 3, 0b0111,
            )  # fmt: skip
    body = struct.pack("<BBH", 0x02, 0x15, len(payload)) + payload
    a = b = 0
    for byte in body:
        a = (a + byte) & 255
        b = (b + a) & 255
    return b"\xb5\x62" + body + bytes((a, b))


def novatel_range(at: np.ndarray, gps_ns: int, toe_s: float) -> bytes:
    """One binary RANGE of GPS L1 C/A, L2P(Y) and GLONASS L1 with the same ranges."""
    week, rest = divmod(gps_ns, WEEK_NS)
    seen = ranges(at, rest * 1e-9, toe_s)
    rows = b""
    count = 0
    for prn, distance in seen.items():
        for system, signal, number, channel, hertz in (
            (0, 0, prn, 0, L1_HZ),
            (0, 9, prn, 0, 1_227_600_000.0),
            (1, 0, 37 + prn % 24 + 1, prn % 14, 1_602_000_000.0 + (prn % 14 - 7) * 562_500.0),
        ):
            status = 1 << 10 | 1 << 11 | 1 << 12 | 4 | system << 16 | signal << 21
            rows += struct.pack(
                "<HHdfdffffI", number, channel, distance, 0.1,
                -distance * hertz / C, 0.01, 100.0, 45.0, 60.0, status,
            )  # fmt: skip
            count += 1
    body = struct.pack("<I", count) + rows
    head = struct.pack(
        "<3sBHBBHHBBHiIHH", b"\xaa\x44\x12", 28, 43, 0, 0x20, len(body), 0, 0, 180, week,
        rest // 1_000_000, 0, 0, 0,
    )  # fmt: skip
    data = head + body
    return data + struct.pack("<I", zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF)


SBF_SIGNALS = (
    (0, 0, L1_HZ, 40.25), (2, 0, 1_227_600_000.0, 31.5), (4, 0, 1_176_450_000.0, 44.0),
    (8, 1, 1_602_000_000.0, 43.75), (11, 1, 1_246_000_000.0, 38.0),
)  # fmt: skip
"""Signal number, whether of GLONASS, frequency without its channel, and strength."""


def meas_epoch(at: np.ndarray, gps_ns: int, toe_s: float, *, signals=SBF_SIGNALS) -> bytes:
    """One MeasEpoch of three signals of GPS and two of GLONASS with the same ranges.

    The ranges of a signal exceed those of the one before it by 12.345 m; phases have a whole number
    of cycles of their own, Dopplers come from the ranges half a second later.
    """
    week, rest = divmod(gps_ns, WEEK_NS)
    tow_s = rest * 1e-9
    seen = ranges(at, tow_s, toe_s)
    later = ranges(at, tow_s + 0.5, toe_s)
    body = b""
    count = 0
    for prn, distance in seen.items():
        rate = (later.get(prn, distance) - distance) / 0.5
        for glonass in (0, 1):
            rows = [one for one in signals if one[1] == glonass]
            if not rows:
                continue
            channel = prn % 14 - 7 if glonass else 0
            first_code = first_doppler = first_hertz = 0.0
            for k, (number, _, middle_hz, strength) in enumerate(rows):
                step = 562_500.0 if number == 8 else 437_500.0 if number == 11 else 0.0
                hertz = middle_hz + channel * step
                code = round((distance + 12.345 * k) * 1000)
                doppler = round(-rate * hertz / C * 1e4)
                cycles = round((distance * hertz / C + 100 + prn - code / 1000 * hertz / C) * 1000)
                info = (channel + 8) << 3 if glonass else 0
                level = round((strength - (0 if number in (1, 2) else 10)) * 4)
                if k == 0:
                    first_code, first_doppler, first_hertz = code, doppler, hertz
                    body += struct.pack(
                        "<BBBBIiHbBHBB", prn, number, 37 + prn % 24 + 1 if glonass else prn,
                        code >> 32, code & 0xFFFFFFFF, doppler, cycles & 0xFFFF, cycles >> 16,
                        level, 60, info, len(rows) - 1,
                    )  # fmt: skip
                    continue
                offset = code - first_code
                change = round(doppler - first_doppler * hertz / first_hertz)
                upper = offset >> 16 & 7 | (change >> 16 & 31) << 3
                body += struct.pack(
                    "<BBBBbBHHH", number, 60, level, upper, cycles >> 16, info,
                    offset & 0xFFFF, cycles & 0xFFFF, change & 0xFFFF,
                )  # fmt: skip
            count += 1
    head = struct.pack("<IHBBBBBB", rest // 1_000_000, week, count, 20, 12, 0, 0, 0)
    content = head + body
    content += bytes(-len(content) % 4)
    checked = struct.pack("<HH", 4027 | 1 << 13, 8 + len(content)) + content
    return b"$@" + struct.pack("<H", binascii.crc_hqx(checked, 0)) + checked


def subframe_words(prn: int, gps_ns: int, toe_s: float, *, corrections: int = 1) -> list[list[int]]:
    """Subframes 1 to 3 of a satellite: ten words of 24 bits each, issue of data 17.

    Without `corrections` they state the orbit and the perfect clock of the constellation; with
    them, fields that it does not have are not zero.
    The fields are written one after the other, as in figure 20-1 of IS-GPS-200.
    """
    node, inclination, anomaly = satellites()[prn]
    week, rest = divmod(gps_ns, WEEK_NS)
    count = rest // 6_000_000_000
    k = corrections

    def fields(*pairs: tuple[float, int]) -> int:
        whole = 0
        for value, bits in pairs:
            whole = whole << bits | (round(value) & ((1 << bits) - 1))
        return whole

    def cycles(angle: float) -> float:
        return (angle / 3.1415926535898 + 1) % 2 - 1

    def head(number: int) -> tuple[tuple[float, int], ...]:
        return (0x8B, 8), (0, 16), (count + number, 17), (0, 2), (number, 3), (0, 2)

    frames = [
        fields(
            *head(1), (week % 1024, 10), (1, 2), (2, 4), (0, 6), (17 >> 8, 2), (1, 1), (0, 23),
            (0, 24), (0, 24), (0, 16), (-5 * k, 8), (17, 8), (toe_s / 16, 16), (-3 * k, 8),
            (21 * k, 16), ((-1234 - prn) * k, 22), (0, 2),
        ),
        fields(
            *head(2), (17, 8), (-88 * k, 16), (140 * k, 16), (cycles(anomaly) * 2**31, 32),
            (-77 * k, 16), (0.012 * 2**33 * k, 32), (66 * k, 16), (SQRT_A * 2**19, 32),
            (toe_s / 16, 16), (0, 1), (0, 7),
        ),
        fields(
            *head(3), (-9 * k, 16), (cycles(node) * 2**31, 32), (11 * k, 16),
            (cycles(inclination) * 2**31, 32), (321 * k, 16),
            (cycles(-1.1) * 2**31 * k, 32), (-22_000 * k, 24), (17, 8), (-45 * k, 14), (0, 2),
        ),
    ]  # fmt: skip
    return [[frame >> 24 * (9 - n) & 0xFFFFFF for n in range(10)] for frame in frames]


def sfrbx(prn: int, words: list[int]) -> bytes:
    """One RXM-SFRBX of GPS L1 C/A; parity bits are ones."""
    payload = struct.pack("<BBBBBBBB", 0, prn, 0, 0, 10, 0, 2, 0)
    payload += struct.pack("<10I", *(word << 6 | 0x3F for word in words))
    body = struct.pack("<BBH", 0x02, 0x13, len(payload)) + payload
    a = b = 0
    for byte in body:
        a = (a + byte) & 255
        b = (b + a) & 255
    return b"\xb5\x62" + body + bytes((a, b))


def rawephem(prn: int, gps_ns: int, toe_s: float, frames: list[list[int]]) -> bytes:
    """One binary RAWEPHEM."""
    week, rest = divmod(gps_ns, WEEK_NS)
    body = struct.pack("<III", prn, week, round(toe_s))
    body += b"".join(word.to_bytes(3, "big") for words in frames for word in words)
    head = struct.pack(
        "<3sBHBBHHBBHiIHH", b"\xaa\x44\x12", 28, 41, 0, 0x20, len(body), 0, 0, 180, week,
        rest // 1_000_000, 0, 0, 0,
    )  # fmt: skip
    data = head + body
    return data + struct.pack("<I", zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF)


def gps_raw_ca(prn: int, gps_ns: int, words: list[int]) -> bytes:
    """One GPSRawCA with right parity."""
    week, rest = divmod(gps_ns, WEEK_NS)
    content = struct.pack("<IH6B", rest // 1_000_000, week, prn, 1, 0, 0, 0, 1)
    content += struct.pack("<10I", *(word << 6 | 0x15 for word in words))
    checked = struct.pack("<HH", 4017, 8 + len(content)) + content
    return b"$@" + struct.pack("<H", binascii.crc_hqx(checked, 0)) + checked
