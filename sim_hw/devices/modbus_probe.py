"""An emulated resistance thermometer module: a Modbus RTU slave on a pseudo-terminal.

Source: Modbus over Serial Line V1.02, section 2.5.1; Modbus Application Protocol V1.1b3.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence

from sim_hw.devices.device_loop import DRAIN_S, DeviceLine, LineDevice
from sim_hw.devices.pseudo_terminal import PseudoTerminal

OPEN_SENSOR = 0x7FFF
READ_HOLDING_REGISTERS = 3
READ_INPUT_REGISTERS = 4
ILLEGAL_FUNCTION = 1
ILLEGAL_DATA_ADDRESS = 2
ILLEGAL_DATA_VALUE = 3

SILENCE_S = 0.01
"""What ends a frame. The standard's 3.5 characters are 4 ms at 9600 baud; a pseudo-terminal has no
baud rate, and the scheduler may tear a request apart for longer than that."""

_REQUEST_BYTES = 8
_FRAME_MAX_BYTES = 256
_REGISTERS_MAX = 125


class ModbusProbe(LineDevice):
    """The module, from `start()` to `close()`; a host opens `port`.

    Register `first_register + i` is channel i in signed 0.1 degC, 0x7FFF where the channel gives
    None: an open sensor. With `float_word_order` each channel has two registers with a 32-bit float
    in degC, not a number for an open sensor; "little" sends the lower half first. Registers are
    read by the `functions`, 3 and 4. Requests for other slaves, and damaged ones, are met with
    silence.
    """

    def __init__(
        self,
        channels: Sequence[Callable[[], float | None]],
        unit: int = 1,
        first_register: int = 0,
        line: DeviceLine | None = None,
        float_word_order: str = "",
        functions: Sequence[int] = (READ_HOLDING_REGISTERS, READ_INPUT_REGISTERS),
    ) -> None:
        if not 1 <= unit <= 247:
            raise ValueError(f"unit is {unit}; a Modbus slave has an address from 1 to 247")
        super().__init__("modbus-probe", line or PseudoTerminal())
        self._channels = tuple(channels)
        self._unit = unit
        self._first_register = first_register
        self._float_word_order = float_word_order
        self._functions = tuple(functions)
        self._frame = b""

    def statistics(self) -> Mapping[str, int]:
        """Counters since creation, by stable name."""
        names = ("requests", "exceptions", "damaged_frames", "other_slaves")
        return {name: self.counts[name] for name in names}

    def answer(self, frame: bytes) -> bytes | None:
        """The answer to one RTU frame; None where a slave keeps silent. Never raises."""
        if len(frame) < 4 or crc16(frame) != 0:
            self.counts["damaged_frames"] += 1
            return None
        unit, function = frame[0], frame[1]
        if unit != self._unit:
            self.counts["other_slaves"] += 1
            return None
        self.counts["requests"] += 1
        if function not in self._functions:
            return self._exception(function, ILLEGAL_FUNCTION)
        if len(frame) != _REQUEST_BYTES:
            return self._exception(function, ILLEGAL_DATA_VALUE)
        start, count = struct.unpack(">HH", frame[2:6])
        if not 1 <= count <= _REGISTERS_MAX:
            return self._exception(function, ILLEGAL_DATA_VALUE)
        first = start - self._first_register
        words = 2 if self._float_word_order else 1
        if first < 0 or first + count > words * len(self._channels):
            return self._exception(function, ILLEGAL_DATA_ADDRESS)
        held = range(first // words, (first + count - 1) // words + 1)
        registers = [word for number in held for word in self._words(self._channels[number]())]
        registers = registers[first % words :][:count]
        return _framed(struct.pack(f">BBB{count}H", unit, function, 2 * count, *registers))

    def _words(self, value_c: float | None) -> tuple[int, ...]:
        if not self._float_word_order:
            return (_register(value_c),)
        upper, lower = struct.unpack(
            ">HH", struct.pack(">f", math.nan if value_c is None else value_c)
        )
        return (upper, lower) if self._float_word_order == "big" else (lower, upper)

    def _exception(self, function: int, code: int) -> bytes:
        self.counts["exceptions"] += 1
        return _framed(bytes((self._unit, (function | 0x80) & 0xFF, code)))

    def on_received(self, data: bytes) -> bytes:
        # A babbling line never falls silent; its bytes are discarded.
        self._frame = (self._frame + data)[: _FRAME_MAX_BYTES + 1]
        if len(self._frame) == _REQUEST_BYTES and crc16(self._frame) == 0:
            return self.on_idle()
        self.idle_timeout_s = SILENCE_S
        return b""

    def on_idle(self) -> bytes:
        """The line has fallen silent: what was received is a frame."""
        frame, self._frame = self._frame, b""
        self.idle_timeout_s = DRAIN_S
        return (self.answer(frame) or b"") if frame else b""


def crc16(data: bytes) -> int:
    """CRC-16/MODBUS; 0 over a frame that carries its own CRC, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ 0xA001 if crc & 1 else crc >> 1
    return crc


def _framed(body: bytes) -> bytes:
    return body + struct.pack("<H", crc16(body))


def _register(value_c: float | None) -> int:
    if value_c is None or not math.isfinite(value_c):
        return OPEN_SENSOR
    tenths = max(-0x8000, min(OPEN_SENSOR - 1, round(value_c * 10.0)))
    return tenths & 0xFFFF
