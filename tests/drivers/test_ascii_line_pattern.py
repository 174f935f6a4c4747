"""Patterns of the ASCII line thermometer: as Python's own find them, and never slow."""

from __future__ import annotations

import re
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.thermometers.ascii_line.pattern import LinePattern, PatternError

ATOMS = st.sampled_from(["a", "b", ".", "[ab]", "[^a]", r"\d", r"\.", "1"])
REPEATS = st.sampled_from(["", "", "", "*", "+", "?", "{2}", "{1,3}", "*?", "+?", "{,2}"])
PIECES = st.builds("{}{}".format, ATOMS, REPEATS)
SEQUENCES = st.lists(PIECES, min_size=1, max_size=4).map("".join)


@settings(max_examples=300, deadline=None)
@given(
    before=SEQUENCES,
    first=SEQUENCES,
    other=SEQUENCES,
    last=SEQUENCES,
    line=st.text("ab1.", max_size=12),
)
def test_what_is_found_is_what_python_finds(
    before: str, first: str, other: str, last: str, line: str
) -> None:
    text = f"{before}(?P<x>{first}|{other})(?:-|{last})?(?P<y>{last})$"
    theirs = re.search(text, line, re.ASCII | re.DOTALL)
    assert LinePattern(text).search(line) == (theirs.groupdict() if theirs else None)


@pytest.mark.parametrize(
    "text",
    [
        "(?P<x>(?:a+)+)$",
        "(?P<x>(?:a|a)*)b",
        "(?P<x>(?:a*)*)b",
        ".*.*.*.*.*.*(?P<x>b)",
        "(?P<x>(?:(?:a{3})*){9})b",
    ],
)
def test_a_pattern_that_hangs_a_backtracking_matcher_is_matched_in_time(text: str) -> None:
    pattern = LinePattern(text)
    begin_s = time.process_time()
    assert pattern.search("a" * 255 + "!") is None
    assert time.process_time() - begin_s < 1.0


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("(?P<x>", "does not compile"),
        ("(?P<x>a)(?P<x>b)", "does not compile"),
        ("(?=a)(?P<x>a)", "not supported"),
        (r"(?P<x>a)(?P=x)", "not supported"),
        (r"(a)\1", r"\\1 at 3 is not supported"),
        ("(?i)(?P<x>a)", "not supported"),
        ("(?P<x>a*+)", "possessive"),
        ("(?:(?:a{99}){99}){99}", "more than 800 steps"),
        ("(?:(?:(?:(?:){9999}){9999}){9999}){9999}", "more than 800 steps"),
        ("a" * 401, "at most 400"),
        ("(" * 190 + "a" + ")" * 190, ""),
    ],
)
def test_a_pattern_that_cannot_be_used_is_refused_with_the_reason(text: str, why: str) -> None:
    if not why:
        assert LinePattern(text).search("a") == {}
        return
    with pytest.raises(PatternError, match=why):
        LinePattern(text)


@settings(max_examples=300, deadline=None)
@given(st.text("()[]{}?P<x>:|*+\\.a1,^$-", max_size=40))
def test_any_text_is_a_pattern_or_is_refused(text: str) -> None:
    try:
        pattern = LinePattern(text)
    except PatternError:
        return
    theirs = re.search(text, "a1a", re.ASCII | re.DOTALL)
    assert (pattern.search("a1a") is None) == (theirs is None)


def test_brackets_in_classes_and_a_degree_sign_are_characters() -> None:
    pattern = LinePattern(r"[[\]](?P<t>[^]]+)[]] ?°C$")
    assert pattern.search("x [21.5] °C") == {"t": "21.5"}
    assert pattern.search("x [21.5) °C") is None
