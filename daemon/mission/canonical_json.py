"""Canonical JSON: the one way a record is written, and a strict reader for records of others.

The modules that own the records define their meaning; the hash chain over exposure records
is in `daemon.mission.verification.chain`.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from daemon import DaemonError
from processing.rig.problem_sentences import ProblemList
from processing.rig.toml_text import is_nested_deeper
from processing.rig.value_types import plain_name as plain_name

RECORD_MAX_BYTES = 4_000_000
"""No record of ours comes near this; more is refused unread."""

RECORD_DEPTH_MAX = 32

EXACT_INTEGER_LIMIT = 2**53
"""Larger integers do not survive a JSON reader that knows only doubles."""


class RecordError(ProblemList, DaemonError, ValueError):
    """A record that cannot be used; `problems` holds one message for each mistake found."""


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
    """Parse one JSON object from untrusted bytes; `name` is used in the error message.

    Raises:
        RecordError: too large, not UTF-8, not JSON, a key given twice, NaN, infinity (also as
            1e400), or not an object.
    """
    if len(data) > RECORD_MAX_BYTES:
        raise RecordError([f"{name}: {len(data)} bytes; a record has at most {RECORD_MAX_BYTES}"])
    try:
        content = json.loads(
            data.decode("utf-8"),
            object_pairs_hook=_unique_keys,
            parse_constant=_no_constant,
            parse_float=_finite,
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


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:60]} is beyond the numbers of a record")
    return value


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not a number of JSON")
