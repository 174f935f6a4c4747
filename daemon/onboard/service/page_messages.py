"""Messages between the service and the page's process as bytes: msgpack, typed and bounded.

A message is an array of two: its kind, and a map of its fields. Only the kinds of `_FROM_PAGE` and
`_TO_PAGE` exist; each field has a type and a limit, none may be missing, added or given twice.
Nothing is executed or unpickled, and no class is looked up by a name that came.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import msgpack

from daemon import DaemonError
from daemon.onboard.service.messages import (
    Answer,
    CommandRefused,
    Ping,
    Pong,
    ServiceCommand,
    ServiceEvent,
    Stop,
)

FROM_PAGE_MAX_BYTES: Final = 32_768
TO_PAGE_MAX_BYTES: Final = 100_000
TEXT_MAX: Final = 4_000
"""Characters of a text; a longer one is cut where it is packed, and refused where it comes."""
NAME_MAX: Final = 200
NUMBER_MAX: Final = 2**53
ARGUMENTS_MAX: Final = 16

PAGE_DEVICES: Final = frozenset(
    {
        "watch",
        "tokens",
        "certificate",
        "certificate for clients",
        "control",
        "mavlink camera",
        "maps",
    }
)
"""What the page's process may report as absent."""


class InvalidMessageError(DaemonError, ValueError):
    """Bytes that are not a message; the error states the problem without quoting them."""


def pack_from_page(message: object) -> bytes:
    """A message of the page's process.

    Raises:
        TypeError, ValueError: it is none that the service takes.
    """
    match message:
        case Pong():
            return _packed("pong", {})
        case ServiceEvent(event):
            return _packed("event", _truncated(event))
        case ServiceCommand(arguments=arguments):
            fields = {key: getattr(message, key) for key in _FROM_PAGE["command"]}
            return _packed("command", _truncated(fields) | {"arguments": _truncated(arguments)})
        case CommandRefused():
            fields = {key: getattr(message, key) for key in _FROM_PAGE["refused"]}
            return _packed("refused", _truncated(fields))
    raise TypeError(f"the page's process has no message {type(message).__name__}")


def unpack_from_page(data: bytes) -> Pong | ServiceEvent | ServiceCommand | CommandRefused:
    """A message of the page's process, every field checked.

    Raises:
        InvalidMessageError: it is none.
    """
    kind, fields = _unpacked(data, FROM_PAGE_MAX_BYTES, array_max=2, text_max=4 * TEXT_MAX)
    if kind == "event":
        name = fields.get("event")
        schema = _PAGE_EVENTS.get(name) if isinstance(name, str) else None
        if schema is None:
            raise InvalidMessageError("an event that the page's process does not have")
        return ServiceEvent(_checked(fields, {"event": _text(NAME_MAX), **schema}))
    if kind not in _FROM_PAGE:
        raise InvalidMessageError("a kind of message that the page's process does not have")
    checked = _checked(fields, _FROM_PAGE[kind])
    if kind == "pong":
        return Pong({})
    return ServiceCommand(**checked) if kind == "command" else CommandRefused(**checked)


def pack_to_page(message: object) -> bytes:
    """A message of the service.

    Raises:
        TypeError, ValueError: it is none for the page's process, or too large.
    """
    match message:
        case Ping():
            data = _packed("ping", {})
        case Stop():
            data = _packed("stop", {})
        case Answer(number, done, sentence):
            fields = {"number": number, "done": done, "sentence": sentence}
            data = _packed("answer", _truncated(fields))
        case ServiceEvent(event):
            data = _packed("event", {"event": event})
        case _:
            raise TypeError(f"no message for the page's process: {type(message).__name__}")
    if len(data) > TO_PAGE_MAX_BYTES:
        raise ValueError(f"a message of {len(data)} bytes; the limit is {TO_PAGE_MAX_BYTES}")
    return data


def unpack_to_page(data: bytes) -> Ping | Stop | Answer | ServiceEvent:
    """A message of the service.

    Raises:
        InvalidMessageError: it is none.
    """
    kind, fields = _unpacked(data, TO_PAGE_MAX_BYTES, array_max=20_000, text_max=TO_PAGE_MAX_BYTES)
    if kind not in _TO_PAGE:
        raise InvalidMessageError("a kind of message that the service does not have")
    checked = _checked(fields, _TO_PAGE[kind])
    if kind == "event":
        return ServiceEvent(checked["event"])
    if kind == "answer":
        return Answer(**checked)
    return Ping() if kind == "ping" else Stop()


Check = Callable[[object], bool]


def _text(maximum: int) -> Check:
    return lambda value: type(value) is str and len(value) <= maximum


def _integer(minimum: int, maximum: int) -> Check:
    return lambda value: type(value) is int and minimum <= value <= maximum


