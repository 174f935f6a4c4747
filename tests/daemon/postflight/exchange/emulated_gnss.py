"""A small GPS constellation, and what receivers measure of it: RXM-RAWX, RANGE, navigation file.

Satellites follow the broadcast ephemeris model (IS-GPS-200, table 20-IV) with the elements that the
navigation file states; signals travel in vacuum, clocks are perfect. Carrier phases have an
arbitrary whole number of cycles.
"""

from __future__ import annotations

import struct
import zlib
from datetime import UTC, datetime, timedelta

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


def rawx(at: np.ndarray, gps_ns: int, toe_s: float, noise: np.random.Generator) -> bytes:
    """One RXM-RAWX of GPS L1 C/A."""
    week, rest = divmod(gps_ns, WEEK_NS)
    tow_s = rest * 1e-9
    seen = ranges(at, tow_s, toe_s)
    later = ranges(at, tow_s + 0.5, toe_s)
    payload = struct.pack("<dHbBBB2x", tow_s, week, 18, len(seen), 1, 1)
    for prn, distance in seen.items():
        code, phase = distance + noise.normal(0, 0.05), distance * L1_HZ / C + 100_000 * prn
        doppler = -(later.get(prn, distance) - distance) / 0.5 * L1_HZ / C
        payload += struct.pack(
            "<ddfBBBBHBBBBBx", code, phase + noise.normal(0, 0.003), doppler, 0, prn, 0, 0,
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


def navigation_text(gps_ns: int, toe_s: float) -> str:
    """A RINEX 3.04 navigation file with the elements of all satellites."""
    week = gps_ns // WEEK_NS
    at = GPS_EPOCH + timedelta(seconds=week * 604_800 + toe_s)
    lines = [
        f"{'     3.04':<20}{'N: GNSS NAV DATA':<20}{'G: GPS':<20}RINEX VERSION / TYPE",
        f"{'emulated':<60}PGM / RUN BY / DATE",
        f"{'':<60}END OF HEADER",
    ]

    def row(*values: float) -> str:
        return "    " + "".join(f"{v:19.12e}" for v in values)

    for prn, (node, inclination, anomaly) in satellites().items():
        first = f"G{prn:02d} {at:%Y %m %d %H %M %S}" + "".join(f"{0.0:19.12e}" for _ in range(3))
        lines += [
            first,
            row(1.0, 0.0, 0.0, anomaly),
            row(0.0, 0.0, 0.0, SQRT_A),
            row(toe_s, 0.0, node, 0.0),
            row(inclination, 0.0, 0.0, 0.0),
            row(0.0, 0.0, float(week), 0.0),
            row(2.0, 0.0, 0.0, 1.0),
            row(toe_s, 4.0, 0.0, 0.0),
        ]
    return "\n".join(lines) + "\n"
