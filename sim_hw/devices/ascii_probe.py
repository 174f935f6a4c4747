"""An emulated instrument that sends temperatures as lines of text."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence

from sim_hw.devices.device_loop import DeviceLine, LineDevice
from sim_hw.devices.pseudo_terminal import PseudoTerminal
from sim_hw.world.world_clock import NS_PER_S

_COMMAND_MAX_BYTES = 64


class AsciiProbe(LineDevice):
    """The instrument, from `start()` to `close()`; a host opens `port`.

    `templates` are the lines of one reading in the manner of `str.format`: `{0}` is the first
    channel's value, formatted with `value_format`, or `open_sensor_text` where the channel gives
    None: an open sensor. It sends every `interval_s`, or, with a `command`, only when that is
    received, followed by CR or LF.

    Example:
        >>> probe = AsciiProbe([lambda: 21.34, lambda: None], ["T1={0} T2={1}"])
        >>> probe.reading()
        b'T1=+21.34 T2=OPEN\\r\\n'
        >>> probe.close()
    """

    def __init__(
        self,
        channels: Sequence[Callable[[], float | None]],
        templates: Sequence[str],
        *,
        value_format: str = "{:+.2f}",
        open_sensor_text: str = "OPEN",
        end: str = "\r\n",
        interval_s: float = 1.0,
        command: str = "",
        line: DeviceLine | None = None,
    ) -> None:
        super().__init__("ascii-probe", line or PseudoTerminal())
        self._channels = tuple(channels)
        self._templates = tuple(templates)
        self._value_format = value_format
        self._open_sensor_text = open_sensor_text
        self._end = end
        self._interval_ns = round(interval_s * NS_PER_S)
        self._command = command.encode("ascii")
        self._next_ns = time.monotonic_ns()
        self._pending = b""

    def statistics(self) -> Mapping[str, int]:
        names = ("readings", "commands", "unknown_commands")
        return {**super().statistics(), **{name: self.counts[name] for name in names}}

    def reading(self) -> bytes:
        """The lines of one reading."""
        self.counts["readings"] += 1
        values = [self._format_value(channel()) for channel in self._channels]
        lines = [template.format(*values) + self._end for template in self._templates]
        return "".join(lines).encode("latin-1")

    def due_mono_ns(self) -> int | None:
        return None if self._command else self._next_ns

    def emit_due(self) -> bytes:
        self._next_ns += self._interval_ns
        return self.reading()

    def on_received(self, data: bytes) -> bytes:
        if not self._command:
            return b""
        answer_bytes = (self._pending + data).replace(b"\n", b"\r").split(b"\r")
        self._pending = answer_bytes.pop()[-_COMMAND_MAX_BYTES:]
        answer = b""
        for values in filter(None, answer_bytes):
            if values == self._command:
                self.counts["commands"] += 1
                answer += self.reading()
            else:
                self.counts["unknown_commands"] += 1
        return answer

    def _format_value(self, value_c: float | None) -> str:
        if value_c is None or not math.isfinite(value_c):
            return self._open_sensor_text
        return self._value_format.format(value_c)
