"""Modbus RTU frames of function 4, read input registers: bytes in, numbers out, no I/O.

Source: Modbus Application Protocol V1.1b3, sections 6.4 and 7; Modbus over Serial Line V1.02,
section 2.5.1.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final

READ_INPUT_REGISTERS: Final = 4
MAX_REGISTERS: Final = 125
EXCEPTIONS: Final = {
    1: "function 4 is not supported; the module is of another type",
    2: "it has no such registers; check first_register and the number of channels",
    3: "it refuses the number of registers; configure fewer channels",
    4: "internal device failure; check the status lamp of the module",
    5: "the request is accepted and needs more time",
    6: "it is busy",
}


@dataclass(frozen=True)
class Reply:
    """A reply: registers as unsigned words, or an exception code. `skipped` bytes were noise."""

    registers: tuple[int, ...]
    exception: int | None
    skipped: int


def crc16(data: bytes) -> int:
    """CRC-16/MODBUS.

    Example:
        >>> hex(crc16(b"123456789"))
        '0x4b37'
    """
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ 0xA001 if crc & 1 else crc >> 1
    return crc


def read_request(unit: int, first_register: int, count: int) -> bytes:
    """The request for `count` input registers.

    Example:
        >>> read_request(1, 0, 2).hex(" ")
        '01 04 00 00 00 02 71 cb'
    """
    body = struct.pack(">BBHH", unit, READ_INPUT_REGISTERS, first_register, count)
    return body + struct.pack("<H", crc16(body))


def find_reply(received: bytes, unit: int, count: int) -> Reply | None:
    """The first complete and valid reply in the received bytes; None if there is none.

    Noise before the reply, such as the echo of a two-wire line, is skipped.
    """
    for start in range(len(received) - 4):
        if received[start] != unit:
            continue
        function = received[start + 1]
        if function == READ_INPUT_REGISTERS | 0x80:
            end = start + 5
        elif function == READ_INPUT_REGISTERS and received[start + 2] == 2 * count:
            end = start + 5 + 2 * count
        else:
            continue
        frame = received[start:end]
        if len(frame) < end - start or crc16(frame) != 0:
            continue
        skipped = len(received) - len(frame)
        if function & 0x80:
            return Reply((), frame[2], skipped)
        return Reply(struct.unpack_from(f">{count}H", frame, 3), None, skipped)
    return None
