"""SBF blocks of a Septentrio receiver as bytes.

Written from the mosaic-X5 reference guide, firmware 4.14, chapter 4 ("SBF reference"); when they
are sent is in `septentrio_receiver`. Angles of position are in radians, of attitude in degrees.
"""

from __future__ import annotations

import math
import struct
from datetime import UTC, datetime

from sim_hw.receivers.emulated_receiver import ReceiverAccuracy, ReceiverState
from sim_hw.receivers.nmea_sentences import GEOID_UNDULATION_M, course_deg, longitude_deg
from sim_hw.world.world_clock import NS_PER_S, gps_week_and_tow_ns, unix_ns_from_gps_ns

DO_NOT_USE = -2e10
RTK_FIXED = 4
GPS_TIME = 0
WGS84 = 0
RISING, FALLING = 0, 1

_NS_PER_MS = 1_000_000


def crc16_ccitt(data: bytes) -> int:
    """CRC-16-CCITT, polynomial x^16 + x^12 + x^5 + 1, beginning with 0."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1
        crc &= 0xFFFF
    return crc


def block(number: int, revision: int, rx_ns: int, body: bytes) -> bytes:
    """A block: `$@`, CRC, id with revision, length (a multiple of 4), TOW, WNc, body, padding.

    `rx_ns` is the time stamp in the receiver's time, GPS weeks never rolled over.
    """
    week, tow_ns = gps_week_and_tow_ns(rx_ns)
    body = struct.pack("<IH", tow_ns // _NS_PER_MS, week) + body
    body += bytes(-len(body) % 4)
    checked = struct.pack("<HH", number | revision << 13, 8 + len(body)) + body
    return b"$@" + struct.pack("<H", crc16_ccitt(checked)) + checked


def pvt_geodetic(
    rx_ns: int, bias_ns: int, state: ReceiverState, accuracy: ReceiverAccuracy, satellites: int
) -> bytes:
    """PVTGeodetic (4007), revision 2. `bias_ns` is receiver time minus GPS time."""
    north, east, down = state.velocity_ned_mps
    body = struct.pack(
        "<BBdddfffffdfBBBBHHIBBHHHHB",
        RTK_FIXED,
        0,  # no error
        math.radians(state.latitude_deg),
        math.radians(longitude_deg(state.longitude_deg)),
        state.height_m,
        GEOID_UNDULATION_M,
        north,
        east,
        -down,
        course_deg(state),
        bias_ns / _NS_PER_MS,
        0.2,  # ppm
        GPS_TIME,
        WGS84,
        satellites,
        0,
        1,  # reference station
        100,  # 1.00 s old corrections
        0,
        0,
        1,  # one base
        0,
        150,  # 15 ms of latency
        round(accuracy.horizontal_m * 2 * 100),
        round(accuracy.vertical_m * 2 * 100),
        0,
    )
    return block(4007, 2, rx_ns, body)


def pos_cov_geodetic(rx_ns: int, accuracy: ReceiverAccuracy) -> bytes:
    """PosCovGeodetic (5906): half the horizontal variance in latitude, half in longitude."""
    axis = accuracy.horizontal_m**2 / 2
    variances = (axis, axis, accuracy.vertical_m**2, 0.01)
    return block(5906, 0, rx_ns, struct.pack("<BB10f", RTK_FIXED, 0, *variances, *[0.0] * 6))


def vel_cov_geodetic(rx_ns: int, accuracy: ReceiverAccuracy) -> bytes:
    """VelCovGeodetic (5908): a third of the variance of speed on each axis."""
    axis = accuracy.speed_mps**2 / 3
    body = struct.pack("<BB10f", RTK_FIXED, 0, axis, axis, axis, 1e-4, *[0.0] * 6)
    return block(5908, 0, rx_ns, body)


def dop(rx_ns: int, satellites: int) -> bytes:
    """DOP (4001), in hundredths; protection levels are not available."""
    body = struct.pack("<BB4H2f", satellites, 0, 120, 60, 80, 90, DO_NOT_USE, DO_NOT_USE)
    return block(4001, 0, rx_ns, body)


def att_euler(rx_ns: int, state: ReceiverState, satellites: int) -> bytes:
    """AttEuler (5938) of three antennas: heading, pitch, roll; rates are not computed."""
    three_antennas_fixed = 4
    body = struct.pack(
        "<BBHBBffffff",
        satellites,
        0,
        three_antennas_fixed,
        0,
        0,
        state.heading_deg % 360.0,
        state.pitch_deg,
        state.roll_deg,
        *[DO_NOT_USE] * 3,
    )
    return block(5938, 0, rx_ns, body)


def end_of_pvt(rx_ns: int) -> bytes:
    """EndOfPVT (5921)."""
    return block(5921, 0, rx_ns, b"")


def receiver_time(rx_ns: int, leap_seconds: int) -> bytes:
    """ReceiverTime (5914): UTC to the second, leap seconds, and that time is fine."""
    utc = datetime.fromtimestamp(unix_ns_from_gps_ns(rx_ns, leap_seconds) // NS_PER_S, UTC)
    week_tow_and_fine_time = 0x07
    body = struct.pack(
        "<7bB",
        utc.year % 100,
        utc.month,
        utc.day,
        utc.hour,
        utc.minute,
        utc.second,
        leap_seconds,
        week_tow_and_fine_time,
    )
    return block(5914, 0, rx_ns, body)


def ext_event(rx_ns: int, bias_ns: int, *, source: int, polarity: int) -> bytes:
    """ExtEvent (5924), revision 1: an edge at receiver time `rx_ns`, to parts of a nanosecond."""
    integer_ns = rx_ns // _NS_PER_MS * _NS_PER_MS
    body = struct.pack(
        "<BBfdH", source, polarity, (rx_ns - integer_ns) / NS_PER_S, bias_ns / NS_PER_S, 0
    )
    return block(5924, 1, integer_ns, body)


def ext_event_pvt_geodetic(
    rx_ns: int, bias_ns: int, state: ReceiverState, accuracy: ReceiverAccuracy, satellites: int
) -> bytes:
    """ExtEventPVTGeodetic (4038): a PVTGeodetic of the edge, stamped as its ExtEvent."""
    integer_ns = rx_ns // _NS_PER_MS * _NS_PER_MS
    same = pvt_geodetic(integer_ns, bias_ns, state, accuracy, satellites)
    return block(4038, 2, integer_ns, same[14:])
