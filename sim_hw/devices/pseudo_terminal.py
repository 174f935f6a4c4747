"""The device's end of a serial line: a pseudo-terminal whose other end any program can open."""

from __future__ import annotations

import errno
import os
import select
import tty
from pathlib import Path

_READ_BYTES = 4096


class PseudoTerminal:
    """A raw pseudo-terminal; `port` is the path a host program opens as its serial port.

    No method blocks on a host that does not read. Bytes for a port that is not open are
    lost, as on a cable that is plugged into nothing.
    """

    def __init__(self, link: Path | None = None) -> None:
        """`link`: a name for the port that stays the same when the cable is pulled and back."""
        self._link = link
        self._device = -1
        self.port = ""
        self.plug_in()

    def plug_in(self) -> None:
        """Join it to the host; nothing where it is joined already."""
        if self._device >= 0:
            return
        self._device, host_end = os.openpty()
        try:
            tty.setraw(host_end)
            port = os.ttyname(host_end)
        finally:
            # Only when our own descriptor of it is closed can we see whether a host is there.
            os.close(host_end)
        os.set_blocking(self._device, False)
        if self._link is None:
            self.port = port
            return
        self._link.parent.mkdir(parents=True, exist_ok=True)
        new = self._link.with_name(f".{self._link.name}.{os.getpid()}")
        new.unlink(missing_ok=True)
        new.symlink_to(port)
        new.replace(self._link)
        self.port = str(self._link)

    def unplug(self) -> None:
        """Pull the cable: whoever has the port open loses it, and its name is gone."""
        if self._device < 0:
            return
        os.close(self._device)
        self._device = -1
        if self._link is not None:
            self._link.unlink(missing_ok=True)

    @property
    def is_open_by_a_host(self) -> bool:
        if self._device < 0:
            return False
        poll = select.poll()
        poll.register(self._device, 0)
        return not any(event & select.POLLHUP for _, event in poll.poll(0))

    def write(self, data: bytes) -> int:
        """Send; returns how many bytes found a place, 0 where no host has the port open."""
        if not self.is_open_by_a_host:
            return 0
        sent = 0
        while sent < len(data):
            try:
                sent += os.write(self._device, data[sent:])
            except OSError as error:
                if error.errno in (errno.EAGAIN, errno.EIO):
                    break
                raise
        return sent

    def read(self, timeout_s: float) -> bytes:
        """What the host has written, b"" where nothing came within the time-out."""
        if self._device < 0:
            return b""
        poll = select.poll()
        poll.register(self._device, select.POLLIN)
        events = poll.poll(round(timeout_s * 1000))
        if not any(event & select.POLLIN for _, event in events):
            return b""
        try:
            return os.read(self._device, _READ_BYTES)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EIO):
                return b""
            raise

    def close(self) -> None:
        """Unplug for good. May be called twice."""
        self.unplug()
