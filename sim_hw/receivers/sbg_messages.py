"""Logs of an SBG inertial unit as bytes: sbgECom frames of class 0.

Written from SBG Systems' sbgECom binary messages reference, version 5; when they are sent is in
`sbg_receiver`.
"""

from __future__ import annotations

import math
import struct
from datetime import UTC, datetime

from sim_hw.receivers.emulated_receiver import ReceiverAccuracy, ReceiverState
from sim_hw.receivers.nmea_sentences import GEOID_UNDULATION_M
from sim_hw.world.world_clock import NS_PER_S, gps_week_and_tow_ns, unix_ns_from_gps_ns

UTC_TIME, EKF_EULER, EKF_QUAT, EKF_NAV, GPS1_POS, EVENT_A = 2, 6, 7, 8, 14, 24
CLOCK_FREE_RUNNING, CLOCK_STEERING, CLOCK_VALID = 1, 2, 3
UTC_INVALID, UTC_NO_LEAP_SECONDS, UTC_VALID = 0, 1, 2
NOMINAL_SOLUTION = 4 | 1 << 4 | 1 << 5 | 1 << 6 | 1 << 7 | 1 << 10 | 1 << 11
"""Mode "position", attitude, heading, velocity and position valid, GNSS velocity and position
used."""
RTK_INTEGER = 7 << 6
_US_PER_WRAP = 1 << 32


def crc16(data: bytes) -> int:
    """The 16-bit CRC of the protocol: polynomial 0x8408, least significant bit first, from 0."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0x8408 if crc & 1 else crc >> 1
    return crc


def frame(identity: int, stamp_us: int, body: bytes) -> bytes:
    """A frame: sync, log and class, length, time stamp and body, CRC, end."""
    payload = struct.pack("<I", stamp_us % _US_PER_WRAP) + body
    covered = struct.pack("<BBH", identity, 0, len(payload)) + payload
    return b"\xff\x5a" + covered + struct.pack("<H", crc16(covered)) + b"\x33"


def utc_time(
    stamp_us: int,
    gps_ns: int,
    leap_seconds: int,
    clock: int = CLOCK_VALID,
    utc_status: int = UTC_VALID,
) -> bytes:
    """UTC_TIME: what GPS time and UTC a time stamp is, and how far both can be trusted."""
    seconds, nano = divmod(unix_ns_from_gps_ns(gps_ns, leap_seconds), NS_PER_S)
    utc = datetime.fromtimestamp(seconds, UTC)
    _, tow_ns = gps_week_and_tow_ns(gps_ns)
    status = 1 | clock << 1 | 1 << 5 | utc_status << 6
    body = struct.pack(
        "<HH5biI", status, utc.year, utc.month, utc.day, utc.hour, utc.minute, utc.second,
        nano, tow_ns // 1_000_000,
    )  # fmt: skip
    # Bias, scale factor and residual of the clock, which later firmware appends.
    return frame(UTC_TIME, stamp_us, body + struct.pack("<3f", 1e-9, 1e-9, 1e-9))


def ekf_euler(
    stamp_us: int, state: ReceiverState, accuracy: ReceiverAccuracy, status: int = NOMINAL_SOLUTION
) -> bytes:
    """EKF_EULER: roll, pitch and yaw (-pi to pi) with their standard deviations, rad."""
    yaw_deg = (state.heading_deg + 180.0) % 360.0 - 180.0
    angles = (math.radians(a) for a in (state.roll_deg, state.pitch_deg, yaw_deg))
    tilt, heading = math.radians(accuracy.roll_pitch_deg), math.radians(accuracy.heading_deg)
    return frame(EKF_EULER, stamp_us, struct.pack("<6fI", *angles, tilt, tilt, heading, status))


def ekf_nav(
    stamp_us: int, state: ReceiverState, accuracy: ReceiverAccuracy, status: int = NOMINAL_SOLUTION
) -> bytes:
    """EKF_NAV: velocity, position with the height above sea level, undulation, deviations."""
    side_m = accuracy.horizontal_m / math.sqrt(2.0)
    body = struct.pack(
        "<6f3d4fI",
        *state.velocity_ned_mps,
        *(accuracy.speed_mps / math.sqrt(3.0),) * 3,
        state.latitude_deg,
        state.longitude_deg,
        state.height_m - GEOID_UNDULATION_M,
        GEOID_UNDULATION_M,
        side_m,
        side_m,
        accuracy.vertical_m,
        status,
    )
    return frame(EKF_NAV, stamp_us, body)


def gps1_pos(
    stamp_us: int, gps_ns: int, state: ReceiverState, accuracy: ReceiverAccuracy, satellites: int
) -> bytes:
    """GPS1_POS: position of the GNSS receiver in the unit, and its satellites."""
    _, tow_ns = gps_week_and_tow_ns(gps_ns)
    body = struct.pack(
        "<2I3d4fBHH",
        RTK_INTEGER,
        tow_ns // 1_000_000,
        state.latitude_deg,
        state.longitude_deg,
        state.height_m - GEOID_UNDULATION_M,
        GEOID_UNDULATION_M,
        accuracy.horizontal_m,
        accuracy.horizontal_m,
        accuracy.vertical_m,
        satellites,
        0xFFFF,
        0xFFFF,
    )
    return frame(GPS1_POS, stamp_us, body)


def event(
    stamp_us: int, later_us: tuple[int, ...] = (), channel: int = 1, status: int = 0
) -> bytes:
    """EVENT_A to EVENT_E: an event and up to four later ones, by their offsets from it."""
    for number in range(len(later_us)):
        status |= 2 << number
    offsets = (*later_us, 0, 0, 0, 0)[:4]
    return frame(EVENT_A - 1 + channel, stamp_us, struct.pack("<5H", status, *offsets))


def stamp_us(elapsed_ns: int, at_start_us: int) -> int:
    """Time stamp of an instant, by the time since the world began, to the nearest us."""
    return (at_start_us + (elapsed_ns + 500) // 1000) % _US_PER_WRAP
