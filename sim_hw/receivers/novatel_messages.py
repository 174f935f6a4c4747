"""Logs of a NovAtel OEM7 receiver with SPAN as bytes, binary with long headers.

Written from NovAtel's OEM7 Commands and Logs Reference Manual, OM-20000169; when they are sent is
in `novatel_receiver`.
"""

from __future__ import annotations

import math
import struct
from datetime import UTC, datetime

from sim_hw.receivers.emulated_receiver import ReceiverAccuracy, ReceiverState
from sim_hw.receivers.nmea_sentences import GEOID_UNDULATION_M, course_deg, longitude_deg, speed_mps
from sim_hw.world.world_clock import NS_PER_S, gps_week_and_tow_ns, unix_ns_from_gps_ns

HEADER_NBYTES = 28
COM1 = 32
FINESTEERING = 180
SOLUTION_COMPUTED = 0
NARROW_INTEGER, INS_RTK_FIXED = 50, 56
INS_SOLUTION_GOOD = 3
WGS84 = 61
CLOCK_VALID, UTC_VALID = 0, 1
MARK_TIME = {1: 1130, 2: 616, 3: 1075, 4: 1076}
MARK_PVA = {1: 1067, 2: 1068, 3: 1118, 4: 1119}
_NS_PER_MS = 1_000_000


def crc32(data: bytes) -> int:
    """The 32-bit CRC of the manual's section on message formats: 0xEDB88320, beginning with 0."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xEDB88320 if crc & 1 else crc >> 1
    return crc


def log(identity: int, gps_ns: int, body: bytes) -> bytes:
    """A log: sync, header with the time of its data, body and CRC."""
    week, tow_ns = gps_week_and_tow_ns(gps_ns)
    head = struct.pack(
        "<3sBHBBHHBBHiIHH",
        b"\xaa\x44\x12",
        HEADER_NBYTES,
        identity,
        0,  # binary, original message
        COM1,
        len(body),
        0,
        120,  # 60 % idle
        FINESTEERING,
        week,
        tow_ns // _NS_PER_MS,
        0,
        0,
        16_000,
    )
    return head + body + struct.pack("<I", crc32(head + body))


def bestpos(
    gps_ns: int, state: ReceiverState, accuracy: ReceiverAccuracy, satellites: int
) -> bytes:
    """BESTPOS (42): height above the geoid, and the undulation."""
    axis = accuracy.horizontal_m / math.sqrt(2.0)
    body = struct.pack(
        "<II3dfI3f4sff8B",
        SOLUTION_COMPUTED,
        NARROW_INTEGER,
        state.latitude_deg,
        longitude_deg(state.longitude_deg),
        state.height_m - GEOID_UNDULATION_M,
        GEOID_UNDULATION_M,
        WGS84,
        axis,
        axis,
        accuracy.vertical_m,
        b"0001",
        1.0,
        0.0,
        satellites + 2,
        satellites,
        satellites,
        satellites,
        0,
        0,
        0,
        0,
    )
    return log(42, gps_ns, body)


def bestvel(gps_ns: int, state: ReceiverState) -> bytes:
    """BESTVEL (99): speed over ground, track, upward speed."""
    narrow_integer_from_doppler = 50
    body = struct.pack(
        "<II2f3df",
        SOLUTION_COMPUTED,
        narrow_integer_from_doppler,
        0.0,
        1.0,
        speed_mps(state),
        course_deg(state),
        -state.velocity_ned_mps[2],
        0.0,
    )
    return log(99, gps_ns, body)


def time_log(gps_ns: int, leap_seconds: int) -> bytes:
    """TIME (101): clock and UTC; UTC = GPS + offset, so the offset is negative."""
    unix_ns = unix_ns_from_gps_ns(gps_ns, leap_seconds)
    utc = datetime.fromtimestamp(unix_ns // NS_PER_S, UTC)
    body = struct.pack(
        "<I3dIBBBBII",
        CLOCK_VALID,
        1e-9,
        1e-9,
        -float(leap_seconds),
        utc.year,
        utc.month,
        utc.day,
        utc.hour,
        utc.minute,
        utc.second * 1000 + unix_ns % NS_PER_S // _NS_PER_MS,
        UTC_VALID,
    )
    return log(101, gps_ns, body)


def inspvax(gps_ns: int, state: ReceiverState, accuracy: ReceiverAccuracy) -> bytes:
    """INSPVAX (1465): inertial solution with standard deviations; height above the geoid."""
    north, east, down = state.velocity_ned_mps
    axis = accuracy.horizontal_m / math.sqrt(2.0)
    speed_axis = accuracy.speed_mps / math.sqrt(3.0)
    body = struct.pack(
        "<II3df6d9fIH",
        INS_SOLUTION_GOOD,
        INS_RTK_FIXED,
        state.latitude_deg,
        longitude_deg(state.longitude_deg),
        state.height_m - GEOID_UNDULATION_M,
        GEOID_UNDULATION_M,
        north,
        east,
        -down,
        state.roll_deg,
        state.pitch_deg,
        state.heading_deg % 360.0,
        axis,
        axis,
        accuracy.vertical_m,
        speed_axis,
        speed_axis,
        speed_axis,
        accuracy.roll_pitch_deg,
        accuracy.roll_pitch_deg,
        accuracy.heading_deg,
        0x01,  # position updated
        0,
    )
    return log(1465, gps_ns, body)


def insatt(gps_ns: int, state: ReceiverState) -> bytes:
    """INSATT (263): attitude with its own week and seconds."""
    week, seconds = _week_and_seconds(gps_ns)
    body = struct.pack(
        "<I4dI",
        week,
        seconds,
        state.roll_deg,
        state.pitch_deg,
        state.heading_deg % 360.0,
        INS_SOLUTION_GOOD,
    )
    return log(263, gps_ns, body)


def mark_time(channel: int, gps_ns: int, offset_ns: int, leap_seconds: int) -> bytes:
    """MARKxTIME: the edge by the receiver's clock, which is `offset_ns` ahead of GPS time."""
    week, seconds = _week_and_seconds(gps_ns + offset_ns)
    body = struct.pack(
        "<I4dI", week, seconds, offset_ns * 1e-9, 5e-9, -float(leap_seconds), CLOCK_VALID
    )
    return log(MARK_TIME[channel], gps_ns, body)


def mark_pva(channel: int, gps_ns: int, state: ReceiverState) -> bytes:
    """MARKxPVA: GPS time of the edge, and the inertial solution for it; height is ellipsoidal."""
    week, seconds = _week_and_seconds(gps_ns)
    north, east, down = state.velocity_ned_mps
    body = struct.pack(
        "<I10dI",
        week,
        seconds,
        state.latitude_deg,
        longitude_deg(state.longitude_deg),
        state.height_m,
        north,
        east,
        -down,
        state.roll_deg,
        state.pitch_deg,
        state.heading_deg % 360.0,
        INS_SOLUTION_GOOD,
    )
    return log(MARK_PVA[channel], gps_ns, body)


def _week_and_seconds(gps_ns: int) -> tuple[int, float]:
    week, tow_ns = gps_week_and_tow_ns(gps_ns)
    return week, tow_ns / NS_PER_S
