"""Canonical JSON: the one way a record is written, and a strict reader for records of others.

The modules that own the records define their meaning; the hash chain over exposure records
is in `daemon.mission.verification.chain`.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from daemon.errors import DaemonError
from processing.rig.toml_table import plain_name as plain_name
from processing.rig.toml_text import is_nested_deeper

RECORD_MAX_BYTES = 4_000_000
"""No record of ours comes near this; more is refused unread."""

RECORD_DEPTH_MAX = 32

EXACT_INTEGER_LIMIT = 2**53
"""Larger integers do not survive a JSON reader that knows only doubles."""
_LARGEST = sys.float_info.max

_INSTANT = re.compile(r"-?(0|[1-9][0-9]{0,18})")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_REQUIRED: Any = object()


class RecordError(DaemonError, ValueError):
    """A record that cannot be used; `problems` holds one message for each mistake found."""

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(problems))


def canonical_bytes(content: Mapping[str, Any]) -> bytes:
    """JSON with sorted keys, no spaces, UTF-8, and one newline at the end.

    Numbers are written as Python's shortest exact form; NumPy scalars count as plain numbers.

    Raises:
        RecordError: a value that JSON cannot hold exactly (NaN, infinity, an integer beyond 2^53,
            an unpaired surrogate, an object); the sentence names its key.
    """
    problems: list[str] = []
    plain = _plain(content, "", problems)
    if problems:
        raise RecordError(problems)
    text = json.dumps(plain, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    try:
        return text.encode("utf-8") + b"\n"
    except UnicodeEncodeError as error:
        raise RecordError([f"a text of the record is not Unicode ({error.reason})"]) from error


def sha256_hex(data: bytes) -> str:
    """SHA-256 of bytes, lower-case hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def parse_record(data: bytes, name: str) -> dict[str, Any]:
    """Parse one JSON object from hostile bytes; `name` is used in the error message.

    Raises:
        RecordError: too large, not UTF-8, not JSON, a key given twice, NaN, or not an object.
    """
    if len(data) > RECORD_MAX_BYTES:
        raise RecordError([f"{name}: {len(data)} bytes; a record has at most {RECORD_MAX_BYTES}"])
    try:
        content = json.loads(
            data.decode("utf-8"), object_pairs_hook=_unique_keys, parse_constant=_no_constant
        )
    except RecursionError as error:
        raise RecordError([f"{name}: nested too deeply to be a record"]) from error
    except ValueError as error:
        raise RecordError([f"{name}: not a JSON record ({error})"]) from error
    if not isinstance(content, dict):
        raise RecordError([f"{name}: holds no JSON object; a record starts with {{"])
    if is_nested_deeper(content, RECORD_DEPTH_MAX):
        raise RecordError([f"{name}: nested too deeply to be a record"])
    return content


