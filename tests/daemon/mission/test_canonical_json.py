"""Canonical JSON and the strict reader."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.mission.canonical_json import (
    Fields,
    RecordError,
    canonical_bytes,
    parse_record,
    plain_name,
)

scalars = (
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text()
)
objects = st.dictionaries(
    st.text(),
    st.recursive(
        scalars, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=20
    ),
)


@given(objects)
def test_what_is_written_reads_back_and_writes_the_same_bytes(content):
    data = canonical_bytes(content)
    again = parse_record(data, "a record")
    assert again == content
    assert canonical_bytes(again) == data
    assert data.endswith(b"\n") and data.count(b"\n") == 1


def test_keys_are_sorted_and_nothing_is_padded():
    assert canonical_bytes({"b": 1, "a": [1.0, "ü"]}) == '{"a":[1.0,"ü"],"b":1}\n'.encode()


def test_numpy_scalars_are_plain_numbers():
    content = {"a": np.float32(0.5), "b": np.int64(3), "c": np.bool_(True)}
    assert canonical_bytes(content) == b'{"a":0.5,"b":3,"c":true}\n'


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (float("nan"), "figures.sigma0_px is nan"),
        (2**53 + 1, "beyond 2^53"),
        (object(), "of type object"),
        ("\ud800", "not Unicode"),
    ],
)
def test_what_json_cannot_hold_is_refused_by_name(value, expected):
    with pytest.raises(RecordError, match=expected.replace("^", r"\^")):
        canonical_bytes({"figures": {"sigma0_px": value}})


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"[]",
        b"\xff\xfe",
        b'{"a":1,"a":2}',
        b'{"a":NaN}',
        b"[" * 100_000,
        b'{"a":' + b"9" * 10_000 + b"}",
        b" " * 5_000_000,
    ],
)
def test_hostile_bytes_are_refused_with_a_sentence(data):
    with pytest.raises(RecordError) as caught:
        parse_record(data, "exposure.json")
    assert caught.value.problems[0].startswith("exposure.json: ")


@given(st.binary(max_size=200))
def test_no_bytes_raise_anything_but_a_record_error(data):
    try:
        parse_record(data, "x")
    except RecordError:
        return
    assert isinstance(json.loads(data), dict)


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "a\0", "a..b", ".hidden", "é", "a" * 65])
def test_a_name_that_could_leave_its_folder_is_not_plain(name):
    assert not plain_name(name)


ABSENT = object()
READERS = {
    "integer": lambda fields: fields.integer("k"),
    "integer from 3": lambda fields: fields.integer("k", 7, minimum=3),
    "integer or none": lambda fields: fields.integer_or_none("k"),
    "number": lambda fields: fields.number("k"),
    "number or none": lambda fields: fields.number_or_none("k", 7.0),
    "instant": lambda fields: fields.instant("k"),
    "instant, 7": lambda fields: fields.instant("k", 7),
    "text": lambda fields: fields.text("k"),
    "name": lambda fields: fields.name("k", "n"),
    "choice": lambda fields: fields.choice("k", ("a", "b")),
    "choice, b": lambda fields: fields.choice("k", ("a", "b"), "b"),
    "flag": lambda fields: fields.flag("k", default=True),
    "sha256": lambda fields: fields.sha256("k"),
    "velocity": lambda fields: fields.velocity("k"),
    "scalars": lambda fields: fields.scalars("k"),
    "names": lambda fields: fields.names("k"),
}
INFINITE = json.loads("1e999")


@pytest.mark.parametrize(
    ("reader", "value", "read", "complaints"),
    [
        ("integer", ABSENT, 0, 1),
        ("integer", None, 0, 1),
        ("integer", 1.5, 0, 1),
        ("integer", True, 0, 1),
        ("integer", 0, 0, 0),
        ("integer", -1, 0, 1),
        ("integer", 2**53, 2**53, 0),
        ("integer", 2**53 + 1, 0, 1),
        ("integer from 3", ABSENT, 7, 0),
        ("integer from 3", 2, 7, 1),
        ("integer from 3", 3, 3, 0),
        ("integer or none", ABSENT, None, 0),
        ("integer or none", None, None, 0),
        ("number", ABSENT, 0.0, 1),
        ("number", None, 0.0, 1),
        ("number", "1", 0.0, 1),
        ("number", False, 0.0, 1),
        ("number", INFINITE, 0.0, 1),
        ("number", 10**400, 0.0, 1),
        ("number", -2.5, -2.5, 0),
        ("number or none", ABSENT, 7.0, 0),
        ("number or none", None, None, 0),
        ("number or none", [], 7.0, 1),
        ("instant", ABSENT, None, 0),
        ("instant", None, None, 0),
        ("instant", "12", 12, 0),
        ("instant", 12, None, 1),
        ("instant", str(2**63 - 1), 2**63 - 1, 0),
        ("instant", str(2**63), None, 1),
        ("instant, 7", ABSENT, 7, 0),
        ("instant, 7", None, None, 0),
        ("instant, 7", "x", 7, 1),
        ("text", ABSENT, "", 1),
        ("text", None, "", 1),
        ("text", "x" * 10_000, "x" * 10_000, 0),
        ("text", "x" * 10_001, "", 1),
        ("name", ABSENT, "n", 0),
        ("name", "a/b", "", 1),
        ("choice", ABSENT, "a", 1),
        ("choice", None, "a", 1),
        ("choice", "c", "a", 1),
        ("choice", "b", "b", 0),
        ("choice, b", ABSENT, "b", 0),
        ("choice, b", None, "a", 1),
        ("flag", ABSENT, True, 0),
        ("flag", None, True, 1),
        ("flag", False, False, 0),
        ("sha256", ABSENT, "", 0),
        ("sha256", "A" * 64, "", 1),
        ("sha256", "a" * 64, "a" * 64, 0),
        ("velocity", None, None, 0),
        ("velocity", [1, 2, None], (1.0, 2.0, None), 0),
        ("velocity", [1, 2, 3], (1.0, 2.0, 3.0), 0),
        ("velocity", [1, None, 3], None, 1),
        ("velocity", [1, 2], None, 1),
        ("velocity", [1, 2, True], None, 1),
        ("velocity", [1, INFINITE, 3], None, 1),
        ("velocity", [1, 1e300, 3], None, 1),
        ("velocity", [1, 9.99e299, 3], (1.0, 9.99e299, 3.0), 0),
        ("scalars", ABSENT, {}, 0),
        ("scalars", None, {}, 1),
        ("scalars", {"a": 1, "b": "x", "c": 1.5}, {"a": 1, "b": "x", "c": 1.5}, 0),
        ("scalars", {"a": True, "b": [], "c": INFINITE, "d": 2**53 + 1}, {}, 4),
        ("names", ABSENT, (), 0),
        ("names", ["a", "b.c"], ("a", "b.c"), 0),
        ("names", ["a", ".."], (), 1),
        ("names", "a", (), 1),
    ],
)
def test_a_value_of_another_type_or_beyond_limits_is_named_once(reader, value, read, complaints):
    problems = []
    fields = Fields({} if value is ABSENT else {"k": value}, "path", "x.json", problems)
    assert READERS[reader](fields) == read
    assert len(problems) == complaints
    assert all(problem.startswith("x.json: path.k") for problem in problems)
    fields.refuse_unknown()
    assert len(problems) == complaints
