"""An emulated resistance thermometer module: a Modbus RTU slave on a pseudo-terminal.

Source: Modbus over Serial Line V1.02, section 2.5.1; Modbus Application Protocol V1.1b3.
"""

from __future__ import annotations

import math
import struct
import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from sim_hw.pseudo_terminal import PseudoTerminal

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
_POLL_S = 0.2
_UNPLUGGED_POLL_S = 0.02


class ModbusProbe:
    """The module, from `start()` to `close()`; a host opens `port`.

    Register `first_register + i` is channel i in signed 0.1 degC, 0x7FFF where the channel says
    None: an open sensor. Functions 3 and 4 read the same registers. Requests for other slaves, and
    damaged ones, are met with silence.
    """

    def __init__(
        self,
        channels: Sequence[Callable[[], float | None]],
        unit: int = 1,
        first_register: int = 0,
    ) -> None:
        if not 1 <= unit <= 247:
            raise ValueError(f"unit is {unit}; a Modbus slave has an address from 1 to 247")
        self._channels = tuple(channels)
        self._unit = unit
        self._first_register = first_register
        self._terminal = PseudoTerminal()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._counts: Counter[str] = Counter()

    @property
    def port(self) -> str:
        """Path of the serial port a host opens."""
        return self._terminal.port

    def start(self) -> None:
        self._thread = threading.Thread(target=self._run, name="modbus-probe", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop and unplug. May be called twice."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=5.0)
        self._terminal.close()

    def statistics(self) -> Mapping[str, int]:
        """Counters since creation, by stable name."""
        names = ("requests", "exceptions", "damaged_frames", "other_slaves")
        return {name: self._counts[name] for name in names}

    def answer(self, frame: bytes) -> bytes | None:
        """The answer to one RTU frame; None where a slave keeps silent. Never raises."""
        if len(frame) < 4 or crc16(frame) != 0:
            self._counts["damaged_frames"] += 1
            return None
        unit, function = frame[0], frame[1]
        if unit != self._unit:
            self._counts["other_slaves"] += 1
            return None
        self._counts["requests"] += 1
        if function not in (READ_HOLDING_REGISTERS, READ_INPUT_REGISTERS):
            return self._exception(function, ILLEGAL_FUNCTION)
        if len(frame) != _REQUEST_BYTES:
            return self._exception(function, ILLEGAL_DATA_VALUE)
        start, count = struct.unpack(">HH", frame[2:6])
        if not 1 <= count <= _REGISTERS_MAX:
            return self._exception(function, ILLEGAL_DATA_VALUE)
        first = start - self._first_register
        if first < 0 or first + count > len(self._channels):
            return self._exception(function, ILLEGAL_DATA_ADDRESS)
        words = [_register(channel()) for channel in self._channels[first : first + count]]
        return _framed(struct.pack(f">BBB{count}H", unit, function, 2 * count, *words))

    def _exception(self, function: int, code: int) -> bytes:
        self._counts["exceptions"] += 1
        return _framed(bytes((self._unit, (function | 0x80) & 0xFF, code)))

    def _run(self) -> None:
        frame = b""
        while not self._stop.is_set():
            received = self._terminal.read(timeout_s=SILENCE_S if frame else _POLL_S)
            frame += received
            is_whole = len(frame) == _REQUEST_BYTES and crc16(frame) == 0
            if is_whole or (frame and not received):
                answer = self.answer(frame)
                frame = b""
                if answer is not None:
                    self._terminal.write(answer)
            elif not received and not self._terminal.is_open_by_a_host:
                self._stop.wait(_UNPLUGGED_POLL_S)
            # A babbling line never falls silent; its bytes are not worth keeping.
            frame = frame[: _FRAME_MAX_BYTES + 1]


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
