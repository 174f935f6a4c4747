"""Canonical JSON and the strict reader."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.mission.canonical_json import (
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