class Fields:
    """A JSON object that answers typed questions and notes every mistake with its full key."""

    def __init__(
        self, content: Mapping[str, Any], path: str, file: str, problems: list[str]
    ) -> None:
        self.content = content
        self.path = path
        self.file = file
        self.problems = problems
        self.known_keys: set[str] = set()

    def add_problem(self, key: str, expected: str) -> None:
        found = f"is {_shown(self.content[key])}" if key in self.content else "is missing"
        self.problems.append(f"{self.file}: {self._key(key)} {found}; {expected}")

    def instant(self, key: str, default: int | None = None) -> int | None:
        """Nanoseconds as a decimal string, within 64 bits; null where nothing is known."""
        value = self._get(key, default)
        if value is None or value is default:
            return default if value is default else None
        if isinstance(value, str) and _INSTANT.fullmatch(value) and abs(int(value)) < 2**63:
            return int(value)
        self.add_problem(key, 'an instant is a decimal string of nanoseconds, such as "1447500000"')
        return default

    def integer(self, key: str, default: int = _REQUIRED, *, minimum: int = 0) -> int:
        value = self.integer_or_none(key, default, minimum=minimum)
        if value is None:
            if self.content.get(key, _REQUIRED) is None:
                self.add_problem(key, "a whole number is needed")
            return 0
        return value

    def integer_or_none(
        self, key: str, default: int | None = None, *, minimum: int = 0
    ) -> int | None:
        value = self._get(key, default)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int):
            self.add_problem(key, "a whole number is needed")
        elif not minimum <= value <= EXACT_INTEGER_LIMIT:
            self.add_problem(key, f"it must be between {minimum} and 2^53")
        else:
            return value
        return None if default is _REQUIRED else default

    def number(self, key: str, default: float = _REQUIRED) -> float:
        value = self.number_or_none(key, default)
        if value is None:
            if self.content.get(key, _REQUIRED) is None:
                self.add_problem(key, "a number is needed")
            return 0.0
        return value

    def number_or_none(self, key: str, default: float | None = None) -> float | None:
        value = self._get(key, default)
        if value is None:
            return None
        if isinstance(value, int | float) and not isinstance(value, bool):
            try:
                number = float(value)
            except OverflowError:
                number = math.inf
            if math.isfinite(number):
                return number
        self.add_problem(key, "a finite number is needed")
        return None if default is _REQUIRED else default

    def text(self, key: str, default: str = _REQUIRED) -> str:
        value = self._get(key, default)
        if isinstance(value, str) and len(value) <= 10_000:
            return value
        if key in self.content:
            self.add_problem(key, "a text of at most 10000 characters is needed")
        return ""

    def name(self, key: str, default: str = _REQUIRED) -> str:
        """A text that is safe as a file name."""
        value = self.text(key, default)
        if value and value is not default and not plain_name(value):
            self.add_problem(key, "letters, digits, '_', '-' and inner dots only, 64 at most")
            return ""
        return value

    def choice(self, key: str, allowed: Sequence[str], default: str = _REQUIRED) -> str:
        value = self._get(key, default)
        if isinstance(value, str) and value in allowed:
            return value
        if key in self.content:
            self.add_problem(key, f"it is one of {', '.join(allowed)}")
        return allowed[0]

    def flag(self, key: str, *, default: bool) -> bool:
        value = self._get(key, default)
        if isinstance(value, bool):
            return value
        self.add_problem(key, "true or false is needed")
        return default

    def sha256(self, key: str) -> str:
        """64 lower-case hexadecimal digits, or an empty text where there is no hash."""
        value = self.text(key, "")
        if value and not _SHA256.fullmatch(value):
            self.add_problem(key, "a SHA-256 has 64 hexadecimal digits in lower case")
            return ""
        return value

    def velocity(self, key: str) -> tuple[float, float, float | None] | None:
        """North, east, down; null, also of down alone, where it is not known."""
        value = self._get(key, None)
        if value is None:
            return None
        good = (
            isinstance(value, list)
            and len(value) == 3
            and all(
                isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < 1e300
                for v in (value[:2] if value[2] is None else value)
            )
        )
        if not good:
            self.add_problem(key, "three numbers are needed, of which the last may be null")
            return None
        down = None if value[2] is None else float(value[2])
        return (float(value[0]), float(value[1]), down)

    def scalars(self, key: str) -> dict[str, float | int | str]:
        """A flat object of numbers and texts; empty where the key is absent."""
        value = self._get(key, {})
        if not isinstance(value, dict):
            self.add_problem(key, "an object of numbers and texts is needed")
            return {}
        found: dict[str, float | int | str] = {}
        for inner, item in value.items():
            usable = isinstance(item, str) or (
                isinstance(item, int | float)
                and not isinstance(item, bool)
                and abs(item) <= (EXACT_INTEGER_LIMIT if isinstance(item, int) else _LARGEST)
            )
            if usable:
                found[inner] = item
            else:
                problem = (
                    f"{self._key(key)}.{inner} is {_shown(item)}; a number or a text is needed"
                )
                self.problems.append(f"{self.file}: {problem}")
        return found

    def object(self, key: str) -> Fields | None:
        value = self._get(key, None)
        if value is None:
            return None
        if not isinstance(value, dict):
            self.add_problem(key, "an object is needed")
            return None
        return Fields(value, self._key(key), self.file, self.problems)

    def objects(self, key: str) -> Iterator[Fields]:
        """The objects of a list; none where the key is absent."""
        value = self._get(key, [])
        if not (isinstance(value, list) and all(isinstance(item, dict) for item in value)):
            self.add_problem(key, "a list of objects is needed")
            return
        for index, item in enumerate(value):
            yield Fields(item, f"{self._key(key)}[{index}]", self.file, self.problems)

    def names(self, key: str) -> tuple[str, ...]:
        """A list of texts that are safe as file names; empty where the key is absent."""
        value = self._get(key, [])
        if isinstance(value, list) and all(isinstance(v, str) and plain_name(v) for v in value):
            return tuple(value)
        self.add_problem(key, "a list of names is needed")
        return ()

    def refuse_unknown(self) -> None:
        for key in self.content:
            if key not in self.known_keys:
                self.add_problem(key, "no such key; check the spelling")

    def _get(self, key: str, default: Any) -> Any:
        self.known_keys.add(key)
        if key in self.content:
            return self.content[key]
        if default is _REQUIRED:
            self.add_problem(key, "it is needed")
            return None
        return default

    def _key(self, key: str) -> str:
        return f"{self.path}.{key}" if self.path else key


def _plain(value: Any, path: str, problems: list[str]) -> Any:
    """The same value in types of JSON; what does not fit is named in `problems`."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, int):
        if abs(value) > EXACT_INTEGER_LIMIT:
            problems.append(f"{path} is {value}; beyond 2^53 a number is written as a text")
        return int(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            problems.append(f"{path} is {value}; a record holds finite numbers, or null")
        return float(value)
    if isinstance(value, Mapping):
        bad_key = (key for key in value if not isinstance(key, str))
        problems.extend(
            f"{path or 'the record'} has the key {key!r}; a key is a text" for key in bad_key
        )
        return {
            str(key): _plain(item, f"{path}.{key}" if path else str(key), problems)
            for key, item in value.items()
        }
    if isinstance(value, list | tuple):
        return [_plain(item, f"{path}[{i}]", problems) for i, item in enumerate(value)]
    problems.append(f"{path or 'the record'} is of type {type(value).__name__}; JSON has none")
    return None


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        ((twice, _),) = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"the key {twice[:60]!r} is given twice")
    return content


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not a number of JSON")


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
