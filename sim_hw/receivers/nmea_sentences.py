"""NMEA 0183 sentences as bytes, as any receiver may send them.

Written from NMEA 0183 as published in gpsd's "NMEA Revealed", and Trimble's $PTNL,EVT; senders
and times are in the receivers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime

from sim_hw.receivers.emulated_receiver import ReceiverState
from sim_hw.world.world_clock import (
    LEAP_SECONDS,
    NS_PER_S,
    gps_week_and_tow_ns,
    unix_ns_from_gps_ns,
)

GEOID_UNDULATION_M = 46.0
"""Geoid above ellipsoid in the receiver's model; one value, plausible for Central Europe."""
_NS_PER_CS = 10_000_000
_NS_PER_US = 1_000


@dataclass(frozen=True)
class BrokenDownUtc:
    """UTC as u-blox splits it: rounded to 10 ms, and the signed rest in `nano`.

    Source: interface description, "UTC representation": nano lies in -5,000,000 .. 994,999,999.
    """

    year: int
    month: int
    day: int
    hour: int
    minute: int
    second: int
    nano: int
    centisecond: int


def broken_down_utc(gps_ns: int, leap_seconds: int = LEAP_SECONDS) -> BrokenDownUtc:
    """Split a GPS instant into UTC."""
    unix_ns = unix_ns_from_gps_ns(gps_ns, leap_seconds)
    rounded_cs = (unix_ns + _NS_PER_CS // 2) // _NS_PER_CS
    second, centisecond = divmod(rounded_cs, 100)
    utc = datetime.fromtimestamp(second, UTC)
    return BrokenDownUtc(
        utc.year,
        utc.month,
        utc.day,
        utc.hour,
        utc.minute,
        utc.second,
        unix_ns - second * NS_PER_S,
        centisecond,
    )


def nmea(sentence: str) -> bytes:
    """An NMEA sentence with its checksum, from the text between `$` and `*`."""
    checksum = 0
    for byte in sentence.encode("ascii"):
        checksum ^= byte
    return f"${sentence}*{checksum:02X}\r\n".encode("ascii")


def gga(
    gps_ns: int, state: ReceiverState, satellites: int, leap_seconds: int, *, quality: int = 1
) -> bytes:
    """GGA: fix, position and height above the geoid."""
    utc = broken_down_utc(gps_ns, leap_seconds)
    return nmea(
        f"GNGGA,{_clock(utc)},{_position(state)},{quality},{min(satellites, 12):02d},0.80,"
        f"{state.height_m - GEOID_UNDULATION_M:.1f},M,{GEOID_UNDULATION_M:.1f},M,,"
    )


def rmc(gps_ns: int, state: ReceiverState, leap_seconds: int) -> bytes:
    """RMC: position, speed over ground and date."""
    utc = broken_down_utc(gps_ns, leap_seconds)
    return nmea(
        f"GNRMC,{_clock(utc)},A,{_position(state)},{speed_mps(state) * 3600.0 / 1852.0:.3f},"
        f"{course_deg(state):.2f},{utc.day:02d}{utc.month:02d}{utc.year % 100:02d},,,A"
    )


def zda(gps_ns: int, leap_seconds: int) -> bytes:
    """ZDA: time and date with its century; local zone offset zero."""
    utc = broken_down_utc(gps_ns, leap_seconds)
    return nmea(f"GNZDA,{_clock(utc)},{utc.day:02d},{utc.month:02d},{utc.year:04d},00,00")


def vtg(state: ReceiverState) -> bytes:
    """VTG: course, and speed over ground in knots and km/h."""
    speed = speed_mps(state)
    return nmea(
        f"GNVTG,{course_deg(state):.2f},T,,M,{speed * 3600.0 / 1852.0:.3f},N,{speed * 3.6:.3f},K,A"
    )


def hdt(state: ReceiverState) -> bytes:
    """HDT: true heading."""
    return nmea(f"GNHDT,{state.heading_deg % 360.0:.3f},T")


def gst(gps_ns: int, horizontal_m: float, vertical_m: float, leap_seconds: int) -> bytes:
    """GST: standard deviations of north, east and height; the error ellipse is a circle."""
    axis = horizontal_m / math.sqrt(2.0)
    return nmea(
        f"GNGST,{_clock(broken_down_utc(gps_ns, leap_seconds))},"
        f"{axis:.3f},{axis:.3f},{axis:.3f},0.0,"
        f"{axis:.3f},{axis:.3f},{vertical_m:.3f}"
    )


def pashr(
    gps_ns: int,
    state: ReceiverState,
    tilt_sigma_deg: float,
    heading_sigma_deg: float,
    leap_seconds: int,
) -> bytes:
    """PASHR: heading, roll and pitch with their standard deviations, of inertial systems."""
    return nmea(
        f"PASHR,{_clock(broken_down_utc(gps_ns, leap_seconds))},{state.heading_deg % 360.0:.3f},T,"
        f"{state.roll_deg:+.3f},{state.pitch_deg:+.3f},+0.00,"
        f"{tilt_sigma_deg:.3f},{tilt_sigma_deg:.3f},{heading_sigma_deg:.3f},2,1"
    )


def ptnl_event(gps_ns: int, number: int, leap_seconds: int, *, channel: int = 1) -> bytes:
    """$PTNL,EVT: UTC of an edge to 1 us, input, count, GPS week and its day, leap seconds.

    Week and day are those of the UTC date.
    """
    utc_us = (gps_ns - leap_seconds * NS_PER_S + _NS_PER_US // 2) // _NS_PER_US
    week, tow_ns = gps_week_and_tow_ns(utc_us * _NS_PER_US)
    day, of_day_ns = divmod(tow_ns, 86_400 * NS_PER_S)
    seconds, rest_ns = divmod(of_day_ns, NS_PER_S)
    clock = f"{seconds // 3600:02d}{seconds // 60 % 60:02d}{seconds % 60:02d}"
    return nmea(
        f"PTNL,EVT,{clock}.{rest_ns // _NS_PER_US:06d},{channel},{number % 65_536},"
        f"{week},{day},{leap_seconds}"
    )


def speed_mps(state: ReceiverState) -> float:
    north, east, _ = state.velocity_ned_mps
    return math.hypot(north, east)


def course_deg(state: ReceiverState) -> float:
    north, east, _ = state.velocity_ned_mps
    return math.degrees(math.atan2(east, north)) % 360.0


def longitude_deg(degrees: float) -> float:
    """Within -180 to 180."""
    return degrees if -180.0 <= degrees < 180.0 else (degrees + 180.0) % 360.0 - 180.0


def _clock(utc: BrokenDownUtc) -> str:
    return f"{utc.hour:02d}{utc.minute:02d}{utc.second:02d}.{utc.centisecond:02d}"


def _position(state: ReceiverState) -> str:
    latitude, longitude = state.latitude_deg, longitude_deg(state.longitude_deg)
    return (
        f"{_degrees_minutes(latitude, 2)},{'N' if latitude >= 0 else 'S'},"
        f"{_degrees_minutes(longitude, 3)},{'E' if longitude >= 0 else 'W'}"
    )


def _degrees_minutes(degrees: float, width: int) -> str:
    # In units of the last digit first, so that 59.999996 minutes become a whole degree.
    units = round(abs(degrees) * 60.0 * 1e5)
    degrees_minutes, rest = divmod(units, 60 * 100_000)
    return f"{degrees_minutes:0{width}d}{rest / 1e5:08.5f}"
