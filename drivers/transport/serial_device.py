"""Base of devices on a serial line: opening, reconnecting, counting, and receive time-outs.

The driver of each device decodes the bytes in `step` and `identify`.
"""

from __future__ import annotations

import errno
import fcntl
import termios
import threading
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import Any, Final, Protocol

import serial

from drivers import DriverError
from drivers.base.device import DeviceDriver
from drivers.base.settings import Setting
from drivers.contract import (
    ClockReading,
    DeviceError,
    EventMark,
    LifeCycle,
    NavSample,
    RawBytes,
    Sink,
    TemperatureSample,
)
from drivers.timescales.clock import Clock
from drivers.transport.line_errors import LineErrors, overrun_sentence
from drivers.transport.port_users import (
    holders,
    is_pseudo_terminal,
    other_holders,
    port_in_use_sentence,
)
from drivers.transport.tcp_port import SCHEME, open_tcp_port
from drivers.transport.udp_port import (
    LISTEN_SCHEME,
    SEND_SCHEME,
    SenderFilter,
    UdpPort,
    open_udp_port,
)

READ_TIMEOUT_S: Final = 0.2
"""Longest wait for bytes before the driver checks whether it is closed."""
WRITE_TIMEOUT_S: Final = 1.0
UNLOGGED_MAX: Final = 4096
"""Maximum number of chunks that are kept until a log exists."""

STALE_SUFFIX: Final = ".stale"
"""Suffix of the log name of bytes that were drained, not decoded."""

Sample = NavSample | EventMark | TemperatureSample | ClockReading


class SerialPort(Protocol):
    """The used part of `serial.Serial`."""

    timeout: Any

    @property
    def in_waiting(self) -> int:
        """Number of bytes that `read` returns without waiting."""

    def read(self, size: int = ...) -> bytes:
        """Read received bytes.

        Args:
            size: largest number of bytes.

        Returns:
            The bytes; fewer than `size` if no more come within `timeout` seconds.
        """

    def write(self, data: bytes, /) -> int | None:
        """Send bytes.

        Args:
            data: all of them are sent.

        Returns:
            Number of bytes sent.
        """

    def close(self) -> None:
        """Release the port."""


class LineLostError(DriverError):
    """The open port was lost; internal to the serial drivers."""


class SerialLine:
    """One open port. Every byte read is counted and passed to the flight log."""

    def __init__(
        self,
        port: SerialPort,
        received: Callable[[bytes], None],
        stale: Callable[[bytes], None] = lambda _data: None,
    ) -> None:
        self._port = port
        self._received = received
        self._stale = stale

    def read(self, timeout_s: float) -> bytes:
        """Wait for bytes.

        Args:
            timeout_s: longest wait for the first byte, s.

        Returns:
            All received bytes; may be empty.

        Raises:
            LineLostError: the port is lost.
        """
        data = self._take(timeout_s)
        if data:
            self._received(data)
        return data

    def drain(self, steps: int) -> int:
        """Remove unrequested bytes.

        They are logged separately, so that a replay does not take them for an answer.

        Args:
            steps: largest number of reads, for a line that sends without end.

        Returns:
            Number of bytes removed.

        Raises:
            LineLostError: the port is lost.
        """
        count = 0
        for _ in range(steps):
            data = self._take(0.0)
            if not data:
                break
            self._stale(data)
            count += len(data)
        return count

    def _take(self, timeout_s: float) -> bytes:
        try:
            self._port.timeout = timeout_s
            data = bytes(self._port.read(1))
            waiting = self._port.in_waiting if data else 0
            if waiting:
                data += bytes(self._port.read(waiting))
        # Quirk: pyserial raises termios.error or OSError for a device that was unplugged, and
        # TypeError for a port that another thread closes.
        # Upstream: pyserial/pyserial#401, pyserial/pyserial#417, pyserial/pyserial#713.
        except (serial.SerialException, OSError, termios.error, TypeError) as error:
            raise LineLostError(_reason(error)) from error
        return data

    def write(self, data: bytes) -> None:
        """Send bytes.

        Args:
            data: all of them are sent.

        Raises:
            LineLostError: the port is lost or accepts nothing for WRITE_TIMEOUT_S.
        """
        try:
            self._port.write(data)
        except (serial.SerialException, OSError, termios.error, TypeError) as error:
            raise LineLostError(_reason(error)) from error

    def close(self) -> None:
        """Release the port; one that is lost may refuse."""
        # A lost port may refuse to close; there is nothing left to release.
        try:
            self._port.close()
        except (serial.SerialException, OSError, termios.error):
            return


PortOpener = Callable[[str, int, str], SerialPort]


