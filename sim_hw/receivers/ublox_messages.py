"""UBX messages of a u-blox receiver as bytes.

Written from the interface descriptions of u-blox 8/M8 (UBX-13003221) and F9 HPS (UBX-19056845);
when they are sent is in `ublox_receiver`.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from sim_hw.receivers.emulated_receiver import ReceiverAccuracy, ReceiverState
from sim_hw.receivers.nmea_sentences import (
    GEOID_UNDULATION_M,
    broken_down_utc,
    course_deg,
    longitude_deg,
    speed_mps,
)
from sim_hw.world.world_clock import NS_PER_WEEK, gps_week_and_tow_ns

_NS_PER_MS = 1_000_000


@dataclass(frozen=True)
class Satellite:
    """One satellite of NAV-SAT."""

    gnss_id: int
    number: int
    cno_dbhz: int
    elevation_deg: int
    azimuth_deg: int


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


def nav_pvt(
    gps_ns: int,
    state: ReceiverState,
    accuracy: ReceiverAccuracy,
    satellites: int,
    leap_seconds: int,
) -> bytes:
    """UBX-NAV-PVT, 92 bytes: position, velocity, time."""
    utc = broken_down_utc(gps_ns, leap_seconds)
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
        round(longitude_deg(state.longitude_deg) * 1e7),
        round(state.latitude_deg * 1e7),
        _mm(state.height_m),
        _mm(state.height_m - GEOID_UNDULATION_M),
        _mm(accuracy.horizontal_m),
        _mm(accuracy.vertical_m),
        _mm(north),
        _mm(east),
        _mm(down),
        _mm(speed_mps(state)),
        round(course_deg(state) * 1e5),
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


def _mm(metres: float) -> int:
    return round(metres * 1000.0)
