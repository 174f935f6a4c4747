"""The Aravis library, loaded at its first use."""

from __future__ import annotations

import ctypes
import functools
import threading
from pathlib import Path
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


def stored_description(device: Any) -> bytes:
    """The GenICam description of an opened device, as it stores it; unzipped.

    Args:
        device: the device of Aravis.

    Returns:
        The bytes; empty if they cannot be read.
    """
    # Quirk: PyGObject takes the description for text that ends with a zero byte. Aravis ends it by
    # its length alone, so that what lies behind it in memory is read. The function is called in C.
    # Upstream: no report known (2026-11-23); arv_device_get_genicam_xml in src/arvdevice.c.
    function = _library_function("arv_device_get_genicam_xml")
    if function is None:
        return b""
    capsule = ctypes.pythonapi.PyCapsule_GetPointer
    capsule.restype, capsule.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    function.restype, function.argtypes = ctypes.c_void_p, [ctypes.c_void_p, ctypes.c_void_p]
    nbytes = ctypes.c_size_t()
    start = function(capsule(device.__gpointer__, None), ctypes.byref(nbytes))
    return ctypes.string_at(start, nbytes.value) if start else b""


@functools.cache
def _library_function(name: str) -> Any:
    """A function of the library that is loaded; None if it is not found."""
    aravis()
    for line in Path("/proc/self/maps").read_text(encoding="utf-8").splitlines():
        path = line.split(maxsplit=5)[-1]
        if Path(path).name.startswith("libaravis-0.8.so"):
            return getattr(ctypes.CDLL(path), name, None)
    return None
