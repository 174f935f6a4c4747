"""The gpsd of the distribution as a peer: on a pseudo-terminal, fed with recorded bytes."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

PROGRAM = shutil.which("gpsd", path=f"{os.environ.get('PATH', '')}:/usr/sbin")
STARTS_WITHIN_S = 20.0


@dataclass(frozen=True)
class RealGpsd:
    """`address` is where it serves, `receiver` the descriptor that its receiver writes to."""

    address: str
    receiver: int

    @contextmanager
    def playing(self, recorded: bytes, *, pause_s: float = 0.01) -> Iterator[None]:
        """Feed it a recording again and again, slowly enough for the terminal's buffer."""
        ended = threading.Event()

        def play() -> None:
            while not ended.is_set():
                for at in range(0, len(recorded), 500):
                    if ended.wait(pause_s):
                        return
                    os.write(self.receiver, recorded[at : at + 500])

        player = threading.Thread(target=play)
        player.start()
        try:
            yield
        finally:
            ended.set()
            player.join(5)


@contextmanager
def running_gpsd() -> Iterator[RealGpsd]:
    """Start gpsd on a pseudo-terminal, and end it with the block."""
    assert PROGRAM is not None
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    master, slave = os.openpty()
    tty.setraw(slave)
    # gpsd gives up root before it opens the port.
    Path(os.ttyname(slave)).chmod(0o666)
    process = subprocess.Popen(
        [PROGRAM, "-N", "-n", "-b", "-S", str(port), os.ttyname(slave)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        _wait_for(port)
        yield RealGpsd(f"127.0.0.1:{port}", master)
    finally:
        process.terminate()
        try:
            process.wait(timeout=10)
        finally:
            os.close(master)
            os.close(slave)


def _wait_for(port: int) -> None:
    deadline = time.monotonic() + STARTS_WITHIN_S
    while time.monotonic() < deadline:
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
            return
        time.sleep(0.02)
    raise TimeoutError(f"gpsd does not serve at port {port} within {STARTS_WITHIN_S:g} s")
