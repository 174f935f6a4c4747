"""Modbus RTU frames that read registers: bytes in, numbers out, no I/O.

Function 3 reads holding registers, function 4 input registers. The meaning of registers is in
`drivers.thermometers.modbus_rtu.readings`.

Source: Modbus Application Protocol V1.1b3, sections 6.3, 6.4 and 7; Modbus over Serial Line V1.02,
section 2.5.1.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final

READ_HOLDING_REGISTERS: Final = 3
READ_INPUT_REGISTERS: Final = 4
ILLEGAL_FUNCTION: Final = 1
MAX_REGISTERS: Final = 125
EXCEPTIONS: Final = {
    1: "it does not have this kind of registers; change register_kind",
    2: "it has no such registers; check first_register, register_kind and the number of channels",
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

    Args:
        data: the bytes covered; with the checksum behind them, low byte first, the result is 0.

    Returns:
        16-bit checksum.

    Source: Modbus over Serial Line V1.02, section 6.2.2.

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


def read_request(
    unit: int, first_register: int, count: int, function: int = READ_INPUT_REGISTERS
) -> bytes:
    """The request for consecutive registers.

    Args:
        unit: address of the module, 1 to 247.
        first_register: address of the first register as sent, from 0.
        count: number of registers, 1 to 125.
        function: 3 for holding registers, 4 for input registers.

    Returns:
        The frame with its CRC.

    Example:
        >>> read_request(1, 0, 2).hex(" ")
        '01 04 00 00 00 02 71 cb'
        >>> read_request(0x11, 0x6B, 3, READ_HOLDING_REGISTERS).hex(" ")
        '11 03 00 6b 00 03 76 87'
    """
    body = struct.pack(">BBHH", unit, function, first_register, count)
    return body + struct.pack("<H", crc16(body))


def find_reply(
    received: bytes, unit: int, count: int, function: int = READ_INPUT_REGISTERS
) -> Reply | None:
    """The first complete and valid reply in the received bytes.

    Noise before the reply, such as the echo of a two-wire line, is skipped.

    Args:
        received: bytes since the request.
        unit: address of the module that was asked.
        count: number of registers that were requested.
        function: function of the request; a reply to another one is not taken.

    Returns:
        The reply; None if there is none yet.
    """
    # Quirk: some RS-485 adapters return the request as an echo. It is skipped.
    # Upstream: stephane/libmodbus#380.
    for start in range(len(received) - 4):
        if received[start] != unit:
            continue
        replied = received[start + 1]
        if replied == function | 0x80:
            end = start + 5
        elif replied == function and received[start + 2] == 2 * count:
            end = start + 5 + 2 * count
        else:
            continue
        frame = received[start:end]
        if len(frame) < end - start or crc16(frame) != 0:
            continue
        skipped = len(received) - len(frame)
        if replied & 0x80:
            return Reply((), frame[2], skipped)
        return Reply(struct.unpack_from(f">{count}H", frame, 3), None, skipped)
    return None
