"""The Aravis library itself: loaded when it is first needed, and its quirks in one place."""

from __future__ import annotations

import functools
import threading
from typing import Any, Final

from drivers.base.extras import missing

OPENING: Final = threading.Lock()
"""Held while a head is opened and configured. Aravis 0.8.26 parses a head's description, and the
nodes it adds of its own, with state of the whole process: two heads opened at once see features as
missing or end in a segmentation fault."""


@functools.cache
def aravis() -> Any:
    """The Aravis namespace of PyGObject.

    Raises:
        MissingExtraError: it is not installed; the message has the command.
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
    """What a call into Aravis raises."""
    aravis()
    from gi.repository import GLib

    error: type[Exception] = GLib.Error
    return error


def inet_address() -> Any:
    """The class of GLib for IP addresses."""
    aravis()
    from gi.repository import Gio

    return Gio.InetAddress


def message_of(error: Exception) -> str:
    """The words of what Aravis raised."""
    return str(getattr(error, "message", error))
