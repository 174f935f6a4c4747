"""Supervision of the service's processes from its event loop: start, receive, liveness, end.

The meaning of messages is not interpreted here.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from daemon.onboard.service.messages import InvalidMessages, Ping, Stop
from daemon.onboard.service.processes import ChildProcess

ANSWER_LIMIT_S: Mapping[str, float] = {"capture": 10.0, "writer": 60.0, "worker": 120.0}
"""How long a process may be silent before the watchdog is no longer fed: a writer waits for its
disk, a worker finishes its exposure."""
RESTART_LIMIT_S: Mapping[str, float] = {"watch": 60.0, "triangulation": 300.0}
"""How long a process on which no exposure depends may be silent before it is ended. It is started
again as after any other end; the watchdog is fed meanwhile."""
END_TIMEOUT_S = 5.0
PAGE = "watch"
"""The process that the network reaches."""


class Supervisor:
    """Child processes by name.

    Args:
        on_message: called with every message of a child.
        on_death: called with the name of a child that ended without a stop message.
    """

    def __init__(
        self, on_message: Callable[[object], None], on_death: Callable[[str], None]
    ) -> None:
        self._on_message = on_message
        self._on_death = on_death
        self._children: dict[str, ChildProcess] = {}
        self._last_answer_s: dict[str, float] = {}

    def spawn(
        self, name: str, target: str, arguments: tuple[Any, ...], environment: Mapping[str, str]
    ) -> None:
        """Start a child; `target` is "module:function". One of that name that died is cleared."""
        dead = self._children.pop(name, None)
        if dead is not None:
            dead.end(0.0)
        child = _child_process(name, target, arguments, environment)
        self._children[name] = child
        self._last_answer_s[name] = time.monotonic()
        asyncio.get_running_loop().add_reader(child.connection.fileno(), self._receive, child)

    def send(self, name: str, message: object) -> None:
        """Send a message to a child. The end of a child is detected on receiving, not here.

        Nothing is sent to a child that was ended; others may still send while they end.
        """
        child = self._children.get(name)
        if child is None:
            return
        try:
            child.send(message)
        except OSError:
            self._receive(child)  # its last messages, and then its end

    def try_send(self, name: str, message: object) -> bool:
        """Send a message unless that would block; False if it was dropped."""
        child = self._children.get(name)
        try:
            return child is not None and child.try_send(message)
        except OSError:
            return False  # the loop detects its end

    def ping(self) -> list[str]:
        """Ping every child, and end silent ones that no exposure depends on.

        Returns:
            The names of those that a flight depends on and that have been silent for too long.
        """
        watched = [name for name in self._children if name in ANSWER_LIMIT_S]
        for name in watched:
            self.send(name, Ping())
        now = time.monotonic()
        for name in self._children.keys() & RESTART_LIMIT_S.keys():
            self.try_send(name, Ping())
            if now - self._last_answer_s[name] > RESTART_LIMIT_S[name]:
                self._children[name].process.kill()
        return [name for name in watched if now - self._last_answer_s[name] > ANSWER_LIMIT_S[name]]

    async def end(self, names: tuple[str, ...]) -> None:
        """Send a stop message to children, in this order, and wait for their end."""
        loop = asyncio.get_running_loop()
        for name in names:
            child = self._children.pop(name, None)
            if child is None:
                continue
            loop.remove_reader(child.connection.fileno())
            with suppress(OSError):  # it may be gone already
                child.send(Stop())
            await asyncio.to_thread(child.end, END_TIMEOUT_S)

    def _receive(self, child: ChildProcess) -> None:
        """Receive all pending messages of a child."""
        try:
            for message in child.receive():
                if not isinstance(message, InvalidMessages):
                    self._last_answer_s[child.name] = time.monotonic()
                self._on_message(message)
        except (EOFError, ConnectionError):
            self._on_disconnect(child)
            return
        if child.pause_s:
            loop = asyncio.get_running_loop()
            loop.remove_reader(child.connection.fileno())
            loop.call_later(child.pause_s, self._go_on, child)

    def _go_on(self, child: ChildProcess) -> None:
        """Receive again from a child that had sent too much."""
        if self._children.get(child.name) is child:
            loop = asyncio.get_running_loop()
            loop.add_reader(child.connection.fileno(), self._receive, child)

    def _on_disconnect(self, child: ChildProcess) -> None:
        asyncio.get_running_loop().remove_reader(child.connection.fileno())
        self._on_death(child.name)


def _child_process(
    name: str, target: str, arguments: tuple[Any, ...], environment: Mapping[str, str]
) -> ChildProcess:
    """The page's process uses a restricted protocol, because unknown senders can reach it."""
    if name != PAGE:
        return ChildProcess(name, target, arguments, environment)
    from daemon.onboard.service.page_connection import (
        PageProcess,  # needs msgpack, of the extra `watch`
    )

    return PageProcess(name, target, arguments, environment)
