"""A serial line of two pseudo-terminals, joined by a thread; it can be cut and can add noise."""

from __future__ import annotations

import os
import select
import threading
import tty
from types import TracebackType


class PtyLine:
    """Two ports, `near` and `far`: what is written into one comes out of the other.

    `noise_to_near` is sent once, ahead of the next bytes for the near end.
    """

    def __init__(self) -> None:
        self._masters: list[int] = []
        self._slaves: list[int] = []
        for _ in range(2):
            master, slave = os.openpty()
            tty.setraw(slave)
            self._masters.append(master)
            self._slaves.append(slave)
        self.near, self.far = (os.ttyname(slave) for slave in self._slaves)
        self.noise_to_near = b""
        self.is_cut = False
        self._end_read, self._end_write = os.pipe()
        self._thread = threading.Thread(target=self._pump, daemon=True)

    def __enter__(self) -> PtyLine:
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
        for fd in (*self._masters, *self._slaves, self._end_read, self._end_write):
            os.close(fd)

    def inject(self, data: bytes) -> None:
        """As if the far end had sent these bytes."""
        os.write(self._masters[0], data)

    def _pump(self) -> None:
        near, far = self._masters
        while True:
            ready, _, _ = select.select([near, far, self._end_read], [], [], 10)
            if self._end_read in ready:
                return
            for source, target in ((near, far), (far, near)):
                if source in ready:
                    data = os.read(source, 4096)
                    if target == near and self.noise_to_near:
                        data, self.noise_to_near = self.noise_to_near + data, b""
                    if not self.is_cut:
                        os.write(target, data)
