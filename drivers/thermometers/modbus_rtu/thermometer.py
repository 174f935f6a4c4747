"""Resistance thermometers behind a Modbus RTU module.

The frames are in `drivers.thermometers.modbus_rtu.frames`, the meaning of registers in
`drivers.thermometers.modbus_rtu.readings`; opening, reconnecting and counting in
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
    READ_HOLDING_REGISTERS,
    READ_INPUT_REGISTERS,
    Reply,
    find_reply,
    read_request,
)
from drivers.thermometers.modbus_rtu.readings import (
    WORDS,
    ImplausibleReadingError,
    ReadingFormat,
)
from drivers.timescales.clock import Clock
from drivers.transport.serial_device import (
    READ_TIMEOUT_S,
    PortOpener,
    SerialDevice,
    SerialLine,
    open_serial_port,
)

FUNCTIONS: Final = {"input": READ_INPUT_REGISTERS, "holding": READ_HOLDING_REGISTERS}
DRAIN_STEPS: Final = 50
"""Maximum number of reads before a request, for a line that sends without end."""


class ModbusThermometer(SerialDevice):
    """Resistance thermometers behind one Modbus RTU slave.

    Reads consecutive registers, one or two per channel: 16 bit scaled, or 32-bit floats. An open
    sensor (the register `open_sensor`, or a float that is not a number) yields a sample with
    `value_c=None`. A number that is no temperature yields nothing and is reported. Floats yield
    nothing until one has shown the word order: about one in eight is a temperature in both.

    Source: the module's register map; Modbus over Serial Line V1.02, section 2.5.1.
    """

    kind: ClassVar = "thermometer"
    what = "thermometer"

    baudrate = Setting(19200, minimum=300, maximum=4_000_000, help="speed of the line, bit/s")
    parity = Setting("E", choices=("N", "E", "O"), help="parity on the wire")
    unit = Setting(1, minimum=1, maximum=247, help="unit identifier of the module")
    register_kind = Setting(
        "input", choices=tuple(FUNCTIONS), help="registers to read: function 4 or function 3"
    )
    first_register = Setting(
        0,
        minimum=0,
        maximum=65535,
        help="address of the first channel as sent, from 0 (30001 and 40001 of a manual are 0)",
    )
    value_type = Setting("int16", choices=tuple(WORDS), help="type of a channel's value")
    word_order = Setting(
        "big",
        choices=("big", "little"),
        help="big: the first register of a float is its upper half",
    )
    scale_c = Setting(
        0.1,
        minimum=1e-4,
        maximum=100,
        help="degC per unit of the value; floats are mostly in degC: 1",
    )
    offset_c = Setting(
        0.0, minimum=-1000, maximum=1000, help="degC of the value 0; -273.15 if it is in kelvin"
    )
    open_sensor = Setting(
        0x7FFF, minimum=0, maximum=0xFFFF, help="16-bit register that means an open sensor"
    )
    channels: Setting[tuple[str, ...]] = Setting(
        (),
        required=True,
        minimum=1,
        maximum=MAX_REGISTERS,
        help="names of the probes, in the order of the registers",
    )
    interval_s = Setting(1.0, minimum=0.05, maximum=3600, help="time from reading to reading")
    answer_timeout_s = Setting(0.5, minimum=0.01, maximum=1, help="longest wait for an answer")

    def __init__(
        self,
        name: str,
        settings: Mapping[str, object],
        *,
        clock: Clock | None = None,
        open_port: PortOpener = open_serial_port,
    ) -> None:
        super().__init__(name, settings, clock=clock, open_port=open_port)
        self._next_poll_ns = 0
        self._format = ReadingFormat(
            self.value_type, self.word_order, self.scale_c, self.offset_c, self.open_sensor
        )
        self._function = FUNCTIONS[self.register_kind]
        self._count = len(self.channels) * self._format.words
        self._is_word_order_confirmed = self.value_type != "float32"
        self.counters.update(implausible=0, unconfirmed=0)

    @classmethod
    def setting_conflicts(cls, values: Mapping[str, Any]) -> list[str]:
        found = []
        channels = values["channels"]
        twice = sorted({name for name in channels if channels.count(name) > 1})
        if twice:
            found.append(f"channels names {', '.join(twice)} twice; every probe has its own name")
        count = len(channels) * WORDS[values["value_type"]]
        if count > MAX_REGISTERS:
            found.append(
                f"channels has {len(channels)} names; at most "
                f"{MAX_REGISTERS // WORDS[values['value_type']]} of {values['value_type']}"
            )
        if values["first_register"] + count > 65536:
            found.append(
                f"first_register is {values['first_register']}; with {len(channels)} channels at "
                f"most {65536 - count}"
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
        for probe, registers in self._by_probe(reply):
            try:
                value_c = self._format.temperature_c(registers)
            except ImplausibleReadingError as error:
                found[f"probe {probe}"] = f"{error}; check value_type, word_order and scale_c"
                continue
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
        if not self._confirm_word_order(reply):
            return []
        samples = []
        for probe, registers in self._by_probe(reply):
            try:
                samples.append(
                    TemperatureSample(probe, self._format.temperature_c(registers), now_ns)
                )
            except ImplausibleReadingError as error:
                self.counters["implausible"] += 1
                self.emitter.emit_throttled(
                    "implausible",
                    f"Probe {probe} of the thermometer {self.name} reads {error.value_c:g} degC, "
                    "which is no temperature. Check value_type, word_order, scale_c and the probe.",
                )
        return samples

    def _confirm_word_order(self, reply: Reply) -> bool:
        """Whether the floats of a module are temperatures in the configured word order only."""
        if self.value_type != "float32":
            return True
        evidence = sum(
            self._format.word_order_evidence(registers) for _, registers in self._by_probe(reply)
        )
        if evidence:
            self._is_word_order_confirmed = evidence > 0
        if not self._is_word_order_confirmed:
            self.counters["unconfirmed"] += len(self.channels)
            self.emitter.emit_throttled(
                "word-order",
                f"The readings of the thermometer {self.name} are no temperatures in the word "
                f'order "{self.word_order}" and are left out. '
                "Check word_order, scale_c and first_register.",
            )
        return self._is_word_order_confirmed

    def _by_probe(self, reply: Reply) -> Iterable[tuple[str, tuple[int, ...]]]:
        words = self._format.words
        for number, probe in enumerate(self.channels):
            yield probe, reply.registers[number * words : (number + 1) * words]

    def _read_registers(self, line: SerialLine) -> Reply | None:
        """Send one request; None if no valid reply came in time."""
        self.counters["bad_bytes"] += line.drain(DRAIN_STEPS)
        line.write(read_request(self.unit, self.first_register, self._count, self._function))
        received = b""
        deadline_ns = self.clock.mono_ns() + round(self.answer_timeout_s * 1e9)
        while (left_ns := deadline_ns - self.clock.mono_ns()) > 0 and not self._closing.is_set():
            received += line.read(min(left_ns * 1e-9, READ_TIMEOUT_S))
            reply = find_reply(received, self.unit, self._count, self._function)
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
            f"{self.first_register} to {self.first_register + self._count - 1} with "
            f"exception {code}: {meaning}."
        )
