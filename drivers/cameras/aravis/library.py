"""The Aravis library, loaded at its first use."""

from __future__ import annotations

import functools
import threading
from typing import Any, Final

from drivers.base.extras import missing

# Quirk: Aravis 0.8.26 parses a head's description with global state. Heads that are opened in
# parallel miss features or cause a segmentation fault, so one head is opened at a time.
# Upstream: AravisProject/aravis#159.
OPENING: Final = threading.Lock()
"""Held while a head is opened and configured."""


@functools.cache
def aravis() -> Any:
    """The Aravis namespace of PyGObject.

    Returns:
        The module, loaded at the first call.

    Raises:
        MissingExtraError: it is not installed; the message contains the command that installs it.
    """
    try:
        import gi

        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis
    except (ImportError, ValueError) as error:
        raise missing("aravis", error) from error
    return Aravis


@functools.cache
def aravis_error() -> type[Exception]:
    """The exception type of Aravis calls.

    Returns:
        GLib.Error.

    Raises:
        MissingExtraError: Aravis is not installed.
    """
    aravis()
    from gi.repository import GLib

    error: type[Exception] = GLib.Error
    return error


def inet_address() -> Any:
    """GLib's class of IP addresses.

    Returns:
        Gio.InetAddress.

    Raises:
        MissingExtraError: Aravis is not installed.
    """
    aravis()
    from gi.repository import Gio

    return Gio.InetAddress


def message_of(error: Exception) -> str:
    """The message of an Aravis exception.

    Args:
        error: the exception.

    Returns:
        Its message without domain and code.
    """
    return str(getattr(error, "message", error))
