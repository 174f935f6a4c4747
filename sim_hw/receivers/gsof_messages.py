"""GSOF records of a Trimble receiver as bytes, in report packets 40h.

Written from Trimble's OEM GNSS receiver help, pages "GSOF messages"; when they are sent is in
`gsof_receiver`.
"""

from __future__ import annotations

import math
import struct

from sim_hw.receivers.emulated_receiver import ReceiverAccuracy, ReceiverState
from sim_hw.world.world_clock import NS_PER_S, gps_week_and_tow_ns

TIME, LLH, VELOCITY, SIGMA, UTC, INS_NAVIGATION, INS_RMS, EVENT_MARKER = 1, 2, 8, 12, 16, 49, 50, 51
POSITION_FLAGS = 0b0001_1111
"""New position, clock fix, horizontal place and height computed, the bit that is always set."""
RTK_FIXED_FLAGS = 0b0000_0111
VELOCITY_AND_TRACK_VALID = 0b101
TIME_AND_OFFSET_VALID = 0b11
FULL_NAVIGATION, QUALITY_RTK_FIXED = 4, 4
PAGE_MAX_NBYTES = 0xFA - 3
_STATUS, _GENOUT = 0x08, 0x40


def record(number: int, body: bytes) -> bytes:
    """A record: type, length, body."""
    return bytes((number, len(body))) + body


def transmission(number: int, records: bytes, page_nbytes: int = PAGE_MAX_NBYTES) -> bytes:
    """Packets of a transmission; a page may end in the middle of a record."""
    pages = [records[at : at + page_nbytes] for at in range(0, len(records), page_nbytes)]
    packets = b""
    for index, page in enumerate(pages):
        data = bytes((number & 0xFF, index, len(pages) - 1)) + page
        covered = bytes((_STATUS, _GENOUT, len(data))) + data
        packets += b"\x02" + covered + bytes((sum(covered) & 0xFF, 0x03))
    return packets


def _week_and_ms(gps_ns: int) -> tuple[int, int]:
    week, tow_ns = gps_week_and_tow_ns(gps_ns)
    return week, tow_ns // 1_000_000


def time(gps_ns: int, satellites: int, flags: int = POSITION_FLAGS) -> bytes:
    """Record 1: time, satellites and flags of the position."""
    week, ms = _week_and_ms(gps_ns)
    return record(TIME, struct.pack(">IHBBBB", ms, week, satellites, flags, RTK_FIXED_FLAGS, 1))


def llh(state: ReceiverState) -> bytes:
    """Record 2: latitude and longitude in radians, height above the ellipsoid."""
    place = math.radians(state.latitude_deg), math.radians(state.longitude_deg), state.height_m
    return record(LLH, struct.pack(">3d", *place))


def velocity(state: ReceiverState) -> bytes:
    """Record 8: horizontal speed, track in radians, speed upwards."""
    north, east, down = state.velocity_ned_mps
    numbers = math.hypot(north, east), math.atan2(east, north) % math.tau, -down
    return record(VELOCITY, struct.pack(">B3f", VELOCITY_AND_TRACK_VALID, *numbers))


def sigma(accuracy: ReceiverAccuracy) -> bytes:
    """Record 12: RMS, sigmas east, north, covariance, up, error ellipse, variance, epochs."""
    side_m = accuracy.horizontal_m / math.sqrt(2.0)
    numbers = (1.0, side_m, side_m, 0.0, accuracy.vertical_m, side_m, side_m, 0.0, 1.0)
    return record(SIGMA, struct.pack(">9fH", *numbers, 1))


def utc(gps_ns: int, leap_seconds: int) -> bytes:
    """Record 16: GPS time and its offset from UTC."""
    week, ms = _week_and_ms(gps_ns)
    return record(UTC, struct.pack(">IHhB", ms, week, leap_seconds, TIME_AND_OFFSET_VALID))


def ins_navigation(gps_ns: int, state: ReceiverState) -> bytes:
    """Record 49: place, velocity, attitude, track, rates and accelerations of the solution."""
    week, ms = _week_and_ms(gps_ns)
    north, east, _ = state.velocity_ned_mps
    body = struct.pack(">HIBB", week, ms, FULL_NAVIGATION, QUALITY_RTK_FIXED)
    body += struct.pack(">3d", state.latitude_deg, state.longitude_deg, state.height_m)
    body += struct.pack(">4f", *state.velocity_ned_mps, math.hypot(*state.velocity_ned_mps))
    track_deg = math.degrees(math.atan2(east, north)) % 360.0
    body += struct.pack(">4d", state.roll_deg, state.pitch_deg, state.heading_deg, track_deg)
    return record(INS_NAVIGATION, body + bytes(24))


def ins_rms(gps_ns: int, accuracy: ReceiverAccuracy) -> bytes:
    """Record 50: RMS of place, velocity and attitude of the solution."""
    week, ms = _week_and_ms(gps_ns)
    side_m, speed = accuracy.horizontal_m / 2**0.5, accuracy.speed_mps / 3**0.5
    tilt, heading = accuracy.roll_pitch_deg, accuracy.heading_deg
    numbers = (side_m, side_m, accuracy.vertical_m, *(speed,) * 3, tilt, tilt, heading)
    head = struct.pack(">HIBB", week, ms, FULL_NAVIGATION, QUALITY_RTK_FIXED)
    return record(INS_RMS, head + struct.pack(">9f", *numbers))


def event_marker(gps_ns: int, number: int, port: int = 1) -> bytes:
    """Record 51: port, time in seconds of the week, number of the event."""
    week, tow_ns = gps_week_and_tow_ns(gps_ns)
    return record(
        EVENT_MARKER, struct.pack(">BHdI", port, week, tow_ns / NS_PER_S, number & 0xFFFF)
    )
