"""What the parts of the service have in common: each takes in the messages that it knows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar


class MessageDispatcher:
    """Messages of the service's processes, each to its handler."""

    handlers: ClassVar[Mapping[type, Callable[[Any, Any], None]]]

    def dispatch(self, message: object) -> bool:
        """Take in a message; False where it is none of this desk's."""
        handler = self.handlers.get(type(message))
        if handler is None:
            return False
        handler(self, message)
        return True
