"""Every page of the documents states its kind, and stands in the folder of its kind."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

DOCS: Final = Path(__file__).parents[2] / "docs"
KINDS: Final = {
    "tutorials": "Tutorial",
    "how-to": "How-to",
    "reference": "Reference",
    "explanation": "Explanation",
}
MOST_ENTRIES: Final = 10


def kind_of(text: str) -> str | None:
    """The kind that the first line after the title states."""
    found = re.match(r"# [^\n]+\n\n\*?(\w[\w-]*)[:.] ?", text)
    return found[1] if found else None


def test_every_page_states_the_kind_of_its_folder() -> None:
    pages = [path for path in DOCS.rglob("*.md") if path.parent != DOCS]
    assert len(pages) > 50
    wrong = [
        path.relative_to(DOCS).as_posix()
        for path in pages
        if kind_of(path.read_text("utf-8")) != KINDS.get(path.relative_to(DOCS).parts[0])
    ]
    assert wrong == []


def test_the_first_levels_have_ten_entries_at_most() -> None:
    for folder in (DOCS, *(DOCS / name for name in KINDS)):
        entries = sorted(path.name for path in folder.iterdir())
        assert len(entries) <= MOST_ENTRIES, (folder, entries)


def test_a_page_without_a_kind_is_found() -> None:
    assert kind_of("# Title\n\nReference: what it holds.\n") == "Reference"
    assert kind_of("# Title\n\n*Explanation.* Modules: `a.py`.\n") == "Explanation"
    assert kind_of("# Title\n\nPages without a kind begin like this.\n") is None


def dated_status(text: str) -> tuple[str, str] | None:
    """The date and the status of a decision record; None if either is missing."""
    found = re.search(r"^Date: (\d{4}-\d\d-\d\d)\. Status: (\w[^\n]*)\.$", text, re.MULTILINE)
    return (found[1], found[2]) if found else None


def test_every_decision_states_its_date_and_its_status() -> None:
    records = sorted((DOCS / "explanation/decisions").glob("[0-9]*.md"))
    assert len(records) > 20
    assert [path.name for path in records if dated_status(path.read_text("utf-8")) is None] == []


def test_a_decision_without_date_or_status_is_found() -> None:
    assert dated_status("# 1. Title\n\nDate: 2026-11-22. Status: accepted.\n") is not None
    assert dated_status("# 1. Title\n\nDate: 2026-11-22.\n") is None
    assert dated_status("# 1. Title\n\nStatus: accepted.\n") is None
    assert dated_status("# 1. Title\n\nDate: lately. Status: accepted.\n") is None
