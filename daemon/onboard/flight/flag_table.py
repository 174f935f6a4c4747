"""Table of the quality flags of an exposure: name, cause and action.

The table is `flags.toml` in this folder; `syntopic explain` prints it. The bits are in
docs/reference/formats.md, and a test compares the names with those of the reports.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final


@dataclass(frozen=True)
class FlagDefinition:
    """A flag, what raises it, and what to do."""

    name: str
    cause: str
    action: str


FLAG_TABLE: Final[Sequence[FlagDefinition]] = tuple(
    FlagDefinition(name, **fields)
    for name, fields in tomllib.loads(
        Path(__file__).with_name("flags.toml").read_text("utf-8")
    ).items()
)
