"""Values of records: taken as they are, or refused in one sentence that names the key."""

from __future__ import annotations

import json
from dataclasses import make_dataclass
from typing import Any

import pytest
from pydantic import ConfigDict

from daemon.mission.canonical_json import RecordError
from daemon.mission.record_types import (
    Count,
    FileName,
    Finite,
    Instant,
    InstantOrZero,
    Integer,
    LongText,
    NedVelocity,
    Ordinal,
    Scalars,
    Sha256,
    read_record,
)
from processing.rig.value_types import Flag, Name

INFINITE = json.loads("1e999")


def read(kind: Any, value: Any) -> Any:
    namespace = {"__pydantic_config__": ConfigDict(extra="forbid")}
    record = make_dataclass("Record", [("key", kind)], namespace=namespace)
    # The class is made at run time.
    return read_record(record, {"key": value}, "x.json").key  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("kind", "value", "taken"),
    [
        (Count, 0, 0),
        (Count, 2**53, 2**53),
        (Ordinal, 1, 1),
        (Integer, -(2**53), -(2**53)),
        (Count | None, None, None),
        (Finite, -2.5, -2.5),
        (Finite, 3, 3.0),
        (Finite | None, None, None),
        (Instant, "12", 12),
        (Instant, "-12", -12),
        (Instant, str(2**63 - 1), 2**63 - 1),
        (Instant | None, None, None),
        (InstantOrZero, None, 0),
        (InstantOrZero, "7", 7),
        (LongText, "x" * 10_000, "x" * 10_000),
        (LongText, "two\nlines", "two\nlines"),
        (Name, "SU00", "SU00"),
        (FileName, "", ""),
        (FileName, "SU00.tif", "SU00.tif"),
        (Flag, False, False),
        (Sha256, "", ""),
        (Sha256, "a" * 64, "a" * 64),
        (NedVelocity | None, None, None),
        (NedVelocity, [1, 2, None], (1.0, 2.0, None)),
        (NedVelocity, [1, 9.99e299, 3], (1.0, 9.99e299, 3.0)),
        (Scalars, {"a": 1, "b": "x", "c": 1.5}, {"a": 1, "b": "x", "c": 1.5}),
        (tuple[Name, ...], ["a", "b.c"], ("a", "b.c")),
    ],
)
def test_a_value_of_its_type_is_taken(kind: Any, value: Any, taken: Any) -> None:
    found = read(kind, value)
    assert found == taken
    assert type(found) is type(taken)


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (Count, None),
        (Count, 1.5),
        (Count, True),
        (Count, "1"),
        (Count, -1),
        (Count, 2**53 + 1),
        (Ordinal, 0),
        (Integer, -(2**53) - 1),
        (Finite, None),
        (Finite, "1"),
        (Finite, False),
        (Finite, INFINITE),
        (Finite, 10**400),
        (Instant, None),
        (Instant, 12),
        (Instant, "x"),
        (Instant, "012"),
        (Instant, "12\n"),
        (Instant, str(2**63)),
        (InstantOrZero, 0),
        (LongText, None),
        (LongText, "x" * 10_001),
        (Name, ""),
        (Name, "a/b"),
        (FileName, "../a"),
        (Flag, None),
        (Flag, 1),
        (Sha256, "A" * 64),
        (Sha256, "a" * 63),
        (NedVelocity, [1, True, 3]),
        (NedVelocity, [1, INFINITE, 3]),
        (NedVelocity, [1, 1e300, 3]),
        (NedVelocity, [1, None, 3]),
        (NedVelocity, [1, 2]),
        (NedVelocity, [1, 2, 3, 4]),
        (Scalars, None),
        (Scalars, {"a": True}),
        (Scalars, {"a": []}),
        (Scalars, {"a": INFINITE}),
        (Scalars, {"a": 2**53 + 1}),
        (tuple[Name, ...], ["a", ".."]),
        (tuple[Name, ...], "a"),
    ],
)
def test_a_value_of_another_type_or_beyond_limits_is_refused_once(kind: Any, value: Any) -> None:
    with pytest.raises(RecordError) as refused:
        read(kind, value)
    (problem,) = refused.value.problems
    assert problem.startswith("x.json: key") and "; " in problem


def test_keys_that_are_missing_or_not_known_are_named() -> None:
    namespace = {"__pydantic_config__": ConfigDict(extra="forbid")}
    record = make_dataclass("Record", [("key", Count)], namespace=namespace)
    with pytest.raises(RecordError) as refused:
        read_record(record, {"kee": 1}, "x.json", [(("kind",), "is 'b'; 'a' is needed")])
    assert refused.value.problems == (
        "x.json: kind is 'b'; 'a' is needed",
        "x.json: key is missing; it is needed",
        "x.json: kee is not a known key; check the spelling",
    )
    with pytest.raises(RecordError, match=r"kind is 'b'"):
        read_record(record, {"key": 1}, "x.json", [(("kind",), "is 'b'; 'a' is needed")])
