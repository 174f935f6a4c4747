"""Run a function in a child that kills itself before a chosen call that changes the disk.

Counts what goes through `os`; the calls of SQLite are reached by
`tests.robustness.crash.kill_commands`.
"""

from __future__ import annotations

import os
import signal
import traceback
from collections.abc import Callable
from typing import Any

WRITES = ("write", "writev")
CALLS = (
    *WRITES,
    *("open", "fsync", "fdatasync", "rename", "replace", "link", "symlink", "unlink", "remove"),
    *("rmdir", "mkdir", "ftruncate", "truncate", "fchmod", "chmod", "utime", "posix_fallocate"),
)


def run_to_call(
    action: Callable[[], object],
    last: int | None,
    *,
    torn: bool = False,
    by: signal.Signals = signal.SIGKILL,
) -> list[str]:
    """Run `action` in a child process; the calls it made, nothing if it was killed.

    Args:
        action: what is to be killed; it must not need threads of this process.
        last: the number of the call before which the child is killed, from 1; None runs to the end.
        by: the signal; after SIGINT `action` ends as it does on Ctrl-C.
        torn: if that call writes bytes, write half of them before the kill.

    Raises:
        AssertionError: the action raised.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        os.close(reading)
        _child(action, last, writing, torn=torn, by=by)
    os.close(writing)
    output = b""
    while piece := os.read(reading, 65536):
        output += piece
    os.close(reading)
    _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL:
        assert last is not None
        return []
    assert os.waitstatus_to_exitcode(status) == 0, output.decode()
    return output.decode().split()


def _child(
    action: Callable[[], object], last: int | None, writing: int, *, torn: bool, by: signal.Signals
) -> None:
    write, kill, exit_now = os.write, os.kill, os._exit
    calls: list[str] = []

    def counted(name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **keywords: Any) -> Any:
            if name == "open" and not arguments[1] & (os.O_CREAT | os.O_TRUNC):
                return real(*arguments, **keywords)
            calls.append(name)
            if len(calls) == last:
                if torn and name in WRITES:
                    data = arguments[1] if name == "write" else b"".join(arguments[1])
                    write(arguments[0], data[: len(data) // 2])
                kill(os.getpid(), by)
            return real(*arguments, **keywords)

        return call

    for name in CALLS:
        setattr(os, name, counted(name, getattr(os, name)))
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        action()
    except BaseException:  # noqa: BLE001 - whatever it raises is a finding
        write(writing, traceback.format_exc().encode())
        exit_now(1)
    write(writing, " ".join(calls).encode())
    exit_now(0)
