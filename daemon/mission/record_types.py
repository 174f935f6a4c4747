"""Types of the values in records, and the reader of records of others.

Which keys a record has is declared where the record is. The bytes are read and written by
`daemon.mission.canonical_json`.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import Annotated, Any, Final, TypeVar

from pydantic import (
    AfterValidator,
    Field,
    PlainValidator,
    Strict,
    TypeAdapter,
    ValidationError,
)

from daemon.mission.canonical_json import EXACT_INTEGER_LIMIT, RecordError
from processing.rig.problem_sentences import Finding, findings_of, sentences
from processing.rig.value_types import named

T = TypeVar("T")

_INSTANT: Final = re.compile(r"-?(0|[1-9][0-9]{0,18})")
_SHA256: Final = re.compile(r"[0-9a-f]{64}")
_LARGEST: Final = 1e300


def read_record(
    kind: type[T], content: Mapping[str, Any], file: str, findings: Iterable[Finding] = ()
) -> T:
    """Validate a parsed record.

    Args:
        kind: a dataclass or model whose fields have types of this module.
        content: the parsed record.
        file: name of the file.
        findings: what is wrong with it apart from its fields.

    Raises:
        RecordError: with one sentence per mistake: file, key, value, and what would be right.
    """
    found = list(findings)
    try:
        # mypy takes no unbound type parameter for a hashable argument.
        adapter: TypeAdapter[T] = _adapter(kind)  # type: ignore[arg-type]
        record = adapter.validate_python(content)
    except ValidationError as error:
        raise RecordError(sentences([*found, *findings_of(error)], file)) from error
    if found:
        raise RecordError(sentences(found, file))
    return record


@functools.cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def _instant(value: Any) -> int:
    if isinstance(value, str) and _INSTANT.fullmatch(value) and abs(int(value)) < 2**63:
        return int(value)
    raise ValueError('an instant is a decimal string of nanoseconds, such as "1447500000"')


def _instant_or_zero(value: Any) -> int:
    return 0 if value is None else _instant(value)


def _hash(text: str) -> str:
    if text and not _SHA256.fullmatch(text):
        raise ValueError("a SHA-256 has 64 hexadecimal digits in lower case")
    return text


def _name_or_empty(text: str) -> str:
    return named(text) if text else ""


def _scalar(value: Any) -> float | int | str:
    if isinstance(value, str):
        return value
    if isinstance(value, int) and not isinstance(value, bool):
        if abs(value) <= EXACT_INTEGER_LIMIT:
            return value
    elif isinstance(value, float) and abs(value) < float("inf"):
        return value
    raise ValueError("a number or a text is needed")


def distinct(key: Callable[[Any], Hashable]) -> AfterValidator:
    """Refuses a list in which two items have the same key; an empty text is no key."""

    def check(items: tuple[Any, ...]) -> tuple[Any, ...]:
        keys = [key(item) for item in items]
        twice = next((one for one in keys if one and keys.count(one) > 1), None)
        if twice:
            raise ValueError(f"it names {twice!r} twice; once is right")
        return items

    return AfterValidator(check)


Instant = Annotated[int, PlainValidator(_instant)]
"""Nanoseconds as a decimal string, within 64 bits."""
InstantOrZero = Annotated[int, PlainValidator(_instant_or_zero)]
"""An instant that is 0 where nothing is known."""
Count = Annotated[int, Strict(), Field(ge=0, le=EXACT_INTEGER_LIMIT)]
Ordinal = Annotated[int, Strict(), Field(ge=1, le=EXACT_INTEGER_LIMIT)]
Integer = Annotated[int, Strict(), Field(ge=-EXACT_INTEGER_LIMIT, le=EXACT_INTEGER_LIMIT)]
LeapSeconds = Annotated[int, Strict(), Field(ge=-1000, le=1000)]
Finite = Annotated[float, Strict(), Field(allow_inf_nan=False)]
LongText = Annotated[str, Strict(), Field(max_length=10_000)]
Sha256 = Annotated[str, Strict(), AfterValidator(_hash)]
"""64 lower-case hexadecimal digits, or an empty text where there is no hash."""
FileName = Annotated[str, Strict(), AfterValidator(_name_or_empty)]
"""A text that is safe as a file name, or an empty one where there is no file yet."""
Scalars = Mapping[str, Annotated[float | int | str, PlainValidator(_scalar)]]
_Speed = Annotated[float, Strict(), Field(gt=-_LARGEST, lt=_LARGEST)]
NedVelocity = tuple[_Speed, _Speed, _Speed | None]
"""North, east, down; down is null where it is not known."""
