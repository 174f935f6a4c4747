"""Groups of an Applanix system as bytes.

Written from the Applanix POS AV and POS MV V5 user interface control documents, PUBS-ICD-004089;
when they are sent is in `applanix_receiver`.
"""

from __future__ import annotations

import struct

from sim_hw.receivers.emulated_receiver import ReceiverAccuracy, ReceiverState
from sim_hw.world.world_clock import NS_PER_S, gps_week_and_tow_ns

NAVIGATION, PERFORMANCE, PRIMARY_GNSS, EVENT_1, PPS = 1, 2, 3, 5, 7
POS_TIME, GPS_TIME, UTC_TIME = 0, 1, 2
FULL_NAVIGATION = 0
FULLY_SYNCHRONIZED = 2
RTK_INTEGER = 8
_CHANNEL_NBYTES = 20


def group(number: int, gps_ns: int, pos_s: float, body: bytes) -> bytes:
    """A group: sync, number, length, times, body, padding to four bytes, checksum, end."""
    _, tow_ns = gps_week_and_tow_ns(gps_ns)
    times = struct.pack("<3dBB", tow_ns / NS_PER_S, pos_s, 0.0, GPS_TIME | POS_TIME << 4, 0)
    content = times + body
    content += bytes(-len(content) % 4)
    covered = b"$GRP" + struct.pack("<HH", number, len(content) + 4) + content
    words = struct.unpack(f"<{len(covered) // 2}H", covered)
    checksum = -(sum(words) + int.from_bytes(b"$#", "little")) & 0xFFFF
    return covered + struct.pack("<H", checksum) + b"$#"


def navigation(gps_ns: int, pos_s: float, state: ReceiverState, alignment: int) -> bytes:
    """Group 1: place, velocity, attitude, wander angle, track, speed, rates, accelerations."""
    north, east, down = state.velocity_ned_mps
    body = struct.pack(
        "<3d3f4d8fB",
        *(state.latitude_deg, state.longitude_deg, state.height_m, north, east, down),
        *(state.roll_deg, state.pitch_deg, state.heading_deg, 0.0),
        *(state.heading_deg, (north**2 + east**2) ** 0.5, *(0.0,) * 6, alignment),
    )
    return group(NAVIGATION, gps_ns, pos_s, body)


def performance(gps_ns: int, pos_s: float, accuracy: ReceiverAccuracy) -> bytes:
    """Group 2: RMS of place, velocity, attitude; error ellipsoid."""
    side_m, speed = accuracy.horizontal_m / 2**0.5, accuracy.speed_mps / 3**0.5
    tilt, heading = accuracy.roll_pitch_deg, accuracy.heading_deg
    numbers = (side_m, side_m, accuracy.vertical_m, *(speed,) * 3, tilt, tilt, heading)
    return group(PERFORMANCE, gps_ns, pos_s, struct.pack("<12f", *numbers, side_m, side_m, 0.0))


def primary_gnss(gps_ns: int, pos_s: float, satellites: int, leap_seconds: int) -> bytes:
    """Group 3: solution, satellites and their channels, dilutions, week, UTC offset, latency."""
    week, _ = gps_week_and_tow_ns(gps_ns)
    channels = bytes(_CHANNEL_NBYTES * satellites)
    body = struct.pack("<bBH", RTK_INTEGER, satellites, len(channels)) + channels
    body += struct.pack("<3fHIdffHI", 0.9, 1.2, 0.5, 0, week, leap_seconds, 0.1, 46.0, 18, 0)
    return group(PRIMARY_GNSS, gps_ns, pos_s, body)


def pps(gps_ns: int, pos_s: float, count: int, status: int = FULLY_SYNCHRONIZED) -> bytes:
    """Group 7: count of pulses per second and state of the synchronization."""
    return group(PPS, gps_ns, pos_s, struct.pack("<IB", count, status))


def event(gps_ns: int, pos_s: float, pulse: int) -> bytes:
    """Group 5: an event at input 1, by its number."""
    return group(EVENT_1, gps_ns, pos_s, struct.pack("<I", pulse))
