"""Sentences for what pydantic refuses: file, line, key, value, and what would be right.

Rules between keys are in the models of the files.
"""

from __future__ import annotations

import bisect
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

from pydantic import ValidationError

Location = Sequence[int | str]
Finding = tuple[Location, str]
"""A key, and what is wrong with it: the rest of a sentence that starts with the key."""
LineOf = Callable[[Location], int | None]
"""The line of a key in its file; None where it is not known."""

_PARSED_MAX_CHARACTERS: Final = 5_000_000
"""Parsed for the lines of one file; after that they are not known."""

_EXPECTED: Final[Mapping[str, str]] = {
    "missing": "it is needed",
    "extra_forbidden": "check the spelling",
    "unexpected_keyword_argument": "check the spelling",
    "bool_type": "true or false is needed",
    "int_type": "a whole number is needed",
    "int_from_float": "a whole number is needed",
    "float_type": "a finite number is needed",
    "finite_number": "a finite number is needed",
    "string_type": "a text is needed",
    "path_type": "a path is needed",
    "tuple_type": "a list is needed",
    "list_type": "a list is needed",
    "dict_type": "a table is needed",
    "mapping_type": "a table is needed",
    "model_type": "a table is needed",
    "model_attributes_type": "a table is needed",
    "dataclass_type": "a table is needed",
    "literal_error": "it is one of {expected}",
    "greater_than": "it is more than {gt}",
    "greater_than_equal": "it is at least {ge}",
    "less_than": "it is less than {lt}",
    "less_than_equal": "it is at most {le}",
    "string_too_long": "it has {max_length} characters at most",
    "too_short": "it has {min_length} entries at least",
    "too_long": "it has {max_length} entries at most",
    "value_error": "{error}",
}
"""What is right, by pydantic's name of the error and with the values of its context."""


class ProblemList:
    """Base of exceptions whose `problems` hold one sentence for each mistake."""

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = tuple(problems)
        # The exception that follows in the order of bases takes the sentence.
        super().__init__("\n".join(problems))  # type: ignore[call-arg]


def findings_of(error: ValidationError, renamed: Mapping[str, str] | None = None) -> list[Finding]:
    """What pydantic found, in its order.

    Args:
        error: the refusal.
        renamed: former keys, with the dots of their tables, and their present names.

    Returns:
        Keys and what is wrong with them, without what only follows from other findings.
    """
    return [
        (detail["loc"], _found(detail, renamed or {}))
        for detail in error.errors(include_url=False)
        if not _follows_from_others(detail)
    ]


def sentences(
    findings: Iterable[Finding], file: str = "", line_of: LineOf | None = None
) -> list[str]:
    """One sentence for each finding: file, line where it is known, key, and what is wrong.

    Args:
        findings: keys and what is wrong with them.
        file: name of the file; empty: none is named.
        line_of: finds the line of a key; None: no line is named.

    Returns:
        Sentences in the order of `findings`.
    """
    found = []
    for location, text in findings:
        line = line_of(location) if line_of else None
        place = f"{file}:{line}: " if line else f"{file}: " if file else ""
        found.append(f"{place}{key_of(location)} {text}" if location else f"{place}{text}")
    return found


def key_of(location: Location) -> str:
    """A key as it is named in sentences.

    Args:
        location: keys of tables and indices of lists, from the outside.

    Returns:
        The key with dots and brackets.

    Example:
        >>> key_of(("cone", 0, "sensor", 1, "pitch_um"))
        'cone[0].sensor[1].pitch_um'
    """
    key = ""
    for part in location:
        key += f"[{part}]" if isinstance(part, int) else f".{part}" if key else part
    return key


def shown(value: object) -> str:
    """A value in 60 characters at most.

    Args:
        value: as found in a file.

    Returns:
        Its `repr`, cut off with "..." where it is longer.
    """
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _follows_from_others(detail: Any) -> bool:
    """Whether a list is too short only because entries of it were refused."""
    if detail["type"] != "too_short":
        return False
    return bool(len(detail["input"]) >= detail["ctx"]["min_length"])


def _found(detail: Any, renamed: Mapping[str, str]) -> str:
    kind, value = detail["type"], detail["input"]
    context = dict(detail.get("ctx", {}))
    if kind == "literal_error":
        context["expected"] = context["expected"].replace(" or ", ", ").replace("'", "")
    context |= {name: f"{v:g}" for name, v in context.items() if isinstance(v, float)}
    expected = _EXPECTED[kind].format(**context) if kind in _EXPECTED else _plain(detail["msg"])
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        present = renamed.get(".".join(part for part in detail["loc"] if isinstance(part, str)))
        return (
            f"is now named {present}; rename it" if present else f"is not a known key; {expected}"
        )
    if kind == "missing":
        return f"is missing; {expected}"
    if not isinstance(value, bool | int | float | str | list | tuple | None):
        return f"cannot be used; {expected}"
    return f"is {shown(value)}; {expected}"


def _plain(message: str) -> str:
    return message[:1].lower() + message[1:]


def line_finder(data: bytes) -> LineOf:
    """A function that finds the line of a key in a TOML document that parses.

    A key is on the last line of the shortest beginning of the document that holds it.

    Args:
        data: the document, UTF-8.

    Returns:
        The function; of a key that the document does not hold it finds the innermost table around
        it that it does hold. None where there is none, or the document is too large.

    Example:
        >>> line_of = line_finder(b'name = "a"\\n[[cone]]\\nprobe = "0"\\n')
        >>> line_of(("cone", 0, "probe")), line_of(("cone", 0, "role")), line_of(("title",))
        (3, 2, None)
    """
    lines = data.decode("utf-8").splitlines(keepends=True)
    parsed: dict[int, Any] = {0: {}}
    left = _PARSED_MAX_CHARACTERS

    def beginning(count: int) -> tuple[int, Any]:
        """The first `count` lines without those of an unfinished statement, and their content."""
        nonlocal left
        while True:
            if count not in parsed:
                text = "".join(lines[:count])
                left -= len(text)
                if left < 0:
                    raise TimeoutError
                try:
                    parsed[count] = tomllib.loads(text)
                except tomllib.TOMLDecodeError:
                    parsed[count] = None
            if parsed[count] is not None:
                return count, parsed[count]
            count -= 1

    def line_of(location: Location) -> int | None:
        try:
            while location and not _holds(beginning(len(lines))[1], location):
                location = location[:-1]
            if not location:
                return None
            at = bisect.bisect_left(
                range(len(lines)), True, key=lambda count: _holds(beginning(count)[1], location)
            )
            return beginning(at - 1)[0] + 1
        except TimeoutError:
            return None

    return line_of


def _holds(content: Any, location: Location) -> bool:
    for part in location:
        try:
            content = content[part]
        except (LookupError, TypeError):
            return False
    return True
