"""Messages of a u-blox receiver as bytes: UBX frames and NMEA sentences.

Written from the interface descriptions of u-blox 8/M8 (UBX-13003221) and F9 HPS (UBX-19056845);
when they are sent is in `ublox_receiver`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from sim_hw.world_clock import (
    LEAP_SECONDS,
    NS_PER_S,
    NS_PER_WEEK,
    gps_week_and_tow_ns,
    unix_ns_from_gps_ns,
)

GEOID_UNDULATION_M = 46.0
"""Geoid above ellipsoid where the receiver says it is; one value, plausible for Central Europe."""

_NS_PER_MS = 1_000_000
_NS_PER_CS = 10_000_000


@dataclass(frozen=True)
class ReceiverState:
    """What the receiver says of itself at one instant.

    Geographic coordinates in WGS 84, height above the ellipsoid, velocity north, east, down.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float
    velocity_ned_mps: tuple[float, float, float]
    roll_deg: float
    pitch_deg: float
    heading_deg: float


@dataclass(frozen=True)
class ReceiverAccuracy:
    """What the receiver believes of its own standard deviations."""

    horizontal_m: float = 0.02
    vertical_m: float = 0.03
    speed_mps: float = 0.03
    roll_pitch_deg: float = 0.02
    heading_deg: float = 0.05
    time_ns: int = 20
    mark_ns: int = 25


@dataclass(frozen=True)
class Satellite:
    """One satellite of NAV-SAT."""

    gnss_id: int
    number: int
    cno_dbhz: int
    elevation_deg: int
    azimuth_deg: int


@dataclass(frozen=True)
class UtcFields:
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


