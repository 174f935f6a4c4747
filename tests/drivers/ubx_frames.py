"""UBX frames for tests, packed by hand from the receiver description, not by the driver's code."""

from __future__ import annotations

import struct


def frame(class_id: int, message_id: int, payload: bytes) -> bytes:
    """A frame with its checksum (UBX-13003221, 32.4: 8-bit Fletcher)."""
    body = struct.pack("<BBH", class_id, message_id, len(payload)) + payload
    a = b = 0
    for byte in body:
        a = (a + byte) % 256
        b = (b + a) % 256
    return b"\xb5\x62" + body + bytes((a, b))


def without(recorded: bytes, class_id: int, message_id: int) -> bytes:
    """A recording of whole frames without those of one message."""
    frames, at = [], 0
    while (at := recorded.find(b"\xb5\x62", at)) >= 0:
        end = at + 8 + struct.unpack_from("<H", recorded, at + 4)[0]
        if recorded[at + 2 : at + 4] != bytes((class_id, message_id)):
            frames.append(recorded[at:end])
        at = end
    return b"".join(frames)


def nav_pvt(
    itow_ms: int,
    utc: tuple[int, int, int, int, int, int],
    *,
    nano: int = 0,
    valid: int = 0b0111,
    fix_type: int = 3,
    flags: int = 1,
) -> bytes:
    """NAV-PVT at 47.5 N 8.5 E, 1000 m, flying 60 m/s north, 3 east, 1 up."""
    head = struct.pack("<IHBBBBBBIiBBBB", itow_ms, *utc, valid, 20, nano, fix_type, flags, 0, 17)
    place = struct.pack("<iiiiII", 85_000_000, 475_000_000, 1_000_000, 953_000, 800, 1_200)
    motion = struct.pack("<iiiiiIIH", 60_000, 3_000, -1_000, 60_075, 286_200, 150, 50_000, 123)
    tail = struct.pack("<H4xihH", 0, 286_200, 250, 50)
    return frame(0x01, 0x07, head + place + motion + tail)


def nav_att(itow_ms: int, roll: float, pitch: float, heading: float) -> bytes:
    """NAV-ATT, degrees."""
    angles = (round(angle * 1e5) for angle in (roll, pitch, heading))
    return frame(0x01, 0x05, struct.pack("<IB3xiiiIII", itow_ms, 0, *angles, 100, 100, 100))


def nav_timegps(itow_ms: int, ftow_ns: int, week: int, *, leap: int = 18, valid: int = 7) -> bytes:
    return frame(0x01, 0x20, struct.pack("<IihbBI", itow_ms, ftow_ns, week, leap, valid, 20))


def nav_timels(itow_ms: int, *, source: int, leap: int, valid: int = 1) -> bytes:
    payload = struct.pack("<IB3xBbBbiHH3xB", itow_ms, 0, source, leap, 0, 0, 0, 0, 0, valid)
    return frame(0x01, 0x26, payload)


def nav_eoe(itow_ms: int) -> bytes:
    return frame(0x01, 0x61, struct.pack("<I", itow_ms))


GNSS, UTC, RECEIVER = 1, 2, 0


def tim_tm2(
    week: int,
    tow_ms: int,
    sub_ms_ns: int,
    *,
    count: int = 1,
    base: int = GNSS,
    rising: bool = True,
    falling: bool = False,
    time_valid: bool = True,
) -> bytes:
    """TIM-TM2 of channel 0; the falling edge lies 1 ms later."""
    flags = falling << 2 | base << 3 | time_valid << 6 | rising << 7
    times = (tow_ms, sub_ms_ns, tow_ms + 1, sub_ms_ns, 24)
    return frame(0x0D, 0x03, struct.pack("<BBHHHIIIII", 0, flags, count, week, week, *times))
