"""Binary outputs of a VectorNav unit as bytes.

Written from VectorNav's user manuals UM004 and UM005, section "User configurable binary output
messages"; when they are sent is in `vectornav_receiver`.
"""

from __future__ import annotations

import struct

from sim_hw.receivers.emulated_receiver import ReceiverAccuracy, ReceiverState

TIME_OK, DATE_OK, UTC_OK = 1, 2, 4
ALL_TIMES_OK = TIME_OK | DATE_OK | UTC_OK
TRACKING, GNSS_FIX = 2, 4
FIX_3D = 3
COMMON, TIME, GNSS1, INS = 0, 1, 3, 5
"""Groups by their bit in the header."""


def crc16(data: bytes) -> int:
    """The 16-bit CRC of the manual: polynomial 0x1021, most significant bit first, from 0."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021) & 0xFFFF if crc & 0x8000 else crc << 1
    return crc


def output(groups: dict[int, dict[int, bytes]]) -> bytes:
    """A message of fields by group and bit: sync, groups, fields of each, payload, CRC."""
    head = struct.pack("<B", sum(1 << group for group in groups))
    payload = b""
    for group in sorted(groups):
        head += struct.pack("<H", sum(1 << bit for bit in groups[group]))
        payload += b"".join(groups[group][bit] for bit in sorted(groups[group]))
    covered = head + payload
    return b"\xfa" + covered + struct.pack(">H", crc16(covered))


def navigation(
    gps_ns: int,
    state: ReceiverState,
    accuracy: ReceiverAccuracy,
    satellites: int,
    leap_seconds: int,
    time_status: int = ALL_TIMES_OK,
    ins_status: int = TRACKING | GNSS_FIX,
) -> bytes:
    """Time, attitude, position, velocity, and the states of time, filter and GNSS receiver."""
    yaw_deg = (state.heading_deg + 180.0) % 360.0 - 180.0
    position = (state.latitude_deg, state.longitude_deg, state.height_m)
    return output(
        {
            COMMON: {
                1: struct.pack("<Q", gps_ns),
                3: struct.pack("<3f", yaw_deg, state.pitch_deg, state.roll_deg),
                6: struct.pack("<3d", *position),
                7: struct.pack("<3f", *state.velocity_ned_mps),
                12: struct.pack("<H", ins_status),
            },
            TIME: {9: struct.pack("<B", time_status)},
            GNSS1: {
                3: struct.pack("<B", satellites),
                4: struct.pack("<B", FIX_3D),
                12: struct.pack("<Bb", time_status, leap_seconds),
            },
            INS: {
                9: struct.pack("<f", accuracy.horizontal_m),
                10: struct.pack("<f", accuracy.speed_mps),
            },
        }
    )


def sync_in(gps_ns: int, since_edge_ns: int, count: int, time_status: int = ALL_TIMES_OK) -> bytes:
    """A message that an edge on SyncIn triggers: time, time since the edge, count of edges."""
    return output(
        {
            COMMON: {
                1: struct.pack("<Q", gps_ns),
                2: struct.pack("<Q", since_edge_ns),
                13: struct.pack("<I", count),
            },
            TIME: {9: struct.pack("<B", time_status)},
        }
    )