def utc_fields(gps_ns: int, leap_seconds: int = LEAP_SECONDS) -> UtcFields:
    """Split a GPS instant into UTC."""
    unix_ns = unix_ns_from_gps_ns(gps_ns, leap_seconds)
    rounded_cs = (unix_ns + _NS_PER_CS // 2) // _NS_PER_CS
    second, centisecond = divmod(rounded_cs, 100)
    utc = datetime.fromtimestamp(second, UTC)
    return UtcFields(
        utc.year,
        utc.month,
        utc.day,
        utc.hour,
        utc.minute,
        utc.second,
        unix_ns - second * NS_PER_S,
        centisecond,
    )


def itow_ms(gps_ns: int) -> int:
    """GPS time of week in whole ms, rounded; what every NAV message of an epoch carries."""
    _, tow_ns = gps_week_and_tow_ns(gps_ns)
    return (tow_ns + _NS_PER_MS // 2) // _NS_PER_MS % (NS_PER_WEEK // _NS_PER_MS)


def ubx(message_class: int, message_id: int, payload: bytes) -> bytes:
    """A UBX frame: sync characters, class, id, length, payload and Fletcher-8 checksum."""
    body = struct.pack("<BBH", message_class, message_id, len(payload)) + payload
    a = b = 0
    for byte in body:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    return b"\xb5\x62" + body + bytes((a, b))


def nmea(sentence: str) -> bytes:
    """An NMEA sentence with its checksum, from the text between `$` and `*`."""
    checksum = 0
    for byte in sentence.encode("ascii"):
        checksum ^= byte
    return f"${sentence}*{checksum:02X}\r\n".encode("ascii")


def nav_pvt(
    gps_ns: int,
    state: ReceiverState,
    accuracy: ReceiverAccuracy,
    satellites: int,
    leap_seconds: int,
) -> bytes:
    """UBX-NAV-PVT, 92 bytes: position, velocity, time."""
    utc = utc_fields(gps_ns, leap_seconds)
    north, east, down = state.velocity_ned_mps
    valid_date_time_resolved = 0x07
    fix_3d = 3
    fix_ok_and_vehicle_heading = 0x01 | 0x20
    confirmed_date_and_time = 0xE0
    payload = struct.pack(
        "<IHBBBBBBIiBBBBiiiiIIiiiiiIIHHIihH",
        itow_ms(gps_ns),
        utc.year,
        utc.month,
        utc.day,
        utc.hour,
        utc.minute,
        utc.second,
        valid_date_time_resolved,
        accuracy.time_ns,
        utc.nano,
        fix_3d,
        fix_ok_and_vehicle_heading,
        confirmed_date_and_time,
        satellites,
        round(_longitude(state.longitude_deg) * 1e7),
        round(state.latitude_deg * 1e7),
        _mm(state.height_m),
        _mm(state.height_m - GEOID_UNDULATION_M),
        _mm(accuracy.horizontal_m),
        _mm(accuracy.vertical_m),
        _mm(north),
        _mm(east),
        _mm(down),
        _mm(math.hypot(north, east)),
        round(math.degrees(math.atan2(east, north)) % 360.0 * 1e5),
        _mm(accuracy.speed_mps),
        round(accuracy.heading_deg * 1e5),
        120,  # pDOP 1.2
        0,
        0,
        round(state.heading_deg % 360.0 * 1e5),
        0,
        0,
    )
    return ubx(0x01, 0x07, payload)


def nav_att(gps_ns: int, state: ReceiverState, accuracy: ReceiverAccuracy) -> bytes:
    """UBX-NAV-ATT, 32 bytes: roll, pitch and heading of the vehicle."""
    tilt_accuracy = round(accuracy.roll_pitch_deg * 1e5)
    payload = struct.pack(
        "<IB3xiiiIII",
        itow_ms(gps_ns),
        0,
        round(state.roll_deg * 1e5),
        round(state.pitch_deg * 1e5),
        round(state.heading_deg % 360.0 * 1e5),
        tilt_accuracy,
        tilt_accuracy,
        round(accuracy.heading_deg * 1e5),
    )
    return ubx(0x01, 0x05, payload)


def nav_timegps(gps_ns: int, accuracy: ReceiverAccuracy, leap_seconds: int) -> bytes:
    """UBX-NAV-TIMEGPS, 16 bytes: the epoch on the GPS scale, to the nanosecond."""
    itow = itow_ms(gps_ns)
    # iTOW is rounded, so the rest may be negative and the week is that of the rounded time.
    week = (gps_ns + _NS_PER_MS // 2) // NS_PER_WEEK
    rest_ns = gps_ns - week * NS_PER_WEEK - itow * _NS_PER_MS
    tow_week_leap_valid = 0x07
    payload = struct.pack(
        "<IihbBI", itow, rest_ns, week, leap_seconds, tow_week_leap_valid, accuracy.time_ns
    )
    return ubx(0x01, 0x20, payload)


def nav_timels(gps_ns: int, leap_seconds: int) -> bytes:
    """UBX-NAV-TIMELS, 24 bytes: leap seconds, and that no change is announced."""
    from_gps = 2
    no_change_announced = 0
    current_leap_seconds_valid = 0x01
    payload = struct.pack(
        "<IB3xBbBbiHH3xB",
        itow_ms(gps_ns),
        0,
        from_gps,
        leap_seconds,
        from_gps,
        no_change_announced,
        0,
        0,
        0,
        current_leap_seconds_valid,
    )
    return ubx(0x01, 0x26, payload)


def nav_sat(gps_ns: int, satellites: Sequence[Satellite]) -> bytes:
    """UBX-NAV-SAT, 8 + 12 n bytes."""
    used_healthy_with_ephemeris = 0x7 | 0x8 | 0x10 | 0x800
    payload = struct.pack("<IBB2x", itow_ms(gps_ns), 1, len(satellites))
    for satellite in satellites:
        payload += struct.pack(
            "<BBBbhhI",
            satellite.gnss_id,
            satellite.number,
            satellite.cno_dbhz,
            satellite.elevation_deg,
            satellite.azimuth_deg,
            0,
            used_healthy_with_ephemeris,
        )
    return ubx(0x01, 0x35, payload)


def mon_ver(software: str, hardware: str, extensions: Sequence[str]) -> bytes:
    """UBX-MON-VER, 40 + 30 n bytes."""
    payload = struct.pack("<30s10s", software.encode("ascii"), hardware.encode("ascii"))
    payload += b"".join(struct.pack("<30s", text.encode("ascii")) for text in extensions)
    return ubx(0x0A, 0x04, payload)


def tim_tm2(
    *,
    rising_gps_ns: int,
    falling_gps_ns: int,
    is_new_rising: bool,
    is_new_falling: bool,
    rising_count: int,
    accuracy_ns: int,
) -> bytes:
    """UBX-TIM-TM2, 28 bytes: the last rising and the last falling edge on EXTINT0, GNSS time."""
    running, gnss_time_base, utc_available, time_valid = 0x01, 1 << 3, 0x20, 0x40
    flags = running | gnss_time_base | utc_available | time_valid
    flags |= 0x80 if is_new_rising else 0
    flags |= 0x04 if is_new_falling else 0
    week_rising, tow_rising_ns = gps_week_and_tow_ns(rising_gps_ns)
    week_falling, tow_falling_ns = gps_week_and_tow_ns(falling_gps_ns)
    payload = struct.pack(
        "<BBHHHIIIII",
        0,
        flags,
        rising_count & 0xFFFF,
        week_rising,
        week_falling,
        tow_rising_ns // _NS_PER_MS,
        tow_rising_ns % _NS_PER_MS,
        tow_falling_ns // _NS_PER_MS,
        tow_falling_ns % _NS_PER_MS,
        accuracy_ns,
    )
    return ubx(0x0D, 0x03, payload)


def gga(gps_ns: int, state: ReceiverState, satellites: int, leap_seconds: int) -> bytes:
    """NMEA GGA: fix, position and height above the geoid."""
    utc = utc_fields(gps_ns, leap_seconds)
    return nmea(
        f"GNGGA,{_clock(utc)},{_position(state)},1,{min(satellites, 12):02d},0.80,"
        f"{state.height_m - GEOID_UNDULATION_M:.1f},M,{GEOID_UNDULATION_M:.1f},M,,"
    )


def rmc(gps_ns: int, state: ReceiverState, leap_seconds: int) -> bytes:
    """NMEA RMC: position, speed over ground and date."""
    utc = utc_fields(gps_ns, leap_seconds)
    north, east, _ = state.velocity_ned_mps
    knots = math.hypot(north, east) * 3600.0 / 1852.0
    course = math.degrees(math.atan2(east, north)) % 360.0
    return nmea(
        f"GNRMC,{_clock(utc)},A,{_position(state)},{knots:.3f},{course:.2f},"
        f"{utc.day:02d}{utc.month:02d}{utc.year % 100:02d},,,A"
    )


def _mm(metres: float) -> int:
    return round(metres * 1000.0)


def _longitude(degrees: float) -> float:
    return (degrees + 180.0) % 360.0 - 180.0


def _clock(utc: UtcFields) -> str:
    return f"{utc.hour:02d}{utc.minute:02d}{utc.second:02d}.{utc.centisecond:02d}"


def _position(state: ReceiverState) -> str:
    latitude, longitude = state.latitude_deg, _longitude(state.longitude_deg)
    return (
        f"{_degrees_minutes(latitude, 2)},{'N' if latitude >= 0 else 'S'},"
        f"{_degrees_minutes(longitude, 3)},{'E' if longitude >= 0 else 'W'}"
    )


def _degrees_minutes(degrees: float, width: int) -> str:
    # In units of the last digit first, so that 59.999996 minutes become a whole degree.
    units = round(abs(degrees) * 60.0 * 1e5)
    whole, rest = divmod(units, 60 * 100_000)
    return f"{whole:0{width}d}{rest / 1e5:08.5f}"
