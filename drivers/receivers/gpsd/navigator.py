"""A gpsd as navigator: the connection, and the diagnosis if it sends nothing.

What its reports mean is in `drivers.receivers.gpsd.reports`; reconnecting and counting in
`drivers.transport.serial_device`, for which a connection is a line like any other.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar

from drivers.base.settings import Setting
from drivers.contract import DeviceError, NavSample
from drivers.receivers.fix_monitor import FixMonitor, fix_description
from drivers.receivers.gpsd.reports import GpsdReports
from drivers.timescales.clock import Clock
from drivers.transport.serial_device import READ_TIMEOUT_S, PortOpener, SerialDevice, SerialLine
from drivers.transport.tcp_port import SCHEME, TcpPort, open_tcp_port


def open_gpsd(path: str, baudrate: int, parity: str) -> TcpPort:
    """Connect to a gpsd.

    Args:
        path: host:port.
        baudrate: not used; a connection has none.
        parity: not used; a connection has none.

    Returns:
        The connection.

    Raises:
        DeviceError: the address does not answer; the message contains the remedy.
    """
    try:
        return open_tcp_port(SCHEME + path)
    except DeviceError as error:
        raise DeviceError(
            f"no gpsd answers at {path} ({error.__cause__ or error}); start it (Debian's gpsd), "
            "and check address and port"
        ) from error


class GpsdNavigator(SerialDevice):
    """A receiver behind a gpsd.

    Yields a NavSample for every TPV that has time and position, with the attitude of an ATT of the
    same instant. gpsd reports no event marks, and rounds its time to a millisecond: exposures of
    the mapping camera want the receiver's own driver.

    Source: gpsd_json(5), protocol 3.14.
    """

    kind: ClassVar = "navigator"
    what = "gpsd"
    silence_hint = "Check that its receiver is switched on and that gpsd watches it"

    port = Setting("127.0.0.1:2947", help="address and TCP port of the gpsd")
    device = Setting("", help="the receiver's path at the gpsd; empty: every one it has")

    def __init__(
        self,
        name: str,
        settings: Mapping[str, object],
        *,
        clock: Clock | None = None,
        open_port: PortOpener = open_gpsd,
    ) -> None:
        super().__init__(name, settings, clock=clock, open_port=open_port)
        self.reports = GpsdReports(name, self.device)
        self._is_watching = False
        self._fix = FixMonitor(self.emitter, self.clock, name)

    @classmethod
    def setting_conflicts(cls, values: Mapping[str, Any]) -> list[str]:
        host, _, port = values["port"].rpartition(":")
        if not host or not (port.isascii() and port.isdigit() and 0 < int(port[:6]) < 65536):
            return [f"port is {values['port']!r}; host:port, as 127.0.0.1:2947"]
        return []

    def line_settings(self) -> tuple[int, str]:
        return 0, "N"

    def identify(self, line: SerialLine) -> Mapping[str, str]:
        """Listen until a TPV comes, `silence_s` at most; returns the identity."""
        reports = self.reports
        deadline_ns = self.clock.mono_ns() + round(self.silence_s * 1e9)
        before = reports.seen["TPV"]
        while self.clock.mono_ns() < deadline_ns and not self._closing.is_set():
            for _ in self.step(line):
                pass
            if reports.seen["TPV"] > before:
                devices = ", ".join(reports.devices) or self.device
                return {
                    "release": reports.release,
                    "devices": devices,
                    "leap_seconds": reports.leap_seconds,
                    "fix": fix_description(reports.fix, reports.satellites),
                }
        if not reports.release:
            raise DeviceError(
                f"{self.name}: what answers at {self.port} is no gpsd; check the port"
            )
        if reports.devices and self.device and self.device not in reports.devices:
            raise DeviceError(
                f"{self.name}: the gpsd at {self.port} has no receiver {self.device}; it has "
                f"{', '.join(reports.devices)}"
            )
        if not reports.devices:
            raise DeviceError(
                f"{self.name}: the gpsd at {self.port} has no receiver; name its port in "
                "/etc/default/gpsd"
            )
        raise DeviceError(
            f"{self.name}: the receiver {', '.join(reports.devices)} of the gpsd at {self.port} "
            f"sent nothing in {self.silence_s:g} s; check its power and its baud rate"
        )

    def connected(self) -> None:
        self.reports.reset()
        self._fix.reset()
        self._is_watching = False

    def step(self, line: SerialLine) -> Iterable[NavSample]:
        if not self._is_watching:
            watch: dict[str, object] = {"enable": True, "json": True, "pps": True}
            if self.device:
                watch["device"] = self.device
            line.write(f"?WATCH={json.dumps(watch)};\n".encode())
            self._is_watching = True
        reports = self.reports
        bad, fix_report = reports.bad_messages, reports.seen["TPV"]
        data = line.read(READ_TIMEOUT_S)
        samples = reports.feed(data, self.clock.mono_ns())
        # A gpsd that lives while its receiver is silent is silent as a navigator.
        self.count_messages(messages=reports.seen["TPV"] - fix_report)
        self._fix.update(reports.fix, reports.satellites)
        if reports.bad_messages > bad:
            self.emitter.emit_throttled(
                "unreadable",
                f"The gpsd {self.name} at {self.port} sent what is no report of a gpsd. Check "
                "that the port is gpsd's own.",
            )
        if reports.error:
            self.emitter.emit_throttled(
                "refused", f"The gpsd {self.name} at {self.port} reports: {reports.error}."
            )
            reports.error = ""
        return samples

    def statistics(self) -> Mapping[str, int]:
        """Those of every serial device; samples, samples_by_leap_table, reports_without_fix, pps,
        other_devices."""
        return {
            **self.counters,
            **self.reports.counters,
            "bad_messages": self.reports.bad_messages,
            "bad_bytes": self.reports.bad_bytes,
        }
