"""The table of the service's messages: each type has one handler."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

Handlers: TypeAlias = Mapping[type, Callable[[Any], None]]


class MessageDispatcher:
    """Passes each message of the service's processes to the handler of its type."""

    def __init__(self) -> None:
        self._handlers: dict[type, Callable[[Any], None]] = {}

    def add(self, handlers: Handlers) -> None:
        """Add handlers of further types.

        Raises:
            ValueError: a type has a handler already.
        """
        if twice := handlers.keys() & self._handlers.keys():
            names = ", ".join(sorted(kind.__name__ for kind in twice))
            raise ValueError(f"messages with two handlers: {names}")
        self._handlers |= handlers

    def dispatch(self, message: object) -> None:
        """Handle a message.

        Raises:
            TypeError: its type has no handler.
        """
        handler = self._handlers.get(type(message))
        if handler is None:
            raise TypeError(f"a process sent {type(message).__name__}, which has no handler")
        handler(message)
