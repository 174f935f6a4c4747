"""Base class of the parts of the service that handle messages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar


class MessageDispatcher:
    """Dispatches messages of the service's processes to handlers by type."""

    handlers: ClassVar[Mapping[type, Callable[[Any, Any], None]]]

    def dispatch(self, message: object) -> bool:
        """Handle a message; False if this dispatcher has no handler for it."""
        handler = self.handlers.get(type(message))
        if handler is None:
            return False
        handler(self, message)
        return True
