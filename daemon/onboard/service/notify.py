"""State of the service for systemd (sd_notify), if NOTIFY_SOCKET is set."""

from __future__ import annotations

import os
import socket


class Notifier:
    """Sends READY, STATUS, WATCHDOG and STOPPING; sends nothing without NOTIFY_SOCKET.

    Source: sd_notify(3).
    """

    def __init__(self, address: str | None = None) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET") if address is None else address

    @property
    def restart(self) -> str:
        """What starts the service again after a failure, in a sentence."""
        if self._address:
            return "systemd starts the service again, and the mission is resumed"
        return "Start it again (syntopic run), and the mission is resumed"

    def ready(self, status: str) -> None:
        self._send(f"READY=1\nSTATUS={status}")

    def status(self, status: str) -> None:
        self._send(f"STATUS={status}")

    def watchdog(self) -> None:
        self._send("WATCHDOG=1")

    def stopping(self, status: str) -> None:
        self._send(f"STOPPING=1\nSTATUS={status}")

    def _send(self, message: str) -> None:
        if not self._address:
            return
        # An abstract socket is written with a leading @ in the environment.
        address = "\0" + self._address[1:] if self._address[0] == "@" else self._address
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as channel:
            channel.setblocking(False)
            try:
                channel.sendto(message.encode(), address)
            except OSError:
                return  # a full or vanished notification socket must not hold up a flight
