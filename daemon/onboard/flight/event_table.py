"""What the service tells, as one table: each event's name, severity, cause and cure.

The table itself is `events.toml` beside this file. `syntopic explain` and docs/events.md are made
of it; a test holds it against what the code tells.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

Severity = Literal["info", "caution", "warning"]
"""A note asks for nothing; a caution wants a look when there is time, a warning at once."""


@dataclass(frozen=True)
class EventDefinition:
    """An event. Names of device events begin with "device/", arming's with "arming-"."""

    name: str
    severity: Severity
    cause: str
    cure: str = "Nothing to do."


_LISTED = tomllib.loads(Path(__file__).with_name("events.toml").read_text("utf-8"))
TABLE: Final[Sequence[EventDefinition]] = tuple(
    EventDefinition(name, **fields) for name, fields in _LISTED.items()
)


def entry_of(name: str) -> EventDefinition | None:
    """The entry of an event, by its name; a device event also without "device/"."""
    return _BY_NAME.get(name) or _BY_NAME.get(f"device/{name}")


def as_markdown() -> str:
    """The table as the page docs/events.md."""
    rows = [f"| `{e.name}` | {e.severity} | {e.cause} | {e.cure} |" for e in TABLE]
    return (
        "\n".join((_PREFACE, "| event | severity | cause | what helps |", "|---|---|---|---|"))
        + "\n"
        + "\n".join(rows)
        + "\n"
    )


_BY_NAME = {entry.name: entry for entry in TABLE}
_PREFACE = """# Events

What `syntopic run` tells, line by line, and what the page and the API list as `events`. A *note*
asks for nothing, a *caution* for a look when there is time, a *warning* for one at once.
`syntopic explain NAME` prints a line of this table in the air. Made by
`syntopic explain --markdown`; do not edit.
"""
