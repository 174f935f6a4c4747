"""Texts from the network or a foreign file, made fit for a terminal and a log.

A terminal executes control sequences, and some characters reorder or hide adjacent text.
"""

from __future__ import annotations

import math
import unicodedata
from typing import Any, Final

TEXT_MAX: Final = 500
DEPTH_MAX: Final = 16
_REPLACED: Final = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})
"""Unicode categories: control, format (writing direction too), surrogates, private, unassigned,
line and paragraph separators."""


def printable(text: str, max_characters: int = TEXT_MAX) -> str:
    """The text on one line, with U+FFFD for each character that does not print.

    Args:
        text: anything.
        most: maximum length in characters; a longer text ends with an ellipsis.

    Example:
        >>> printable("head\\x1b[2J SU11")
        'head\\ufffd[2J SU11'
    """
    shortened = text if len(text) <= max_characters else text[: max_characters - 1] + "…"
    return "".join("\ufffd" if unicodedata.category(one) in _REPLACED else one for one in shortened)


def printable_tree(value: Any, depth: int = DEPTH_MAX) -> Any:
    """JSON types with printable texts; bytes are left out, numbers are finite or None.

    Raises:
        ValueError: nested too deeply, or a type that JSON does not have.
    """
    if depth < 0:
        raise ValueError(f"nested more than {DEPTH_MAX} deep")
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int):
        return value
    if isinstance(value, list):
        return [printable_tree(one, depth - 1) for one in value]
    if isinstance(value, dict):
        return {printable(str(key)): printable_tree(one, depth - 1) for key, one in value.items()}
    if isinstance(value, bytes):
        return None
    raise ValueError(f"{type(value).__name__} in it")
