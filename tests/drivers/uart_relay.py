"""A serial cable with a speed of its own: what a host receives that listens at another one.

A pseudo-terminal carries bytes whatever speed was set. Here they go through the levels of a real
line: sent bit by bit at the device's speed and sampled at the host's, both ways.
"""

from __future__ import annotations

import os
import select
import termios
import threading
import tty
from types import TracebackType
from typing import Final

SPEEDS: Final = {
    getattr(termios, f"B{baudrate}"): baudrate
    for baudrate in (
        300, 4800, 9600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 500_000, 921_600,
    )
}  # fmt: skip
IDLE_BITS: Final = 1.0
"""Between two bytes of one burst: a stop bit may be longer than one bit."""


def levels(data: bytes) -> list[int]:
    """Start bit, eight data bits from the lowest, stop bit; one entry a bit."""
    line = []
    for byte in data:
        line += [0, *((byte >> bit) & 1 for bit in range(8)), 1]
    return line


def sampled(data: bytes, sent_baud: int, read_baud: int) -> bytes:
    """What a receiver at `read_baud` makes of bytes sent at `sent_baud`, with idle lines around.

    It waits for a falling edge and then samples in the middle of its own bits. A byte without its
    stop bit is a framing error, which Linux delivers as NUL.
    """
    if sent_baud == read_baud:
        return data
    line = levels(data)
    ratio = sent_baud / read_baud

    def level(at: float) -> int:
        """The line at a time in bits of the sender; idle is high."""
        return line[int(at)] if 0 <= at < len(line) else 1

    received = bytearray()
    at = 0.0
    while at < len(line):
        if level(at) == 1:
            # Edges lie at whole bits of the sender.
            at = int(at) + 1.0
            continue
        bits = [level(at + (number + 1.5) * ratio) for number in range(9)]
        received.append(sum(bit << number for number, bit in enumerate(bits[:8])) if bits[8] else 0)
        at += 9.5 * ratio
    return bytes(received)


class UartRelay:
    """Joins a host at `port` with a device's port over a line of the device's speed and parity."""

    def __init__(self, device_port: str, baudrate: int) -> None:
        self._baudrate = baudrate
        self._host, host_end = os.openpty()
        tty.setraw(host_end)
        self.port = os.ttyname(host_end)
        os.close(host_end)
        self._device = os.open(device_port, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._device)
        # A host that has gone makes a port ready; once it is back, reading would wait for it.
        for fd in (self._host, self._device):
            os.set_blocking(fd, False)
        self._end_read, self._end_write = os.pipe()
        self._thread = threading.Thread(target=self._pump, daemon=True)
        self.speeds: set[int] = set()
        """At which the host has listened."""

    def __enter__(self) -> UartRelay:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        os.write(self._end_write, b"x")
        self._thread.join(5)
        for fd in (self._host, self._device, self._end_read, self._end_write):
            os.close(fd)

    def _speed(self) -> int:
        """The speed the host has set; both ends of a pseudo-terminal share it."""
        speed = SPEEDS[termios.tcgetattr(self._host)[4]]
        self.speeds.add(speed)
        return speed

    def _host_is_there(self) -> bool:
        poll = select.poll()
        poll.register(self._host, 0)
        return not any(event & select.POLLHUP for _, event in poll.poll(0))

    def _pump(self) -> None:
        while True:
            is_there = self._host_is_there()
            ends = [self._device, self._end_read, *([self._host] if is_there else [])]
            ready, _, _ = select.select(ends, [], [], 0.05)
            if self._end_read in ready:
                return
            try:
                if self._device in ready:
                    data = os.read(self._device, 4096)
                    if self._host_is_there():
                        os.write(self._host, sampled(data, self._baudrate, self._speed()))
                if self._host in ready:
                    data = os.read(self._host, 4096)
                    os.write(self._device, sampled(data, self._speed(), self._baudrate))
            except OSError:
                # The host closes and opens the port between two speeds.
                continue
