"""The client of a pulse bus: a trigger unit behind a TCP port.

The protocol is in docs/reference/flight/pulse-bus.md.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping
from typing import ClassVar, Final, Protocol

from drivers.base.settings import Configured, Setting
from drivers.contract import DeviceError, TriggerPulse
from drivers.timescales.clock import Clock, MonotonicClock
from drivers.triggers.delays import check_delays

PROTOCOL: Final = ("PULSEBUS", "1")
MAX_LINE: Final = 4096
MAX_STALE_ANSWERS: Final = 32
"""Number of earlier answers that may still arrive twice or late."""


class SocketLike(Protocol):
    """The used part of a `socket.socket`."""

    def settimeout(self, value: float, /) -> None:
        """As of `socket.socket`.

        Args:
            value: longest wait of an operation, s.
        """

    def sendall(self, data: bytes, /) -> None:
        """As of `socket.socket`.

        Args:
            data: bytes to send, all of them.
        """

    def recv(self, size: int, /) -> bytes:
        """As of `socket.socket`.

        Args:
            size: largest number of bytes.

        Returns:
            Received bytes; empty if the other end closed the connection.
        """

    def shutdown(self, how: int, /) -> None:
        """As of `socket.socket`.

        Args:
            how: direction, such as `socket.SHUT_RDWR`.
        """

    def close(self) -> None:
        """Release the socket."""


Connect = Callable[[str, int, float], SocketLike]
"""Connects to host and port within a time-out in seconds; OSError if that fails."""


def connect_tcp(host: str, port: int, timeout_s: float) -> SocketLike:
    """A TCP connection that sends every line without delay (TCP_NODELAY).

    Args:
        host: name or address of the unit.
        port: TCP port.
        timeout_s: longest wait for the connection, s.

    Returns:
        The connected socket.

    Raises:
        OSError: the unit does not answer.
    """
    connection = socket.create_connection((host, port), timeout=timeout_s)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


class PulseBusTrigger(Configured):
    """A trigger unit with the pulse bus protocol.

    A pulse without an answer is not fired again, since the heads may have been triggered. The
    connection is closed. The next call reconnects with the delays of the last `program`.

    Source: docs/reference/flight/pulse-bus.md.
    """

    kind: ClassVar = "trigger"
    head_trigger_source: ClassVar = "line"
    """The `trigger_source` that heads need for this trigger."""

    host = Setting("127.0.0.1", required=False, help="address of the unit")
    port = Setting(0, required=True, minimum=1, maximum=65535, help="TCP port of the unit")
    timeout_s = Setting(0.5, minimum=0.05, maximum=5, help="longest wait for an answer")

    def __init__(
        self,
        name: str,
        settings: Mapping[str, object],
        *,
        clock: Clock | None = None,
        connect: Connect = connect_tcp,
    ) -> None:
        super().__init__(name, settings)
        self._clock: Clock = clock or MonotonicClock()
        self._connect_to = connect
        self._lock = threading.Lock()
        self._socket: SocketLike | None = None
        self._received = b""
        self._delays_ns: dict[str, int] = {}
        self._earlier: deque[str] = deque(maxlen=MAX_STALE_ANSWERS)
        self._unit = ""
        self._outputs: tuple[str, ...] = ()
        self._closed = False
        self._count: int | None = None
        """The unit's count of pulses; None if it is unknown."""
        self._counters: Counter[str] = Counter(
            pulses=0, failures=0, answers_lost=0, opened=0, stale_answers=0
        )

    def bind(self) -> Mapping[str, str]:
        """Connect. See `drivers.contract.Trigger`.

        Returns:
            The unit's name, address, outputs and count of pulses.

        Raises:
            DeviceError: no pulse bus of version 1 answers, or it is in use.
        """
        with self._lock:
            self._connect()
            self._count = self._query_count()
            return {
                "unit": self._unit,
                "address": f"{self.host}:{self.port}",
                "outputs": " ".join(self._outputs),
                "count": str(self._count),
            }

    def program(self, delays_ns: Mapping[str, int]) -> None:
        """Set the delay of every output named.

        Args:
            delays_ns: delay from firing by output, ns.

        Raises:
            DeviceError: unknown output, delay out of range, or no answer.
        """
        with self._lock:
            self._connect()
            check_delays(self.name, delays_ns, self._outputs)
            self._delays_ns.update(delays_ns)
            try:
                self._send_delays()
            except DeviceError:
                if self._socket is not None:
                    raise
                # The connection is lost; a new one sends the delays again, which is harmless.
                self._connect()

    def fire(self, sequence: int) -> TriggerPulse:
        """Fire one pulse.

        The time is the middle of the round trip, its sigma half of it. If the answer is lost, the
        driver reconnects and compares the unit's count. If the unit has fired, the time is between
        the request and the time-out, and sigma is half of that interval.

        Args:
            sequence: number of the pulse, echoed by the unit.

        Returns:
            The pulse, with the unit's own count.

        Raises:
            DeviceError: no unit, refused, or no answer in time. If the count cannot be read either,
                it is unknown whether the unit has fired.
        """
        with self._lock:
            before_ns: int | None = None
            try:
                self._connect()
                before_ns = self._clock.mono_ns()
                echo, count = self._command(f"FIRE {sequence}", "FIRED", field_count=2)
                after_ns = self._clock.mono_ns()
                if echo != str(sequence) or not count.isdecimal():
                    raise self._lost(f"FIRE {sequence}", f"it answered for {echo}")
            except DeviceError:
                self._counters["failures"] += 1
                after_ns = self._clock.mono_ns()
                # A unit that refuses sends an error and stays connected.
                if before_ns is None or self._socket is not None or not self._has_fired():
                    raise
                self._counters["answers_lost"] += 1
                count = str(self._count)
            self._count = int(count)
            self._counters["pulses"] += 1
        sigma_ns = (after_ns - before_ns + 1) // 2
        return TriggerPulse(sequence, before_ns + sigma_ns, sigma_ns, self._count)

    def close(self) -> None:
        """Disconnect; may be called twice. A pending wait for an answer is ended."""
        self._closed = True
        unit = self._socket
        if unit is not None:
            with contextlib.suppress(OSError):
                unit.shutdown(socket.SHUT_RDWR)
        with self._lock:
            self._disconnect()

    def statistics(self) -> Mapping[str, int]:
        """Counters since creation.

        Returns:
            pulses, failures, answers_lost (of pulses that were fired), opened, stale_answers.
        """
        return dict(self._counters)

    # The connection; the lock is held

    def _has_fired(self) -> bool:
        """Whether the unit's count, read again, has increased by one."""
        known, self._count = self._count, None
        try:
            self._connect()
            self._count = self._query_count()
        except DeviceError:
            return False
        return known is not None and self._count == known + 1

    def _query_count(self) -> int:
        count = self._command("STATUS", "STATUS")[0]
        if not count.isdecimal():
            raise self._lost("STATUS", f"the count {count!r} is invalid")
        return int(count)

    def _connect(self) -> None:
        if self._closed:
            raise DeviceError(f"{self.name}: the trigger is closed; create a new one")
        if self._socket is not None:
            return
        try:
            self._socket = self._connect_to(self.host, self.port, self.timeout_s)
        except OSError as error:
            self._disconnect()
            raise DeviceError(
                f"{self.name}: no trigger unit at {self.host}:{self.port} "
                f"({error.strerror or error}); check its power, cable, host and port"
            ) from error
        greeting = self._line("its greeting").split()
        if greeting[:1] == ["ERR"]:
            self._disconnect()
            raise DeviceError(
                f"{self.name}: the trigger unit reports {' '.join(greeting[1:])!r}; end the "
                "program that uses it"
            )
        if tuple(greeting[:2]) != PROTOCOL or len(greeting) < 3:
            self._disconnect()
            raise DeviceError(
                f"{self.name}: {self.host}:{self.port} greets with {' '.join(greeting)!r}, not as "
                "a pulse bus of version 1; check host and port"
            )
        self._unit, self._outputs = greeting[2], tuple(greeting[3:])
        self._counters["opened"] += 1
        self._send_delays()

    def _send_delays(self) -> None:
        for output, delay_ns in self._delays_ns.items():
            echo = self._command(f"DELAY {output} {delay_ns}", "OK", field_count=3)
            if echo != ["DELAY", output, str(delay_ns)]:
                self._disconnect()
                raise DeviceError(
                    f"{self.name}: DELAY {output} {delay_ns} was answered with {' '.join(echo)!r}; "
                    "the unit is at fault, switch it off and on"
                )

    def _command(self, command: str, expected: str, *, field_count: int = 1) -> list[str]:
        """Send a line; returns the words after the expected one in the answer."""
        assert self._socket is not None
        try:
            self._socket.sendall(command.encode("ascii") + b"\n")
        except OSError as error:
            raise self._lost(command, error.strerror or str(error)) from error
        answer = self._answer(command)
        if answer[:1] == ["ERR"]:
            raise DeviceError(
                f"{self.name}: the trigger unit refuses {command!r}: {' '.join(answer[1:])}; "
                "nothing was done"
            )
        if answer[:1] != [expected] or len(answer) != field_count + 1:
            raise self._lost(command, f"the answer {' '.join(answer)!r} is invalid")
        return answer[1:]

    def _answer(self, command: str) -> list[str]:
        """The words of the next line that is not a repeated answer to an earlier command."""
        verb, *rest = command.split()
        answered = " ".join(("FIRED" if verb == "FIRE" else f"OK {verb}", *rest))
        deadline_ns = self._clock.mono_ns() + round(self.timeout_s * 1e9)
        while True:
            line = self._line(command, deadline_ns)
            stale = next((a for a in self._earlier if (line + " ").startswith(a + " ")), None)
            if stale is None or stale == answered:
                self._earlier.append(answered)
                return line.split()
            self._counters["stale_answers"] += 1

    def _line(self, command: str, deadline_ns: int | None = None) -> str:
        """The next line, within one time-out in total."""
        assert self._socket is not None
        if deadline_ns is None:
            deadline_ns = self._clock.mono_ns() + round(self.timeout_s * 1e9)
        while b"\n" not in self._received:
            left_s = (deadline_ns - self._clock.mono_ns()) * 1e-9
            if left_s <= 0:
                raise self._lost(command, f"no answer within {self.timeout_s:g} s")
            try:
                self._socket.settimeout(left_s)
                piece = self._socket.recv(MAX_LINE)
            except TimeoutError:
                continue
            except OSError as error:
                raise self._lost(command, error.strerror or str(error)) from error
            if not piece or len(self._received) > MAX_LINE:
                raise self._lost(
                    command, "the unit closed the connection" if not piece else "no end of line"
                )
            self._received += piece
        line, _, self._received = self._received.partition(b"\n")
        return line.decode("ascii", errors="replace")

    def _lost(self, command: str, why: str) -> DeviceError:
        """Close the connection: a late answer must not be taken for that of the next command."""
        self._disconnect()
        fired = "; whether the heads fired is not known" if command.startswith("FIRE") else ""
        return DeviceError(
            f"{self.name}: trigger unit at {self.host}:{self.port}, command {command}: {why}"
            f"{fired}; the next pulse reconnects, check power and cable"
        )

    def _disconnect(self) -> None:
        unit, self._socket = self._socket, None
        self._received = b""
        self._earlier.clear()
        if unit is not None:
            with contextlib.suppress(OSError):
                unit.close()
