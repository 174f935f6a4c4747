"""The emulated trigger unit, exactly as docs/reference/flight/pulse-bus.md describes it.

It counts, delays and reports when each output pulses; it knows no head.
"""

from __future__ import annotations

import heapq
import itertools
import queue
import selectors
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from sim_hw.faults.channel import BytesDamage, Channel

PROTOCOL_VERSION = 1
DELAY_MAX_NS = 1_000_000_000
SEQUENCE_MAX = 2**64 - 1
LINE_MAX_BYTES = 256
"""A longer line cannot be a command; it is refused as soon as it gets this long."""

_SEND_TIMEOUT_S = 0.5
_POLL_S = 0.5
_FAULT_POLL_S = 0.02
"""How often a unit with faults looks after them."""
_RECEIVE_BYTES = 4096


@dataclass(frozen=True)
class Firing:
    """One firing: the caller's `sequence`, the unit's `count` (from 1), and when each output
    pulses, by name, in monotonic ns."""

    sequence: int
    count: int
    pulses_mono_ns: Mapping[str, int]


class PulseBus:
    """The unit on a TCP port, from `start()` to `close()`; port 0 takes a free one.

    `on_fire` is called once per firing from a thread of the unit's own, after the answer has gone
    and normally before the delayed pulses are due. Delays and count last until power-off, whoever
    is connected.
    """

    def __init__(
        self,
        name: str,
        outputs: Sequence[str],
        on_fire: Callable[[Firing], None],
        address: tuple[str, int] = ("127.0.0.1", 0),
        faults: Channel[bytes] | None = None,
    ) -> None:
        for name_part in (name, *outputs):
            if (
                not name_part.isascii()
                or not name_part.isprintable()
                or " " in name_part
                or not name_part
            ):
                raise ValueError(
                    f"{name_part!r} cannot be a name on the pulse bus; use ASCII words"
                )
        self._name = name
        self._delays_ns = dict.fromkeys(outputs, 0)
        self._on_fire = on_fire
        self._wanted_address = address
        self._listener: socket.socket | None = None
        self._owner: socket.socket | None = None
        self._owner_address = ""
        self._line = b""
        self._count = 0
        self._firings: queue.Queue[Firing | None] = queue.Queue()
        self._stop = threading.Event()
        self._wake: tuple[socket.socket, socket.socket] | None = None
        self._threads: list[threading.Thread] = []
        self._counts: Counter[str] = Counter()
        self._faults = faults or Channel[bytes]((), BytesDamage(), seed=name)
        self._later: list[tuple[int, int, bytes]] = []
        self._order = itertools.count()
        self._was_connected = True

    @property
    def address(self) -> tuple[str, int]:
        """Where it listens; known after `start()`."""
        if self._listener is None:
            raise RuntimeError(f"pulse bus {self._name} has not been started")
        host, port = self._listener.getsockname()[:2]
        return str(host), int(port)

    def start(self) -> None:
        """Listen.

        Raises:
            OSError: the address is taken or not this host's.
        """
        self._listener = socket.create_server(self._wanted_address, backlog=8)
        self._listener.setblocking(False)
        self._wake = socket.socketpair()
        for name, target in (("serve", self._serve), ("fire", self._deliver)):
            thread = threading.Thread(target=target, name=f"pulse-bus-{name}", daemon=True)
            thread.start()
            self._threads.append(thread)

    def close(self) -> None:
        """Stop and hang up. May be called twice."""
        if self._wake is None or self._listener is None:
            return
        self._stop.set()
        self._firings.put(None)
        self._wake[1].send(b"\0")
        for thread in self._threads:
            thread.join(timeout=5.0)
        for end in self._wake:
            end.close()
        self._wake = None
        self._drop_owner()
        self._listener.close()

    def statistics(self) -> Mapping[str, int]:
        """Counters since creation, by stable name."""
        names = ("connections", "refused_connections", "lines", "refused_lines")
        return {"firings": self._count, **{name: self._counts[name] for name in names}}

    def _serve(self) -> None:
        assert self._listener is not None and self._wake is not None
        with selectors.DefaultSelector() as selector:
            selector.register(self._listener, selectors.EVENT_READ)
            selector.register(self._wake[0], selectors.EVENT_READ)
            while not self._stop.is_set():
                watched = self._owner
                if watched is not None:
                    selector.register(watched, selectors.EVENT_READ)
                ready = [key.fileobj for key, _ in selector.select(self._wait_timeout_s())]
                if not self._is_reachable():
                    if watched is not None:
                        selector.unregister(watched)
                    self._stop.wait(_FAULT_POLL_S)
                    continue
                self._send_what_is_due()
                if watched is not None:
                    selector.unregister(watched)
                # The owner's words first: one who hangs up makes room for the next.
                if watched is not None and watched in ready:
                    self._read_owner(watched)
                if self._listener in ready:
                    self._accept(self._listener)

    def _wait_timeout_s(self) -> float:
        return _POLL_S if self._faults.is_faultless else _FAULT_POLL_S

    def _is_reachable(self) -> bool:
        """Whether cable and power are there; what came meanwhile dies with its connection."""
        now_ns = time.monotonic_ns()
        if self._faults.has_power_cycled(now_ns):
            self._count = 0
            self._delays_ns = dict.fromkeys(self._delays_ns, 0)
        if not self._faults.is_connected(now_ns):
            self._was_connected = False
            return False
        if not self._was_connected:
            self._was_connected = True
            self._drop_owner()
        return True

    def _send_what_is_due(self) -> None:
        now_ns = time.monotonic_ns()
        while self._later and self._later[0][0] <= now_ns:
            data = heapq.heappop(self._later)[2]
            if self._owner is not None:
                self._send_bytes(self._owner, data)
        if self._owner is not None and self._faults.flood_is_due(now_ns):
            self._send_bytes(self._owner, b"FIRED 18446744073709551615 0\n")

    def _accept(self, listener: socket.socket) -> None:
        try:
            connection, peer = listener.accept()
        except OSError:
            return
        connection.settimeout(_SEND_TIMEOUT_S)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if self._owner is not None:
            self._counts["refused_connections"] += 1
            self._send(connection, f"ERR busy: owned by {self._owner_address}")
            connection.close()
            return
        self._counts["connections"] += 1
        self._owner, self._owner_address, self._line = connection, f"{peer[0]}:{peer[1]}", b""
        greeting = ["PULSEBUS", str(PROTOCOL_VERSION), self._name, *self._delays_ns]
        if not self._send_line(connection, " ".join(greeting)):
            self._drop_owner()

    def _read_owner(self, owner: socket.socket) -> None:
        try:
            received = owner.recv(_RECEIVE_BYTES)
        except OSError:
            received = b""
        received_mono_ns = time.monotonic_ns()
        if not received:
            self._drop_owner()
            return
        *lines, self._line = (self._line + received).split(b"\n")
        for line in lines:
            answer, firing = self._execute(line, received_mono_ns)
            if not self._send_line(owner, answer):
                self._drop_owner()
            if firing is not None:
                self._firings.put(firing)
        if len(self._line) > LINE_MAX_BYTES:
            self._line = b""
            self._counts["refused_lines"] += 1
            self._send(owner, f"ERR a line has at most {LINE_MAX_BYTES} bytes")

    def _execute(self, line: bytes, received_mono_ns: int) -> tuple[str, Firing | None]:
        """The answer to a line, and the firing it asks for."""
        self._counts["lines"] += 1
        fields = line.decode("ascii", errors="replace").rstrip("\r").split(" ")
        match fields:
            case ["STATUS"]:
                return f"STATUS {self._count}", None
            case ["FIRE", text]:
                sequence = _number(text, SEQUENCE_MAX)
                if sequence is None:
                    return self._refuse("a sequence is an unsigned 64-bit number"), None
                if self._faults.counter_restarts(received_mono_ns):
                    self._count = 0
                self._count += 1
                pulses = {
                    output: received_mono_ns + delay for output, delay in self._delays_ns.items()
                }
                firing = Firing(sequence, self._count, pulses)
                return f"FIRED {sequence} {self._count}", firing
            case ["DELAY", output, text]:
                if output not in self._delays_ns:
                    known = ", ".join(self._delays_ns)
                    return self._refuse(f"no such output; the outputs are {known}"), None
                delay_ns = _number(text, DELAY_MAX_NS)
                if delay_ns is None:
                    return self._refuse(f"a delay is 0 to {DELAY_MAX_NS} ns"), None
                self._delays_ns[output] = delay_ns
                return f"OK DELAY {output} {delay_ns}", None
        return self._refuse("expected DELAY output delay_ns, FIRE sequence or STATUS"), None

    def _refuse(self, sentence: str) -> str:
        self._counts["refused_lines"] += 1
        return f"ERR {sentence}"

    def _send_line(self, owner: socket.socket, line: str) -> bool:
        """Send a line to the owner, as far as the faults let it pass."""
        data = line.encode("ascii", errors="replace") + b"\n"
        now_ns = time.monotonic_ns()
        for delivery in self._faults.send(data, now_ns):
            if delivery.at_ns <= now_ns:
                if not self._send_bytes(owner, delivery.message):
                    return False
            else:
                heapq.heappush(self._later, (delivery.at_ns, next(self._order), delivery.message))
        return True

    def _send(self, connection: socket.socket, line: str) -> bool:
        return self._send_bytes(connection, line.encode("ascii", errors="replace") + b"\n")

    def _send_bytes(self, connection: socket.socket, data: bytes) -> bool:
        try:
            connection.sendall(data)
        except OSError:
            return False
        return True

    def _drop_owner(self) -> None:
        if self._owner is not None:
            self._owner.close()
        self._owner, self._owner_address, self._line = None, "", b""
        self._later.clear()

    def _deliver(self) -> None:
        while (firing := self._firings.get()) is not None:
            self._on_fire(firing)


def _number(text: str, maximum: int) -> int | None:
    """A decimal number from 0 to `maximum`; None for anything else."""
    if not text.isascii() or not text.isdigit() or len(text) > len(str(SEQUENCE_MAX)):
        return None
    value = int(text)
    return value if value <= maximum else None
