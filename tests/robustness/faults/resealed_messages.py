"""Mutated messages with a valid checksum, so that the content is reached."""

from __future__ import annotations

import binascii
import functools
import struct
import zlib

from drivers.receivers.sbg.framing import crc as sbg_crc
from drivers.thermometers.modbus_rtu.frames import crc16
from sim_hw.receivers.mavlink_messages import by_number, x25


def reseal_ubx(message: bytearray) -> bytes:
    a = b = 0
    message[:2] = b"\xb5\x62"
    message[4:6] = struct.pack("<H", max(len(message) - 8, 0))
    for byte in message[2:-2]:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    message[-2:] = bytes((a, b))
    return bytes(message)


def reseal_nmea(message: bytearray) -> bytes:
    body = bytes(byte for byte in message[1:-5] if 32 <= byte < 127 and byte not in b"$*!")
    checksum = functools.reduce(lambda a, b: a ^ b, body, 0)
    return b"$%b*%02X\r\n" % (body, checksum)


def reseal_novatel(message: bytearray) -> bytes:
    message[:3] = b"\xaa\x44\x12"
    message[3] = 28
    message[8:10] = struct.pack("<H", max(len(message) - 32, 0))
    crc = zlib.crc32(bytes(message[:-4]), 0xFFFFFFFF) ^ 0xFFFFFFFF
    message[-4:] = struct.pack("<I", crc)
    return bytes(message)


def reseal_sbf(message: bytearray) -> bytes:
    message[:2] = b"$@"
    message[6:8] = struct.pack("<H", len(message))
    message[2:4] = struct.pack("<H", binascii.crc_hqx(bytes(message[4:]), 0))
    return bytes(message)


def reseal_sbg(message: bytearray) -> bytes:
    message[:2] = b"\xff\x5a"
    message[4:6] = struct.pack("<H", max(len(message) - 9, 0))
    message[-3:] = struct.pack("<HB", sbg_crc(bytes(message[2:-3])), 0x33)
    return bytes(message)


def reseal_vectornav(message: bytearray) -> bytes:
    message[:1] = b"\xfa"
    message[-2:] = struct.pack(">H", binascii.crc_hqx(bytes(message[1:-2]), 0))
    return bytes(message)


def reseal_xsens(message: bytearray) -> bytes:
    message[:2] = b"\xfa\xff"
    message[3] = min(max(len(message) - 5, 0), 254)
    message[-1] = -sum(message[1:-1]) & 0xFF
    return bytes(message)


def reseal_applanix(message: bytearray) -> bytes:
    del message[len(message) // 4 * 4 :]
    message[:4], message[-4:] = b"$GRP", b"\0\0$#"
    message[6:8] = struct.pack("<H", len(message) - 8)
    words = struct.unpack(f"<{len(message) // 2}H", message)
    message[-4:-2] = struct.pack("<H", -sum(words) & 0xFFFF)
    return bytes(message)


def reseal_gsof(message: bytearray) -> bytes:
    message[0], message[2], message[-1] = 0x02, 0x40, 0x03
    message[3] = min(max(len(message) - 6, 0), 255)
    message[-2] = sum(message[1:-2]) & 0xFF
    return bytes(message)


def reseal_mavlink(message: bytearray) -> bytes:
    message[0], message[2] = 0xFD, 0
    message[1] = max(len(message) - 12, 0) & 0xFF
    definition = by_number().get(int.from_bytes(message[7:10], "little"))
    seed = definition.crc_extra if definition is not None else 0
    crc = x25(bytes((seed,)), x25(bytes(message[1:-2])))
    message[-2:] = struct.pack("<H", crc)
    return bytes(message)


def reseal_modbus(message: bytearray) -> bytes:
    message[-2:] = struct.pack("<H", crc16(bytes(message[:-2])))
    return bytes(message)
