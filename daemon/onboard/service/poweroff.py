"""Shutdown of the computer by a helper of systemd; the service has no right to do it itself.

The helper is the socket unit `syntopic-poweroff.socket`, which only the service's user may connect
to. A connection starts `syntopic-poweroff.service`; its content is not read.
"""

from __future__ import annotations

import socket
import stat
from pathlib import Path
from typing import Final

HELPER_SOCKET: Final = Path("/run/syntopic-poweroff.socket")
CONNECT_TIMEOUT_S: Final = 2.0


def poweroff_problem(path: Path = HELPER_SOCKET) -> str:
    """Why the computer cannot be shut down from here; empty if it can.

    Args:
        path: socket of the helper.
    """
    try:
        is_socket = stat.S_ISSOCK(path.stat().st_mode)
    except OSError:
        is_socket = False
    if is_socket:
        return ""
    return (
        "The helper that shuts the computer down is not enabled. Run: sudo systemctl enable --now "
        "syntopic-poweroff.socket"
    )


def request_poweroff(path: Path = HELPER_SOCKET) -> str | None:
    """Ask the helper to shut the computer down; return why it refused.

    Args:
        path: socket of the helper.
    """
    if problem := poweroff_problem(path):
        return problem
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC) as channel:
            channel.settimeout(CONNECT_TIMEOUT_S)
            channel.connect(str(path))
    except OSError as error:
        return (
            f"The helper that shuts the computer down did not answer ({error}); check its unit "
            "with systemctl"
        )
    return None