def open_serial_port(path: str, baudrate: int, parity: str) -> SerialPort:
    """Open a port exclusively, with 8 data bits and one stop bit; or a network address.

    A port that another program has open is refused, since each would receive a part of the bytes.

    Args:
        path: serial port; or tcp://host:port, udpin://host:port (listens; with ?from=ADDRESS to
            that sender only), udpout://host:port (sends first).
        baudrate: bit/s; not used for a network address.
        parity: "N", "E" or "O"; not used for a network address.

    Returns:
        The open port; its reads wait up to READ_TIMEOUT_S until `timeout` is set.

    Raises:
        DeviceError: it cannot be opened or another program uses it; the message states the reason,
            the program if it is visible, and the remedy.
    """
    if path.startswith(SCHEME):
        return open_tcp_port(path)
    if path.startswith((LISTEN_SCHEME, SEND_SCHEME)):
        return open_udp_port(path)
    try:
        port = serial.Serial(
            path,
            baudrate=baudrate,
            parity=parity,
            timeout=READ_TIMEOUT_S,
            write_timeout=WRITE_TIMEOUT_S,
            exclusive=True,
        )
    except (serial.SerialException, OSError, termios.error, ValueError) as error:
        number = getattr(error, "errno", None) or (error.args[0] if error.args else None)
        # Quirk: a pseudo-terminal refuses parity. Upstream: pyserial/pyserial#196.
        if number == errno.EINVAL and parity != "N":
            hint = f'parity {parity} is refused, as a pseudo-terminal does; set parity = "N" there'
        elif number == errno.ENOENT:
            hint = "there is no such port; check the cable and the port's name"
        elif number in (errno.EACCES, errno.EPERM):
            hint = "permission denied; add the service's user to the group dialout"
        elif number == errno.EBUSY or "lock" in str(error):
            hint = port_in_use_sentence(path, holders(path))
        else:
            hint = f"{_reason(error)}; check the cable, the port's name and its settings"
        raise DeviceError(f"port {path} cannot be opened: {hint}") from error
    if others := other_holders(path):
        port.close()
        raise DeviceError(f"port {path} cannot be opened: {port_in_use_sentence(path, others)}")
    if not is_pseudo_terminal(path):
        _lock_port(port)
    return port


def _lock_port(port: serial.Serial) -> None:
    """Make the kernel refuse the port to other programs."""
    # Quirk: pyserial's exclusive access is an flock, which programs such as gpsd ignore.
    # Upstream: pyserial/pyserial#206, jclark/satpulse#117.
    # A driver without terminal settings refuses this; the lock itself is set.
    with suppress(OSError):
        fcntl.ioctl(port.fileno(), termios.TIOCEXCL)


def _port_shared_sentence(path: str) -> str:
    """The other present users of a port, as a sentence to append; empty if none is visible."""
    others = [] if "://" in path else other_holders(path)
    return f" The port is shared: {port_in_use_sentence(path, others)}." if others else ""


