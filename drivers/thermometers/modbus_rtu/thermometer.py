"""Resistance thermometers behind a Modbus RTU module.

The frames are in `drivers.thermometers.modbus_rtu.frames`; opening, reconnecting and counting in
`drivers.transport.serial_device`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Final

from drivers.base.settings import Setting
from drivers.contract import DeviceError, TemperatureSample
from drivers.thermometers.modbus_rtu.frames import (
    EXCEPTIONS,
    MAX_REGISTERS,
    Reply,
    find_reply,
    read_request,
)
from drivers.transport.serial_device import READ_TIMEOUT_S, SerialDevice, SerialLine

OPEN_SENSOR: Final = 0x7FFF
DRAIN_STEPS: Final = 50
"""Maximum number of reads before a request, for a line that sends without end."""


class ModbusThermometer(SerialDevice):
    """Resistance thermometers behind one Modbus RTU slave.

    Reads one input register per channel, consecutive, signed, in units of 0.1 degC. The value
    0x7FFF means an open sensor and yields a sample with `value_c=None`.

    Source: the module's register map; Modbus over Serial Line V1.02, section 2.5.1.
    """

    kind: ClassVar = "thermometer"
    what = "thermometer"

    baudrate = Setting(19200, minimum=300, maximum=4_000_000, help="speed of the line, bit/s")
    parity = Setting("E", choices=("N", "E", "O"), help="parity on the wire")
    unit = Setting(1, minimum=1, maximum=247, help="unit identifier of the module")
    first_register = Setting(0, minimum=0, maximum=65535, help="address of the first channel")
    channels: Setting[tuple[str, ...]] = Setting(
        (),
        required=True,
        minimum=1,
        maximum=MAX_REGISTERS,
        help="names of the probes, in the order of the registers",
    )
    interval_s = Setting(1.0, minimum=0.05, maximum=3600, help="time from reading to reading")
    answer_timeout_s = Setting(0.5, minimum=0.01, maximum=1, help="longest wait for an answer")

    _next_poll_ns = 0

    @classmethod
    def setting_conflicts(cls, values: Mapping[str, Any]) -> list[str]:
        found = []
        channels = values["channels"]
        twice = sorted({name for name in channels if channels.count(name) > 1})
        if twice:
            found.append(f"channels names {', '.join(twice)} twice; every probe has its own name")
        last = values["first_register"] + len(channels) - 1
        if last > 65535:
            found.append(
                f"first_register is {values['first_register']}; with {len(channels)} channels at "
                f"most {65536 - len(channels)}"
            )
        if values["silence_s"] < values["interval_s"] + values["answer_timeout_s"]:
            found.append(
                f"silence_s is {values['silence_s']:g}; at least interval_s + answer_timeout_s = "
                f"{values['interval_s'] + values['answer_timeout_s']:g}, or every pause is silence"
            )
        return found

    def line_settings(self) -> tuple[int, str]:
        return self.baudrate, self.parity

    def identify(self, line: SerialLine) -> Mapping[str, str]:
        """Read every probe once; returns the readings."""
        reply = self._read_registers(line)
        if reply is None:
            raise DeviceError(
                f"{self.name}: unit {self.unit} at {self.port} gave no answer within "
                f"{self.answer_timeout_s:g} s; check power, the two wires (A and B swapped?), "
                f"unit, baudrate ({self.baudrate}) and parity ({self.parity})"
            )
        if reply.exception is not None:
            raise DeviceError(f"{self.name}: {self._exception(reply.exception)}")
        found = {"unit": str(self.unit)}
        for probe, register in zip(self.channels, reply.registers, strict=True):
            value_c = _celsius(register)
            found[f"probe {probe}"] = "open" if value_c is None else f"{value_c:.1f} degC"
        return found

    def connected(self) -> None:
        self._next_poll_ns = self.clock.mono_ns()

    def step(self, line: SerialLine) -> Iterable[TemperatureSample]:
        wait_ns = self._next_poll_ns - self.clock.mono_ns()
        if wait_ns > 0:
            self.clock.wait(self._closing, min(wait_ns * 1e-9, READ_TIMEOUT_S))
            return []
        interval_ns = round(self.interval_s * 1e9)
        self._next_poll_ns = max(self._next_poll_ns + interval_ns, self.clock.mono_ns())
        reply = self._read_registers(line)
        if reply is None:
            return []
        if reply.exception is not None:
            self.counters["exceptions"] += 1
            self.emitter.emit_throttled("exception", self._exception(reply.exception))
            return []
        now_ns = self.clock.mono_ns()
        return [
            TemperatureSample(probe, _celsius(register), now_ns)
            for probe, register in zip(self.channels, reply.registers, strict=True)
        ]

    def _read_registers(self, line: SerialLine) -> Reply | None:
        """Send one request; None if no valid reply came in time."""
        self.counters["bad_bytes"] += line.drain(DRAIN_STEPS)
        line.write(read_request(self.unit, self.first_register, len(self.channels)))
        received = b""
        deadline_ns = self.clock.mono_ns() + round(self.answer_timeout_s * 1e9)
        while (left_ns := deadline_ns - self.clock.mono_ns()) > 0 and not self._closing.is_set():
            received += line.read(min(left_ns * 1e-9, READ_TIMEOUT_S))
            reply = find_reply(received, self.unit, len(self.channels))
            if reply is not None:
                self.counters["bad_bytes"] += reply.skipped
                self.count_messages()
                return reply
        self.counters["timeouts"] += 1
        if received:
            self.counters["bad_bytes"] += len(received)
            self.counters["bad_messages"] += 1
            self.emitter.emit_throttled(
                "checksum",
                f"The thermometer {self.name} at {self.port} sent invalid replies. Check "
                "baud rate, parity and the line's termination.",
            )
        return None

    def _exception(self, code: int) -> str:
        meaning = EXCEPTIONS.get(code, "an exception that the standard does not define")
        return (
            f"The thermometer {self.name}, unit {self.unit} at {self.port}, refuses registers "
            f"{self.first_register} to {self.first_register + len(self.channels) - 1} with "
            f"exception {code}: {meaning}."
        )


def _celsius(register: int) -> float | None:
    if register == OPEN_SENSOR:
        return None
    return (register - 0x10000 if register & 0x8000 else register) / 10
