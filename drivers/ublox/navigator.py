"""A u-blox receiver on a serial line.

What its bytes mean is in `drivers.ublox.decoder`; opening, reconnecting and counting in
`drivers.serial_device`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import ClassVar

from drivers.clock import Clock
from drivers.contract import DeviceError
from drivers.serial_device import (
    READ_STEP_S,
    PortOpener,
    SerialDevice,
    SerialLine,
    open_serial_port,
)
from drivers.settings import Setting
from drivers.ublox.decoder import Nav, UbxDecoder


class UbloxNavigator(SerialDevice):
    """A u-blox receiver (M8 or later) that sends UBX by itself.

    Yields a NavSample for every NAV-PVT and an EventMark for every rising edge of TIM-TM2. The
    receiver's configuration is left as it is; it has to send NAV-PVT, TIM-TM2, NAV-TIMEGPS and
    NAV-TIMELS on this port, with a navigation rate above the exposure rate, because TIM-TM2 holds
    only the last edge of an epoch.

    Source: u-blox M8 receiver description UBX-13003221.
    """

    kind: ClassVar = "navigator"
    what = "receiver"

    port = Setting("", required=True, says="serial port such as /dev/ttyUSB0, or tcp://host:port")
    baudrate = Setting(115200, minimum=4800, maximum=4_000_000, says="speed of the line, bit/s")
    parity = Setting("N", choices=("N", "E", "O"), says="parity on the wire")
    silence_s = Setting(
        3.0, minimum=0.5, maximum=3600, says="without a message for so long the device is silent"
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
        self.decoder = UbxDecoder(name)

    def line_settings(self) -> tuple[int, str]:
        return self.baudrate, self.parity

    def identify(self, line: SerialLine) -> Mapping[str, str]:
        """Listen until a NAV-PVT comes, `silence_s` at most; what was heard."""
        deadline_ns = self.clock.mono_ns() + round(self.silence_s * 1e9)
        while self.clock.mono_ns() < deadline_ns and not self._closing.is_set():
            for _ in self.step(line):
                pass
            if self.decoder.seen["NAV-PVT"]:
                heard = ", ".join(sorted(self.decoder.seen))
                leap = self.decoder.leap_seconds
                return {"messages": heard, "leap_seconds": "unknown" if leap is None else str(leap)}
        if self.decoder.frames:
            raise DeviceError(
                f"{self.name}: the receiver at {self.port} speaks UBX but sent no NAV-PVT in "
                f"{self.silence_s:g} s; switch on UBX-NAV-PVT and UBX-TIM-TM2 for this port"
            )
        if self.decoder.other_bytes > self.decoder.bad_bytes:
            raise DeviceError(
                f"{self.name}: the receiver at {self.port} sends text only; switch its output to "
                "UBX (UBX-NAV-PVT, UBX-TIM-TM2)"
            )
        if self.decoder.bad_bytes:
            raise DeviceError(
                f"{self.name}: what comes at {self.port} makes no sense at {self.baudrate} bit/s; "
                "set baudrate to the receiver's"
            )
        raise DeviceError(
            f"{self.name}: nothing came at {self.port} in {self.silence_s:g} s; check power, cable "
            "and the port's name"
        )

    def connected(self) -> None:
        self.decoder.reset()

    def step(self, line: SerialLine) -> Iterable[Nav]:
        frames, bad = self.decoder.frames, self.decoder.bad_messages
        data = line.read(READ_STEP_S)
        records = self.decoder.feed(data, self.clock.mono_ns())
        self.heard(messages=self.decoder.frames - frames)
        if self.decoder.bad_messages > bad:
            self.teller.complain(
                "checksum",
                f"The receiver {self.name} at {self.port} sent damaged messages. Check the cable, "
                "and whether the baud rate can carry all that is switched on.",
            )
        return records

    def statistics(self) -> Mapping[str, int]:
        """Those of every serial device; samples, marks, marks_without_rising_edge, marks_far."""
        return {
            **self.counters,
            **self.decoder.counters,
            "bad_messages": self.decoder.bad_messages,
            "bad_bytes": self.decoder.bad_bytes,
            "other_bytes": self.decoder.other_bytes,
        }
