"""Child processes of the service: spawned, never forked, and dead when the service is.

A child is a function "module:name" that gets a `ServiceConnection` and its own arguments. It is
named, not imported, so that what a child needs is never loaded into the service.
"""

from __future__ import annotations

import ctypes
import importlib
import multiprocessing
import os
import select
import signal
import threading
from collections.abc import Iterator, Mapping
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from typing import Any, ClassVar

from daemon import DaemonError

PR_SET_PDEATHSIG = 1  # linux/prctl.h
TRY_SEND_MAX_BYTES = 100_000
"""A local socket counts as writable while three quarters of its buffer (208 kB) are free."""

_SPAWN = multiprocessing.get_context("spawn")


class ServiceDisconnectedError(DaemonError):
    """The other end of a child's connection is closed."""


class ServiceConnection:
    """The child's end of the connection to the service; `send` may be called from any thread.

    Both ways raise ServiceDisconnectedError once the service is gone.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._lock = threading.Lock()

    def send(self, message: object) -> None:
        try:
            with self._lock:
                self._connection.send(message)
        except OSError as error:
            raise ServiceDisconnectedError(str(error)) from error

    def fileno(self) -> int:
        """What an event loop waits on."""
        return self._connection.fileno()

    def receive(self, timeout_s: float) -> object | None:
        """The next message, or None when none came in time."""
        try:
            return self._connection.recv() if self._connection.poll(timeout_s) else None
        except (EOFError, OSError) as error:
            raise ServiceDisconnectedError(str(error)) from error


class ChildProcess:
    """The service's end: the process, and the connection to it."""

    link: ClassVar[type] = ServiceConnection
    pause_s = 0.0
    """For so long nothing more is to be received from it; more than 0 after too many messages."""

    def __init__(
        self,
        name: str,
        target: str,
        arguments: tuple[Any, ...],
        environment: Mapping[str, str],
    ) -> None:
        self.name = name
        self.connection, child_end = self._ends()
        self.process = _SPAWN.Process(
            target=_child_main,
            args=(type(self).link, child_end, os.getpid(), target, arguments),
            name=f"syntopic-{name}",
            daemon=True,
        )
        # Numerical libraries read their thread counts when they are first imported, which in a
        # spawned child is before any line of ours runs: the environment is the only way in.
        before = {key: os.environ.get(key) for key in environment}
        os.environ.update(environment)
        try:
            self.process.start()
        finally:
            for key, value in before.items():
                if value is None:
                    del os.environ[key]
                else:
                    os.environ[key] = value
        child_end.close()

    def _ends(self) -> tuple[Any, Any]:
        """Both ends of a new connection; a subclass may use another kind."""
        return _SPAWN.Pipe(duplex=True)

    def receive(self) -> Iterator[object]:
        """Every message that has come.

        Raises:
            EOFError, ConnectionError: the process is gone.
        """
        while self.connection.poll():
            yield self.connection.recv()

    def send(self, message: object) -> None:
        """BrokenPipeError where the child is gone; the service notices by its sentinel."""
        self.connection.send(message)

    def try_send(self, message: object) -> bool:
        """Send only if that is certain not to wait; False where it was not sent.

        Raises:
            ValueError: a message that is too large ever to be sent so.
        """
        _, writable, _ = select.select([], [self.connection], [], 0)
        if not writable:
            return False
        data = ForkingPickler.dumps(message)
        if len(data) > TRY_SEND_MAX_BYTES:
            raise ValueError(f"a message of {len(data)} bytes; the limit is {TRY_SEND_MAX_BYTES}")
        self.connection.send_bytes(data)
        return True

    def end(self, timeout_s: float) -> None:
        """Wait for the child to end by itself, then end it."""
        self.process.join(timeout_s)
        if self.process.is_alive():
            self.process.kill()
            self.process.join(timeout_s)
        self.connection.close()


def die_with_parent(parent_pid: int, how: signal.Signals = signal.SIGKILL) -> None:
    """Ask the kernel to signal this process when its parent dies, however it dies.

    The kernel takes the thread that started us for the parent: it has to be one that stays.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_PDEATHSIG, how) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")
    if os.getppid() != parent_pid:  # the parent died before we could ask
        os._exit(1)


def _child_main(
    link: type,
    connection: Any,
    parent_pid: int,
    target: str,
    arguments: tuple[Any, ...],
) -> None:
    die_with_parent(parent_pid)
    # Ctrl-C reaches the whole process group; the service ends its children in order.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.excepthook = _end_without_service
    module, _, function = target.partition(":")
    try:
        getattr(importlib.import_module(module), function)(link(connection), *arguments)
    except ServiceDisconnectedError:
        os._exit(1)


def _end_without_service(failed: threading.ExceptHookArgs) -> None:
    """A thread that finds the service gone ends the process silently."""
    if isinstance(failed.exc_value, ServiceDisconnectedError):
        os._exit(1)
    threading.__excepthook__(failed)
