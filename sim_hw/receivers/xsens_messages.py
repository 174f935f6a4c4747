"""MTData2 messages of an Xsens MTi as bytes.

Written from Xsens' MT Low-Level Communication Protocol Documentation, document MT0101P; when they
are sent is in `xsens_receiver`.
"""

from __future__ import annotations

import struct
from datetime import UTC, datetime

from sim_hw.receivers.emulated_receiver import ReceiverAccuracy, ReceiverState
from sim_hw.receivers.nmea_sentences import GEOID_UNDULATION_M
from sim_hw.world.world_clock import NS_PER_S, gps_week_and_tow_ns, unix_ns_from_gps_ns

UTC_TIME, SAMPLE_TIME_FINE, TRIGGER_IN_1, GNSS_PVT, STATUS_WORD = (
    0x1010,
    0x1060,
    0x4810,
    0x7010,
    0xE020,
)
EULER_ANGLES, ALTITUDE, LAT_LON, VELOCITY = 0x2030, 0x5020, 0x5040, 0xD010
FIXED_POINT_16_32, NORTH_EAST_DOWN = 0x2, 0x4
RISING, FALLING = 1, 2
UTC_RESOLVED = 7
"""Date and time of day valid, UTC fully resolved."""
NAVIGATING = 3 << 23 | 1 << 2 | 1 << 1
"""Filter mode "with GNSS", GNSS fix, filter valid."""
FIX_3D = 3
TICK_NS = 100_000
_MTDATA2 = b"\xff\x36"

Datum = tuple[int, bytes]


def message(*data: Datum) -> bytes:
    """A message: preamble, bus, kind, length (extended from 255 bytes on), data, checksum."""
    body = b"".join(struct.pack(">HB", kind, len(content)) + content for kind, content in data)
    length = bytes([len(body)]) if len(body) < 255 else b"\xff" + struct.pack(">H", len(body))
    covered = _MTDATA2 + length + body
    return b"\xfa" + covered + bytes([-sum(covered) & 0xFF])


def fixed_point(*numbers: float) -> bytes:
    """Numbers in fixed point 16.32: the fraction first, then the signed whole number."""
    parts = (divmod(round(number * (1 << 32)), 1 << 32) for number in numbers)
    return b"".join(struct.pack(">Ih", fraction, whole) for whole, fraction in parts)


def utc_time(gps_ns: int, leap_seconds: int, flags: int = UTC_RESOLVED) -> Datum:
    """UtcTime: date and time of day with nanoseconds."""
    seconds, nano = divmod(unix_ns_from_gps_ns(gps_ns, leap_seconds), NS_PER_S)
    utc = datetime.fromtimestamp(seconds, UTC)
    return UTC_TIME, struct.pack(
        ">IH6B", nano, utc.year, utc.month, utc.day, utc.hour, utc.minute, utc.second, flags
    )


def sample_time_fine(ticks: int) -> Datum:
    """SampleTimeFine: ticks of 0.1 ms since the unit was switched on, 32 bits."""
    return SAMPLE_TIME_FINE, struct.pack(">I", ticks % (1 << 32))


def trigger_in(ticks: int, polarity: int, frame_number: int) -> Datum:
    """TriggerIn1: line, polarity, ticks of 0.1 ms, number of the frame."""
    return TRIGGER_IN_1, struct.pack(">BBIH", 1, polarity, ticks % (1 << 32), frame_number & 0xFFFF)


def status_word(status: int = NAVIGATING) -> Datum:
    """StatusWord."""
    return STATUS_WORD, struct.pack(">I", status)


def navigation(state: ReceiverState) -> tuple[Datum, ...]:
    """Attitude, height, place and velocity of the filter, in fixed point, north, east, down."""
    yaw_deg = (state.heading_deg + 180.0) % 360.0 - 180.0
    form = FIXED_POINT_16_32 | NORTH_EAST_DOWN
    return (
        (EULER_ANGLES | form, fixed_point(state.roll_deg, state.pitch_deg, yaw_deg)),
        (ALTITUDE | form, fixed_point(state.height_m)),
        (LAT_LON | form, fixed_point(state.latitude_deg, state.longitude_deg)),
        (VELOCITY | form, fixed_point(*state.velocity_ned_mps)),
    )


def gnss_pvt(
    gps_ns: int,
    state: ReceiverState,
    accuracy: ReceiverAccuracy,
    satellites: int,
    leap_seconds: int,
) -> Datum:
    """GnssPvtData: time of week and UTC, place and velocity of the GNSS receiver, deviations."""
    _, tow_ns = gps_week_and_tow_ns(gps_ns)
    seconds, nano = divmod(unix_ns_from_gps_ns(gps_ns, leap_seconds), NS_PER_S)
    utc = datetime.fromtimestamp(seconds, UTC)
    north, east, down = state.velocity_ned_mps
    content = struct.pack(
        ">IH6BIi4B4iII3iIiIIi7H",
        *(tow_ns // 1_000_000, utc.year, utc.month, utc.day, utc.hour, utc.minute, utc.second),
        *(UTC_RESOLVED, accuracy.time_ns, nano, FIX_3D, 1, satellites, 0),
        *(round(state.longitude_deg * 1e7), round(state.latitude_deg * 1e7)),
        *(round(state.height_m * 1e3), round((state.height_m - GEOID_UNDULATION_M) * 1e3)),
        *(round(accuracy.horizontal_m * 1e3), round(accuracy.vertical_m * 1e3)),
        *(round(north * 1e3), round(east * 1e3), round(down * 1e3)),
        *(round((north**2 + east**2) ** 0.5 * 1e3), round(state.heading_deg * 1e5)),
        *(round(accuracy.speed_mps * 1e3), round(accuracy.heading_deg * 1e5)),
        round(state.heading_deg * 1e5),
        *(120,) * 7,
    )
    return GNSS_PVT, content