def _reason(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


class SerialDevice(DeviceDriver):
    """A device on a serial line, run by one thread of the caller.

    A driver declares its settings, and listens or sends requests in `step`. It calls
    `count_messages` for every decoded message. No byte from the line raises out of `run`.
    """

    port = Setting("", required=True, help="serial port, such as /dev/ttyUSB0")
    silence_s = Setting(
        5.0,
        minimum=0.5,
        maximum=3600,
        help="time without a message after which the device is reported silent",
    )

    counted = (
        "bytes",
        "messages",
        "bad_messages",
        "bad_bytes",
        "timeouts",
        "opened",
        "silences",
    )
    delivery_counter = "messages"
    what: str = "device"
    """The type of device in event sentences."""
    silence_hint: str = "Check its power, wiring and baud rate"
    """The remedy if the device is silent."""

    def __init__(
        self,
        name: str,
        settings: Mapping[str, object],
        *,
        clock: Clock | None = None,
        open_port: PortOpener = open_serial_port,
    ) -> None:
        super().__init__(name, settings, clock=clock)
        self._open_port = open_port
        self._lock = threading.Lock()
        self._line: SerialLine | None = None
        self._last_message_ns = 0
        self._is_silent = False
        self._sender: SenderFilter | None = None
        self._line_errors = LineErrors(None)
        self._unlogged: deque[RawBytes] = deque(maxlen=UNLOGGED_MAX)

    # Overridden by drivers

    @abstractmethod
    def line_settings(self) -> tuple[int, str]:
        """Settings of the line.

        Returns:
            Baud rate, bit/s, and parity, "N", "E" or "O".
        """

    @abstractmethod
    def identify(self, line: SerialLine) -> Mapping[str, str]:
        """Query the identity.

        Args:
            line: the open line.

        Returns:
            Text by name.

        Raises:
            DeviceError: no suitable device answers; the message contains the remedy.
            LineLostError: the port is lost.
        """

    @abstractmethod
    def step(self, line: SerialLine) -> Iterable[Sample]:
        """Listen or send a request once, for a second at most.

        Args:
            line: the open line.

        Returns:
            The samples that were decoded.

        Raises:
            LineLostError: the port is lost.
        """

    def connected(self) -> None:
        """A port was opened: discard messages that are incomplete."""

    def is_identified(self) -> bool:
        """Whether the messages are of the device itself, not of another one on its bus.

        Returns:
            True unless a driver overrides it.
        """
        return True

    def count_messages(self, *, messages: int = 1) -> None:
        """Count messages that were decoded just now.

        Args:
            messages: their number; 0 or less has no effect.
        """
        if messages <= 0:
            return
        self.counters["messages"] += messages
        if self._sender is not None and self.is_identified():
            self._sender.lock()
        self._last_message_ns = self.clock.mono_ns()
        if self._is_silent:
            self._is_silent = False
            self.emitter.emit(
                "recovered", f"The {self.what} {self.name} sends data again; nothing to do."
            )

    # Interface of Device

    def bind(self) -> Mapping[str, str]:
        """Open the port and query the identity. See `drivers.contract.Device`.

        Returns:
            The port, and what `identify` returns.

        Raises:
            DeviceError: the port cannot be opened or was lost, or no suitable device answers.
        """
        if self._line is None:
            self._line = self._open()
        try:
            found = {"port": self.port, **self.identify(self._line)}
        except LineLostError as error:
            self._release_device()
            raise DeviceError(
                f"{self.name}: port {self.port} was lost: {error}; check the cable"
            ) from error
        except DeviceError as error:
            self._release_device()
            if self._sender is None or not self._sender.others:
                raise
            raise DeviceError(f"{error}; {self._sender.sentence()}") from error
        self._state = LifeCycle.BOUND
        return found

    # Implementation

    def _open_device(self) -> None:
        self._line = self._line or self._open()

    def _emit_opened(self) -> None:
        # Bytes received by `bind` are logged as well: a replay begins with them.
        while self._unlogged and self.emitter.sink is not None:
            self.emitter.sink(self._unlogged.popleft())
        # A silent line is reopened repeatedly; that is not reported.
        if self._is_lost or not self._is_silent:
            self.emitter.emit("opened", f"The {self.what} {self.name} is open at {self.port}.")

    def _open(self) -> SerialLine:
        baudrate, parity = self.line_settings()
        try:
            port = self._open_port(self.port, baudrate, parity)
        except DeviceError as error:
            raise DeviceError(f"{self.name}: {error}") from error
        self.counters["opened"] += 1
        if isinstance(port, UdpPort) and port.sender is not None:
            # The accepted sender does not change when the port is reopened.
            self._sender = port.sender = self._sender or port.sender
        self._line_errors = LineErrors(port)
        self.connected()
        return SerialLine(port, self._received, lambda data: self._received(data, STALE_SUFFIX))

    def _received(self, data: bytes, suffix: str = "") -> None:
        self.counters["bytes"] += len(data)
        raw = RawBytes(self.name + suffix, self.clock.mono_ns(), data)
        if self.emitter.sink is not None:
            self.emitter.sink(raw)
        else:
            self._unlogged.append(raw)

    def _serve(self, sink: Sink) -> None:
        """Listen until closing, loss, or a receive time-out, after which the port is reopened."""
        line = self._line
        assert line is not None
        self._begin_delivery()
        self._last_message_ns = self.clock.mono_ns()
        silence_ns = round(self.silence_s * 1e9)
        while not self._closing.is_set():
            try:
                for sample in self.step(line):
                    sink(sample)
                self._count_other_senders()
                self._count_line_errors()
            except LineLostError as error:
                self._state = LifeCycle.INACTIVE
                self._emit_lost(
                    f"The {self.what} {self.name} at {self.port} was lost ({error}). Check cable "
                    f"and power. Reconnecting automatically.{_port_shared_sentence(self.port)}"
                )
                return
            if self.clock.mono_ns() - self._last_message_ns >= silence_ns:
                self._emit_silent()
                return

    def _count_other_senders(self) -> None:
        if self._sender is None or self._sender.others == self.counters["other_senders"]:
            return
        self.counters["other_senders"] = self._sender.others
        self.emitter.emit_throttled(
            "other-sender",
            f"The {self.what} {self.name} at {self.port}: {self._sender.sentence()}.",
        )

    def _count_line_errors(self) -> None:
        self.counters.update(found := self._line_errors.new())
        if count := found["overruns"]:
            sentence = overrun_sentence(f"{self.what} {self.name}", self.port, count)
            self.emitter.emit_throttled("overrun", sentence)

    def _emit_silent(self) -> None:
        if self._is_silent:
            return
        self._is_silent = True
        self.counters["silences"] += 1
        self.emitter.emit(
            "silent",
            f"The {self.what} {self.name} at {self.port} sent no valid data for "
            f"{self.silence_s:g} s. {self.silence_hint}. Reconnecting automatically."
            f"{_port_shared_sentence(self.port)}",
            fault=True,
        )

    def _release_device(self) -> None:
        with self._lock:
            line, self._line = self._line, None
        if line is not None:
            line.close()
