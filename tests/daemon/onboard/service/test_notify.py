"""Messages to systemd are correct, and without NOTIFY_SOCKET nothing is sent."""

from __future__ import annotations

import socket
from pathlib import Path

from daemon.onboard.service.notify import Notifier


def test_ready_status_and_watchdog_reach_the_notification_socket(tmp_path: Path) -> None:
    address = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(address))
        listener.settimeout(2.0)
        notifier = Notifier(str(address))
        notifier.ready("flying")
        notifier.watchdog()
        notifier.stopping("landing")
        assert listener.recv(200) == b"READY=1\nSTATUS=flying"
        assert listener.recv(200) == b"WATCHDOG=1"
        assert listener.recv(200) == b"STOPPING=1\nSTATUS=landing"


def test_without_a_listener_nothing_happens(tmp_path: Path) -> None:
    Notifier("").ready("flying")
    Notifier(str(tmp_path / "gone")).watchdog()
