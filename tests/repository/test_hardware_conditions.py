"""The page of conditions on real hardware names reports, tests and events that are there."""

from __future__ import annotations

import ast
import re
import tomllib
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple

import pytest

ROOT: Final = Path(__file__).parents[2]
PAGE: Final = ROOT / "docs/reference/drivers/hardware-conditions.md"
CONDITIONS_MIN: Final = 25
PROOFS: Final = {"emulated", "foreign", "host"}
REPORT: Final = re.compile(
    r"\[([\w.-]+/[\w.-]+)#(\d+)\]\(https://github\.com/([\w.-]+/[\w.-]+)/(?:issues|pull)/(\d+)\) \w"
)


class Condition(NamedTuple):
    """One row of the page."""

    condition: str
    reports: str
    behaviour: str
    test: str
    proof: str


def conditions(page: str) -> list[Condition]:
    """The rows of all tables with five columns, without their heads."""
    rows = [
        [cell.strip() for cell in line.strip().strip("|").split("|")]
        for line in page.splitlines()
        if line.startswith("|")
    ]
    return [
        Condition(*row)
        for row in rows
        if len(row) == len(Condition._fields) and row[0] != "condition" and row[0].strip("-")
    ]


@cache
def functions_of(path: Path) -> frozenset[str]:
    """Names of the test functions of a file."""
    tree = ast.parse(path.read_text("utf-8"))
    return frozenset(node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))


LISTED: Final = conditions(PAGE.read_text("utf-8"))


def test_there_are_at_least_25_conditions_and_each_once() -> None:
    assert len(LISTED) >= CONDITIONS_MIN
    assert len({row.condition for row in LISTED}) == len(LISTED)


def test_no_row_has_another_number_of_columns() -> None:
    rows = [line for line in PAGE.read_text("utf-8").splitlines() if line.startswith("|")]
    counts = {line.strip().strip("|").count("|") + 1 for line in rows}
    assert counts == {2, len(Condition._fields)}


@pytest.mark.parametrize("row", LISTED, ids=lambda row: row.condition)
def test_every_condition_has_reports_and_a_test_that_is_there(row: Condition) -> None:
    reports = REPORT.findall(row.reports)
    assert reports and len(reports) == row.reports.count("[")
    assert all((name, number) == (address, at) for name, number, address, at in reports)
    found = re.fullmatch(r"`(tests/[\w/]+\.py)::(test_\w+)`", row.test)
    assert found is not None, row.test
    assert found[2] in functions_of(ROOT / found[1])
    assert row.behaviour.endswith(".")
    assert row.proof in PROOFS


def test_every_event_flag_and_setting_that_is_named_is_there() -> None:
    known = _events_and_flags() | _words_of(ROOT / "drivers") | _words_of(ROOT / "daemon")
    named = {name for row in LISTED for name in re.findall(r"`([\w-]+)`", row.behaviour)}
    assert len(named) > 30
    assert sorted(named - known) == []


def _events_and_flags() -> set[str]:
    folder = ROOT / "daemon/onboard/flight"
    names: set[str] = set()
    for file in ("events.toml", "flags.toml"):
        names |= set(tomllib.loads((folder / file).read_text("utf-8")))
    return names | {name.removeprefix("device/") for name in names}


def _words_of(folder: Path) -> set[str]:
    """Every word of the sources."""
    text = " ".join(path.read_text("utf-8") for path in folder.rglob("*.py"))
    return set(re.findall(r"\w+", text))


def test_a_row_without_its_report_or_test_is_found() -> None:
    (row,) = conditions("| a. | none | it. | `tests/x.py` | emulated |\n|---|---|---|---|---|\n")
    assert not REPORT.findall(row.reports)
    assert re.fullmatch(r"`(tests/[\w/]+\.py)::(test_\w+)`", row.test) is None
