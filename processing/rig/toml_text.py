"""TOML of others: parsed with one kind of error, whatever is wrong with it.

What the keys mean is the business of the readers.
"""

from __future__ import annotations

import stat
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from processing import ProcessingError

DEPTH_MAX: Final = 32
"""Tables and lists within one another; no file of ours has more than six."""
FILE_MAX_BYTES: Final = 1_000_000


class TomlError(ProcessingError, ValueError):
    """Text that is not TOML; the message states why."""


def parse_toml(data: bytes) -> dict[str, Any]:
    """Parse a TOML document.

    Args:
        data: the document.

    Returns:
        Its tables.

    Raises:
        TomlError: not UTF-8, not TOML, a number of more digits than Python reads, or nested more
            than `DEPTH_MAX` deep.
    """
    try:
        content = tomllib.loads(data.decode("utf-8"))
    except RecursionError as error:
        raise TomlError("nested too deeply") from error
    except ValueError as error:
        raise TomlError(str(error)) from error
    if is_nested_deeper(content, DEPTH_MAX):
        raise TomlError("nested too deeply")
    return content


def read_toml(path: Path, what: str) -> tuple[dict[str, Any], bytes]:
    """Read and parse a TOML file.

    Args:
        path: of a file of at most `FILE_MAX_BYTES`.
        what: it should be, with its article.

    Returns:
        Its tables, and its bytes.

    Raises:
        TomlError: no readable regular file, too large, or not TOML; the message names the file.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise TomlError(f"{path}: not a regular file; give {what}")
        if status.st_size > FILE_MAX_BYTES:
            raise TomlError(f"{path.name}: larger than {FILE_MAX_BYTES} bytes; not {what}")
        data = path.read_bytes()
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise TomlError(f"{path}: cannot be read ({reason}); give {what}") from error
    try:
        return parse_toml(data), data
    except TomlError as error:
        raise TomlError(f"{path.name}: not valid TOML: {error}") from error


def is_nested_deeper(content: object, depth: int) -> bool:
    """Whether tables or lists lie more than `depth` within one another.

    Args:
        content: a parsed document.
        depth: levels that are allowed below the document itself.

    Returns:
        True where there are more.

    Example:
        >>> is_nested_deeper({"a": [[1]]}, 2), is_nested_deeper({"a": [[1]]}, 1)
        (False, True)
    """
    level: list[object] = [content]
    for _ in range(depth + 1):
        level = [
            inner
            for outer in level
            # mypy does not narrow the type inside a comprehension.
            for inner in (outer.values() if isinstance(outer, Mapping) else outer)  # type: ignore[attr-defined]
            if isinstance(inner, Mapping | list)
        ]
        if not level:
            return False
    return True
