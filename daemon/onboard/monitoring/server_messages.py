"""Codes and parameters of the sentences that the service and its devices write.

Records hold English sentences. For other languages the page needs a code and parameters. They are
found by matching a sentence with the English catalog `server.json` of the page, whose text with
these parameters is exactly the sentence. Records therefore need no codes, and records of earlier
flights are translated as well.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, cast

from daemon.onboard.monitoring.web.page_files import PAGE

CATALOG: Final = PAGE / "messages" / "en" / "server.json"
PREFIX: Final = "server."
SENTENCE_MAX: Final = 2000
"""Characters; a longer sentence is shown as it is."""
DEPTH_MAX: Final = 4
LINES_MAX: Final = 16
"""Further lines of a sentence; they count as parts of it, not as depth."""
LISTS: Final = ("missing", "problems", "reasons", "notes", "recovery")
"""Keys of lists of sentences."""
FURTHER: Final = ("poweroff",)
"""Keys of sentences of which a record has several."""
SEPARATOR: Final = "; "
"""Between the sentences of a list."""
NUMBERS: Final = frozenset(
    (
        *("accounted", "arrived", "at", "baudrate", "copied", "days", "delivered", "dn"),
        *("expected", "exposures", "factor", "first", "gap", "gb", "height", "height_limit"),
        *("k", "last", "level", "limit", "lines", "m", "ms", "n", "noise", "number", "planned"),
        *("ppm", "present", "px", "ratio", "received", "right", "row", "s", "share", "step"),
        *("db", "high", "longer", "low", "mb", "mbps", "measured", "required"),
        *("top", "triggers", "undecided", "us", "used", "valid", "value"),
    )
)
"""Parameters that are numbers. A text where one is expected belongs to another message."""
NAMES: Final = frozenset(("address", "feature", "file", "folder", "key", "name", "path", "setting"))
"""Parameters that are names. A value with a part of a sentence in it belongs to another message."""

_CLAUSE = re.compile(r":(?: |$)|; |\n|\([^)]*$")
_NUMBER = re.compile(r"[+-]?[\d.,]+(?:e[+-]?\d+)?")
_SEPARATORS = re.compile(r"; (?![^(]*\))")
"""Separators outside of parentheses."""

Message = dict[str, Any]
"""`code` and `parameters`. A parameter is a text, a message, or a list of both."""


@dataclass(frozen=True)
class _Template:
    """A text of the catalog, split at its placeholders."""

    code: str
    literals: tuple[str, ...]
    names: tuple[str, ...]

    @property
    def literal_length(self) -> int:
        return sum(map(len, self.literals))

    @property
    def is_frame(self) -> bool:
        """Whether the text has no meaning without the texts that it joins."""
        return bool(self.names) and not re.search(r"[A-Za-z]{3}", "".join(self.literals))

    def match(self, sentence: str) -> dict[str, str] | None:
        """The parameters with which the template is the sentence; None if there are none."""
        first, *middle = self.literals
        if not middle:
            return {} if sentence == first else None
        last = middle.pop()
        if not sentence.startswith(first) or not sentence.endswith(last):
            return None
        values, begin, end = [], len(first), len(sentence) - len(last)
        for literal in middle:
            at = sentence.find(literal, begin + 1, end)
            if at < 0:
                return None
            values.append(sentence[begin:at])
            begin = at + len(literal)
        values.append(sentence[begin:end])
        found = dict(zip(self.names, values, strict=True))
        is_wrong = any(
            (name in NUMBERS and not _NUMBER.fullmatch(value))
            or (name in NAMES and _CLAUSE.search(value))
            for name, value in found.items()
        )
        return None if begin >= end or is_wrong else found


def message_of(sentence: str) -> Message | None:
    """The code and the parameters of a sentence.

    Args:
        sentence: as the service or a device wrote it.

    Returns:
        `code` and `parameters`; None for a sentence that the catalog does not have.

    Example:
        >>> message_of("Head SU11 sent no image. Check power and cable.")
        {'code': 'finding.head_missing', 'parameters': {'head': 'SU11'}}
        >>> message_of("Something else.") is None
        True
    """
    found = _message_of(sentence) if len(sentence) <= SENTENCE_MAX else None
    return None if found is None else cast(Message, json.loads(found))


def english(message: Message, catalog: Mapping[str, str] | None = None) -> str:
    """The sentence of a message.

    Args:
        message: `code` and `parameters`.
        catalog: texts by code; without it the English ones.

    Returns:
        The text of the code with the parameters in it.

    Example:
        >>> english({"code": "finding.tilt", "parameters": {"value": "4.1", "limit": "3.0"}})
        'Tilted by 4.1 deg, 3.0 deg allowed; fly this part again, level.'
    """
    texts = _catalog() if catalog is None else catalog
    values = {name: _shown(value, texts) for name, value in message["parameters"].items()}
    return re.sub(r"\{(\w+)\}", lambda found: values[found[1]], texts[f"{PREFIX}{message['code']}"])


def with_message(record: Mapping[str, Any], key: str = "sentence") -> dict[str, Any]:
    """The record, and as `message` the code and the parameters of its sentence.

    Args:
        record: of the service; it may have no sentence.
        key: under which it has its sentence.

    Returns:
        A copy. It has no `message` if there is no sentence or its code is unknown.
    """
    sentence = record.get(key)
    message = message_of(sentence) if isinstance(sentence, str) and sentence else None
    return {**record, **({} if message is None else {"message": message})}


def with_messages(value: Any) -> Any:
    """Add `message` to every record of a JSON value that has a `sentence`.

    Args:
        value: JSON types, as the API sends them.

    Returns:
        A copy. A list of sentences, such as `missing`, stays; next to it stands a list of the same
        name with `_messages`, which has the messages, and the sentences that have no code.
    """
    if isinstance(value, list | tuple):
        return [with_messages(one) for one in value]
    if not isinstance(value, Mapping):
        return value
    found = {key: with_messages(one) for key, one in value.items()}
    for key in LISTS:
        listed = value.get(key)
        if isinstance(listed, list) and any(isinstance(one, str) for one in listed):
            found[f"{key}_messages"] = [
                (message_of(one) or one) if isinstance(one, str) else one for one in listed
            ]
    for key in FURTHER:
        text = value.get(key)
        if isinstance(text, str) and (message := message_of(text)) is not None:
            found[f"{key}_message"] = message
    return with_message(found)


def _shown(value: Any, texts: Mapping[str, str]) -> str:
    if isinstance(value, list):
        return SEPARATOR.join(_shown(one, texts) for one in value)
    return english(value, texts) if isinstance(value, dict) else str(value)


@lru_cache(maxsize=2048)
def _message_of(sentence: str) -> str | None:
    found = _match(sentence, 0)
    return None if found is None else json.dumps(found)


def _match(sentence: str, depth: int) -> Message | None:
    for template in _candidates(sentence[:1], sentence[-1:]):
        values = template.match(sentence)
        if values is None:
            continue
        is_lines = "\n" in template.literals and sentence.count("\n") <= LINES_MAX
        below = depth if is_lines else depth + 1
        parameters = {name: _parameter(value, below) for name, value in values.items()}
        has_meaning = any(not isinstance(one, str) for one in parameters.values())
        if template.is_frame and not has_meaning:
            continue
        return {"code": template.code, "parameters": parameters}
    return None


def _parameter(value: str, depth: int) -> Any:
    """The value as a message or a list of messages where the catalog has them."""
    if depth > DEPTH_MAX:
        return value
    parts = [_match(one, depth) or one for one in _SEPARATORS.split(value)]
    message = _match(value, depth)
    if len(parts) > 1 and all(isinstance(one, dict) for one in parts):
        # A sentence may have a separator of its own.
        is_one = message is not None and _text_length(message) < _text_length(parts)
        return message if is_one else parts
    if message is not None:
        return message
    return parts if any(isinstance(one, dict) for one in parts) else value


def _text_length(value: Any) -> int:
    """Characters of a message, or of a list, that no text of the catalog stands for."""
    if isinstance(value, str):
        return len(value)
    parts = value["parameters"].values() if isinstance(value, dict) else value
    return sum(_text_length(one) for one in parts)


@lru_cache(maxsize=1)
def _catalog() -> Mapping[str, str]:
    return cast(Mapping[str, str], json.loads(CATALOG.read_text("utf-8")))


@lru_cache(maxsize=1024)
def _candidates(first: str, last: str) -> Sequence[_Template]:
    """The templates of sentences that begin and end with these characters, in their order."""
    return [
        one
        for one in _templates()
        if one.literals[0][:1] in ("", first) and one.literals[-1][-1:] in ("", last)
    ]


@lru_cache(maxsize=1)
def _templates() -> Sequence[_Template]:
    """The most specific first; of frames, lines, then a colon, which joins the least."""
    found = []
    for code, text in _catalog().items():
        parts = re.split(r"\{(\w+)\}", text)
        found.append(_Template(code.removeprefix(PREFIX), tuple(parts[::2]), tuple(parts[1::2])))
    return sorted(
        found,
        key=lambda one: (
            one.is_frame,
            one.is_frame and "\n" not in one.literals,
            one.is_frame and ": " not in one.literals,
            -one.literal_length,
        ),
    )
