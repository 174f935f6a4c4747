"""Base of receivers that send unrequested on a line: listening and identification.

What the bytes mean is in the decoder of each protocol; opening, reconnecting and silence are in
`drivers.transport.serial_device`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from typing import Final

from drivers.base.settings import Setting
from drivers.contract import DeviceError
from drivers.receivers.fix_monitor import FixMonitor, fix_description
from drivers.receivers.message_decoder import MessageDecoder
from drivers.timescales.clock import Clock
from drivers.transport.serial_device import (
    READ_TIMEOUT_S,
    PortOpener,
    Sample,
    SerialDevice,
    SerialLine,
    open_serial_port,
)

EDGE: Final = Setting(
    "rising", choices=("rising", "falling"), help="edge of the strobe at mid-exposure"
)
"""Of receivers that say which edge a mark is."""
OTHER_EDGE_LIMIT: Final = 3
"""So many marks of the other edge in succession: no mark of the configured one comes between."""


class StreamingNavigator(SerialDevice):
    """A receiver that sends by itself; its configuration is left as it is."""

    what = "receiver"
    protocol: str = ""
    """Name of what it speaks, for the operator's sentences."""
    required: tuple[str, ...] = ()
    """Any one of these messages is what `bind` waits for."""
    enable_hint: str = "switch it on for this port"
    """What the operator is to do where none of them comes."""

    port = Setting(
        "",
        required=True,
        help="serial port such as /dev/ttyUSB0, tcp://host:port or udpin://host:port",
    )
    baudrate = Setting(115200, minimum=4800, maximum=4_000_000, help="speed of the line, bit/s")
    parity = Setting("N", choices=("N", "E", "O"), help="parity on the wire")
    silence_s = Setting(
        3.0,
        minimum=0.5,
        maximum=3600,
        help="time without a message after which the device is reported silent",
    )

    def __init__(
        self,
        name: str,
        settings: Mapping[str, object],
        *,
        clock: Clock | None = None,
        open_port: PortOpener = open_serial_port,
    ) -> None:
        super().__init__(name, settings, clock=clock, open_port=open_port)
        self.decoder = self.new_decoder()
        self._fix = FixMonitor(self.emitter, self.clock, name)

    @abstractmethod
    def new_decoder(self) -> MessageDecoder:
        """The decoder of this protocol, with this device's settings.

        Returns:
            A new decoder.
        """

    def line_settings(self) -> tuple[int, str]:
        return self.baudrate, self.parity

    def identify(self, line: SerialLine) -> Mapping[str, str]:
        """Listen until a required message comes, `silence_s` at most; returns the identity."""
        deadline_ns = self.clock.mono_ns() + round(self.silence_s * 1e9)
        came = 0
        while self.clock.mono_ns() < deadline_ns and not self._closing.is_set():
            before = self.counters["bytes"]
            for _ in self.step(line):
                pass
            came += self.counters["bytes"] - before
            if any(self.decoder.seen[message] for message in self.required):
                leap = self.decoder.leap_seconds
                return {
                    "messages": ", ".join(sorted(self.decoder.seen)),
                    "leap_seconds": "unknown" if leap is None else str(leap),
                    "fix": fix_description(self.decoder.fix, self.decoder.satellites),
                }
        if self.decoder.frames:
            raise DeviceError(
                f"{self.name}: the receiver at {self.port} speaks {self.protocol} but sent no "
                f"{' or '.join(self.required)} in {self.silence_s:g} s; {self.enable_hint}"
            )
        if came:
            raise DeviceError(f"{self.name}: {self.undecodable_sentence()}")
        raise DeviceError(
            f"{self.name}: nothing came at {self.port} in {self.silence_s:g} s; check power, cable "
            "and the port's name"
        )

    def undecodable_sentence(self) -> str:
        """What the operator reads if bytes were received and none of them could be decoded.

        Returns:
            The sentence, without a full stop.
        """
        return (
            f"what comes at {self.port} is no {self.protocol}; check that the receiver sends "
            f"{self.protocol} here, and on a serial port that its speed is {self.baudrate} bit/s"
        )

    def connected(self) -> None:
        self.decoder.reset()
        self._fix.reset()

    def step(self, line: SerialLine) -> Iterable[Sample]:
        frames, bad = self.decoder.frames, self.decoder.bad_messages
        other_edges = self.decoder.other_edges
        records = self.decoder.feed(line.read(READ_TIMEOUT_S), self.clock.mono_ns())
        self.count_messages(messages=self.decoder.frames - frames)
        self._fix.update(self.decoder.fix, self.decoder.satellites)
        if self.decoder.bad_messages > bad:
            self.emitter.emit_throttled(
                "checksum",
                f"The receiver {self.name} at {self.port} sent damaged messages. Check the cable, "
                "and whether the line can carry all that is switched on.",
            )
        if self.decoder.other_edges >= max(OTHER_EDGE_LIMIT, other_edges + 1):
            self._on_other_edges(self.decoder.other_edges)
        return records

    def _on_other_edges(self, count: int) -> None:
        configured = str(self.configured["edge"])
        other = "rising" if configured == "falling" else "falling"
        self.emitter.emit_throttled(
            "other-edge",
            f"The receiver {self.name} at {self.port} reported {count} event marks of the {other} "
            f"edge and none of the {configured} one, which is configured: these exposures have no "
            f'mark. Set edge = "{other}" if that is mid-exposure, or switch the receiver\'s input '
            f"to the {configured} edge.",
        )

    def statistics(self) -> Mapping[str, int]:
        """Those of every serial device and those of the decoder."""
        return {
            **self.counters,
            **self.decoder.counters,
            "bad_messages": self.decoder.bad_messages,
            "bad_bytes": self.decoder.bad_bytes,
        }
