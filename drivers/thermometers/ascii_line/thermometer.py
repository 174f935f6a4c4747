"""Instruments that send temperatures as lines of text.

Patterns of lines are in `drivers.thermometers.ascii_line.pattern`; opening, reconnecting and
counting are in `drivers.transport.serial_device`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Final

from drivers.base.settings import Setting
from drivers.contract import DeviceError, TemperatureSample
from drivers.thermometers.ascii_line.pattern import MAX_LINE, LinePattern, PatternError
from drivers.timescales.clock import Clock
from drivers.transport.serial_device import (
    READ_TIMEOUT_S,
    PortOpener,
    SerialDevice,
    SerialLine,
    open_serial_port,
)

TERMINATORS: Final = {"cr": b"\r", "lf": b"\n", "crlf": b"\r\n"}
NUMBER: Final = re.compile(r"[-+]?(\d{1,9}([.,]\d{0,9})?|[.,]\d{1,9})([eE][-+]?\d{1,2})?")
ABSOLUTE_ZERO_C: Final = -273.15
MAX_TEMPERATURE_C: Final = 2000.0


class AsciiLineThermometer(SerialDevice):
    """Probes of an instrument that sends its readings as lines of text.

    The named groups of `pattern` are, in their order, the readings of `channels`. A pattern with
    the groups `channel` and `value` is for instruments that send one line per channel: the text of
    `channel` is looked up in `channel_labels`. A reading in `open_sensor_labels` means an open
    sensor and yields a sample with `value_c=None`. A reading that is no temperature yields nothing.
    """

    kind: ClassVar = "thermometer"
    what = "thermometer"

    baudrate = Setting(9600, minimum=300, maximum=4_000_000, help="speed of the line, bit/s")
    parity = Setting("N", choices=("N", "E", "O"), help="parity on the wire")
    pattern = Setting("", required=True, help="what a line looks like, with named groups")
    channels: Setting[tuple[str, ...]] = Setting(
        (), required=True, minimum=1, maximum=64, help="names of the probes, in the pattern's order"
    )
    channel_labels: Setting[tuple[str, ...]] = Setting(
        (), maximum=64, help="what the instrument calls the probes; empty: as they are named"
    )
    open_sensor_labels: Setting[tuple[str, ...]] = Setting(
        ("OPEN",), maximum=16, help="readings that mean an open sensor"
    )
    unit = Setting("C", choices=("C", "F", "K"), help="unit of the readings")
    command = Setting("", help="request for a reading; empty: the instrument sends unrequested")
    command_end = Setting("cr", choices=tuple(TERMINATORS), help="what ends the command")
    interval_s = Setting(1.0, minimum=0.05, maximum=3600, help="time from command to command")

    def __init__(
        self,
        name: str,
        settings: Mapping[str, object],
        *,
        clock: Clock | None = None,
        open_port: PortOpener = open_serial_port,
    ) -> None:
        super().__init__(name, settings, clock=clock, open_port=open_port)
        self._pattern = LinePattern(self.pattern)
        self._probes = dict(zip(self.channel_labels or self.channels, self.channels, strict=True))
        self._open_sensor_labels = {label.casefold() for label in self.open_sensor_labels}
        self._pending = b""
        self._overlong = False
        self._next_command_ns = 0
        self._last_bad_line = ""
        self.counters.update(lines=0, readings=0, open_sensors=0)

    @classmethod
    def setting_conflicts(cls, values: Mapping[str, Any]) -> list[str]:
        channels, labels = values["channels"], values["channel_labels"]
        found = [
            f"{key} names {', '.join(twice)} twice; every probe has its own name"
            for key in ("channels", "channel_labels")
            if (twice := sorted({name for name in values[key] if values[key].count(name) > 1}))
        ]
        try:
            groups = LinePattern(values["pattern"]).groups
        except PatternError as error:
            return [*found, f"pattern is {values['pattern']!r}; {error}"]
        if set(groups) == {"channel", "value"}:
            if labels and len(labels) != len(channels):
                found.append(
                    f"channel_labels has {len(labels)} labels; channels has {len(channels)}"
                )
        elif labels:
            found.append("channel_labels is given; only a pattern with the group channel uses it")
        elif len(groups) != len(channels):
            found.append(
                f"pattern has {len(groups)} named groups; {len(channels)} are needed, one (?P<name>"
                "...) for every channel, or the two groups channel and value"
            )
        if not values["command"].isascii():
            found.append(f"command is {values['command']!r}; ASCII characters only")
        if values["command"] and values["silence_s"] < 2 * values["interval_s"]:
            found.append(
                f"silence_s is {values['silence_s']:g}; at least twice interval_s = "
                f"{2 * values['interval_s']:g}, or every pause is silence"
            )
        return found

    def line_settings(self) -> tuple[int, str]:
        return self.baudrate, self.parity

    def identify(self, line: SerialLine) -> Mapping[str, str]:
        """Listen until every probe was read, `silence_s` at most; returns the readings."""
        deadline_ns = self.clock.mono_ns() + round(self.silence_s * 1e9)
        readings_text: dict[str, str] = {}
        before = self.counters["bytes"]
        while self.clock.mono_ns() < deadline_ns and not self._closing.is_set():
            for sample in self.step(line):
                value_c = sample.value_c
                readings_text[sample.probe] = "open" if value_c is None else f"{value_c:.2f} degC"
            if len(readings_text) == len(self.channels):
                return {f"probe {probe}": readings_text[probe] for probe in self.channels}
        if readings_text:
            missing = ", ".join(probe for probe in self.channels if probe not in readings_text)
            raise DeviceError(
                f"{self.name}: the instrument at {self.port} gave no reading of {missing} in "
                f"{self.silence_s:g} s; check channels and channel_labels"
            )
        if self._last_bad_line:
            raise DeviceError(
                f"{self.name}: no line at {self.port} fits the pattern, the last was "
                f"{self._last_bad_line!r}; check pattern, baudrate ({self.baudrate}) and parity"
            )
        came = self.counters["bytes"] - before
        raise DeviceError(
            f"{self.name}: {'no complete line' if came else 'nothing'} came at {self.port} in "
            f"{self.silence_s:g} s; check power, cable, "
            + ("command, command_end and " if self.command else "")
            + f"baudrate ({self.baudrate})"
        )

    def connected(self) -> None:
        self._pending = b""
        self._overlong = False
        self._last_bad_line = ""
        self._next_command_ns = self.clock.mono_ns()

    def step(self, line: SerialLine) -> Iterable[TemperatureSample]:
        wait_s = READ_TIMEOUT_S
        if self.command:
            now_ns = self.clock.mono_ns()
            if now_ns >= self._next_command_ns:
                self._next_command_ns = now_ns + round(self.interval_s * 1e9)
                line.write(self.command.encode("ascii") + TERMINATORS[self.command_end])
            wait_s = min(wait_s, (self._next_command_ns - now_ns) * 1e-9)
        data = line.read(max(wait_s, 0.001))
        now_ns = self.clock.mono_ns()
        samples = []
        for text in self._lines(data):
            samples += self._read(text, now_ns)
        return samples

    def _lines(self, data: bytes) -> Iterable[str]:
        """Complete lines, without empty ones; a line that is too long is dropped to its end."""
        *complete_lines, rest = re.split(rb"[\r\n\0]", self._pending + data)
        for piece in complete_lines:
            overlong, self._overlong = self._overlong, False
            if overlong or len(piece) > MAX_LINE:
                self._drop_line(len(piece))
            elif text := piece.decode("latin-1").strip():
                yield text
        if self._overlong or len(rest) > MAX_LINE:
            self.counters["bad_bytes"] += len(rest)
            self._overlong, rest = True, b""
        self._pending = rest

    def _drop_line(self, nbytes: int) -> None:
        self.counters["bad_bytes"] += nbytes
        self.counters["bad_messages"] += 1
        self._report_bad_line("a line that does not end")

    def _read(self, text: str, now_ns: int) -> list[TemperatureSample]:
        self.counters["lines"] += 1
        groups = self._pattern.search(text)
        if groups is None:
            self._bad_line(text)
            return []
        if set(self._pattern.groups) == {"channel", "value"}:
            if len(groups) < 2:
                self._bad_line(text)
                return []
            probe = self._probes.get(groups["channel"].strip())
            if probe is None:
                self.counters["other_channels"] += 1
                self.count_messages()
                return []
            readings = {probe: groups["value"]}
        else:
            names = dict(zip(self._pattern.groups, self.channels, strict=False))
            readings = {names[group]: reading for group, reading in groups.items()}
        samples = []
        for probe, reading in readings.items():
            try:
                value_c = self._celsius(reading.strip())
            except ValueError:
                continue
            samples.append(TemperatureSample(probe, value_c, now_ns))
        if len(samples) < len(readings):
            self._bad_line(text)
        if samples:
            self.count_messages()
        self.counters["readings"] += len(samples)
        return samples

    def _celsius(self, reading: str) -> float | None:
        """The reading in degC, None for an open sensor; ValueError if it is no temperature."""
        if reading.casefold() in self._open_sensor_labels:
            self.counters["open_sensors"] += 1
            return None
        if NUMBER.fullmatch(reading) is None:
            raise ValueError(reading)
        value = float(reading.replace(",", "."))
        value_c = {"C": value, "F": (value - 32) / 1.8, "K": value + ABSOLUTE_ZERO_C}[self.unit]
        if not ABSOLUTE_ZERO_C <= value_c <= MAX_TEMPERATURE_C:
            raise ValueError(reading)
        return value_c

    def _bad_line(self, text: str) -> None:
        self.counters["bad_messages"] += 1
        self._last_bad_line = text[:80]
        self._report_bad_line(f"{text[:80]!r}")

    def _report_bad_line(self, what: str) -> None:
        self.emitter.emit_throttled(
            "unreadable",
            f"The thermometer {self.name} at {self.port} sent {what}, which does not fit the "
            "pattern. Check pattern, open_sensor_labels, baud rate and parity.",
        )