def _flag(value: object) -> bool:
    return type(value) is bool


def _is(expected: object) -> Check:
    return lambda value: type(value) is type(expected) and value == expected


def _one_of(names: frozenset[str]) -> Check:
    return lambda value: type(value) is str and value in names


def _arguments(value: object) -> bool:
    """Names with plain values; `command_rules` knows which, and how large."""
    return (
        type(value) is dict
        and len(value) <= ARGUMENTS_MAX
        and all(_is_plain(one) for one in value.values())
    )


def _is_plain(value: object) -> bool:
    if type(value) is float:
        return math.isfinite(value)
    return _flag(value) or _text(NAME_MAX)(value) or _integer(-NUMBER_MAX, NUMBER_MAX)(value)


def _event(value: object) -> bool:
    return type(value) is dict and type(value.get("event")) is str


_FROM_PAGE: Mapping[str, Mapping[str, Check]] = {
    "pong": {},
    "command": {
        "number": _integer(1, NUMBER_MAX),
        "name": _text(NAME_MAX),
        "arguments": _arguments,
        "by": _text(NAME_MAX),
        "role": _text(NAME_MAX),
        "address": _text(NAME_MAX),
    },
    "refused": {
        "name": _text(NAME_MAX),
        "by": _text(NAME_MAX),
        "role": _text(NAME_MAX),
        "address": _text(NAME_MAX),
        "sentence": _text(TEXT_MAX),
        "count": _integer(1, NUMBER_MAX),
    },
}
_PAGE_EVENTS: Mapping[str, Mapping[str, Check]] = {
    "device": {
        "device": _one_of(PAGE_DEVICES),
        "name": _is("absent"),
        "fault": _is(True),
        "sentence": _text(TEXT_MAX),
    },
    "watching": {"host": _text(NAME_MAX), "port": _integer(0, 65_535), "tls": _flag},
    "tls-certificate": {"fault": _flag, "sentence": _text(TEXT_MAX)},
    "signing-state": {"sentence": _text(TEXT_MAX)},
    "page-link": {"fault": _is(True), "sentence": _text(TEXT_MAX)},
}
_TO_PAGE: Mapping[str, Mapping[str, Check]] = {
    "ping": {},
    "stop": {},
    "answer": {
        "number": _integer(1, NUMBER_MAX),
        "done": _flag,
        "sentence": _text(TEXT_MAX),
    },
    "event": {"event": _event},
}


def _checked(fields: dict[str, Any], schema: Mapping[str, Check]) -> dict[str, Any]:
    if fields.keys() != schema.keys():
        raise InvalidMessageError("a field is missing, or one too many is given")
    wrong = [name for name, is_valid in schema.items() if not is_valid(fields[name])]
    if wrong:
        raise InvalidMessageError(f"the field {wrong[0]} is of a wrong type or out of range")
    return fields


def _packed(kind: str, fields: Mapping[str, Any]) -> bytes:
    try:
        data: bytes = msgpack.packb(
            [kind, fields], default=_as_plain, unicode_errors="surrogatepass"
        )
    except OverflowError as error:
        raise ValueError(f"a number that is too large: {error}") from error
    return data


def _as_plain(value: object) -> object:
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"{type(value).__name__} is no plain JSON type")


def _unpacked(
    data: bytes, maximum: int, *, array_max: int, text_max: int
) -> tuple[str, dict[str, Any]]:
    """Kind and fields; what a message announces is allocated only within the limits."""
    if len(data) > maximum:
        raise InvalidMessageError(f"more than {maximum} bytes")
    try:
        found = msgpack.unpackb(
            data,
            unicode_errors="strict" if maximum == FROM_PAGE_MAX_BYTES else "surrogatepass",
            object_pairs_hook=_unique_keys,
            max_array_len=array_max,
            max_map_len=max(ARGUMENTS_MAX, array_max),
            max_str_len=text_max,
            max_bin_len=0,
            max_ext_len=0,
        )
    except InvalidMessageError:
        raise
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException):
        raise InvalidMessageError("no msgpack within the limits") from None
    if type(found) is not list or len(found) != 2:
        raise InvalidMessageError("no pair of kind and fields")
    kind, fields = found
    if type(kind) is not str or type(fields) is not dict:
        raise InvalidMessageError("no pair of kind and fields")
    return kind, fields


def _unique_keys(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise InvalidMessageError("a field is given twice")
    return found


def _truncated(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Texts within their limits, and such that they can be packed; anything else as it is."""
    return {
        key: value.encode("utf-8", "backslashreplace").decode()[
            : TEXT_MAX if key == "sentence" else NAME_MAX
        ]
        if isinstance(value, str)
        else value
        for key, value in fields.items()
    }
