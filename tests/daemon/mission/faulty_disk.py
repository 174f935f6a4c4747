"""Folders that refuse or stall as a disk does: every opening, renaming and removal below them.

An audit hook of the interpreter sees each call before it is made, in whatever thread.
"""

from __future__ import annotations

import errno
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_CALLS = frozenset({"open", "os.rename", "os.mkdir", "os.remove", "os.scandir", "os.listdir"})
_refusing: dict[str, int] = {}
_stalling: dict[str, threading.Event] = {}


def _hook(event: str, arguments: tuple[object, ...]) -> None:
    if event not in _CALLS or not (_refusing or _stalling):
        return
    path = arguments[0]
    if isinstance(path, bytes):
        path = path.decode()
    if not isinstance(path, str | os.PathLike):
        return
    text = os.fspath(path)
    for root, code in list(_refusing.items()):
        if isinstance(text, str) and text.startswith(root):
            raise OSError(code, os.strerror(code), text)
    for root, passed in list(_stalling.items()):
        if isinstance(text, str) and text.startswith(root):
            passed.wait(60)


sys.addaudithook(_hook)


@contextmanager
def refusing(root: Path, code: int = errno.EIO) -> Iterator[None]:
    """Everything below `root` is refused with this error."""
    _refusing[str(root)] = code
    try:
        yield
    finally:
        del _refusing[str(root)]


@contextmanager
def stalling(root: Path) -> Iterator[None]:
    """Everything below `root` waits until the end of the block."""
    passed = _stalling[str(root)] = threading.Event()
    try:
        yield
    finally:
        del _stalling[str(root)]
        passed.set()
