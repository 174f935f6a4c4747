"""The glossary has each term once, with a meaning."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs/reference/glossary.md"


def rows(text: str) -> list[tuple[str, str]]:
    """Term and meaning of each row of the tables of a text, in lower case."""
    found = re.findall(r"^\| ([^|]+) \| ([^|]*) \|$", text.lower(), re.MULTILINE)
    return [(term, meaning) for term, meaning in found if term not in ("term", "---")]


def terms(text: str) -> list[str]:
    """Each term; a row such as `IO, EO` has several, and their plural is the same term."""
    return [
        re.sub(r"(?<=[a-z])s$", "", part.strip("` "))
        for term, _ in rows(text)
        for part in term.split(",")
    ]


def near_doubles(text: str) -> list[tuple[str, str]]:
    """A term, and a second one that only adds a word of another term to it."""
    known = set(terms(text))
    return [
        (shorter, longer)
        for longer in sorted(known)
        for shorter in [longer.partition(" ")[0]]
        if shorter != longer and shorter in known and longer.partition(" ")[2] in known
    ]


def test_each_term_stands_once() -> None:
    text = PAGE.read_text("utf-8")
    assert len(terms(text)) > 80
    assert [term for term, count in Counter(terms(text)).items() if count > 1] == []


def test_each_meaning_stands_once() -> None:
    meanings = Counter(meaning for _, meaning in rows(PAGE.read_text("utf-8")))
    assert [meaning for meaning, count in meanings.items() if count > 1 or not meaning] == []


def test_no_term_only_composes_two_others() -> None:
    assert near_doubles(PAGE.read_text("utf-8")) == []


def test_doubles_are_found() -> None:
    table = "| term | meaning |\n|---|---|\n"
    assert Counter(terms(f"{table}| Frame | a |\n| frames | b |\n"))["frame"] == 2
    text = f"{table}| record | a |\n| provisional | b |\n| provisional record | c |\n"
    assert near_doubles(text) == [("provisional", "provisional record")]
