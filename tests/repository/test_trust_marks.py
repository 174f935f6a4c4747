"""Every test that the page of planted wrong inputs names is one of `pytest -m trust`."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs/reference/results/trust.md"
ROWS = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
SOAK = "make soak"
"""Rows that say so may name tests that run for hours and are not among the others."""
CELLS = [row.rstrip("|").rpartition(" | ")[2] for row in ROWS if SOAK not in row]
NAMED = sorted({name for cell in CELLS for name in re.findall(r"\b(test_\w+)(?=[`\[])", cell)})
FILES = sorted({path for cell in CELLS for path in re.findall(r"`(tests/[\w/]+\.py)`", cell)})


def marked_tests(source: str) -> Iterator[tuple[str, bool]]:
    """Name of each test of a module, and whether the mark is on it, its class or its module."""
    module = ast.parse(source)
    every = any(
        isinstance(node, ast.Assign)
        and ast.unparse(node.targets[0]) == "pytestmark"
        and "mark.trust" in ast.unparse(node.value)
        for node in module.body
    )
    inside: list[tuple[ast.AST, bool]] = [(node, every) for node in module.body]
    while inside:
        node, marked = inside.pop()
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            continue
        marked |= any("mark.trust" in ast.unparse(mark) for mark in node.decorator_list)
        if isinstance(node, ast.ClassDef):
            inside += [(one, marked) for one in node.body]
        elif node.name.startswith("test_"):
            yield node.name, marked


@pytest.fixture(scope="module")
def by_file() -> dict[str, dict[str, bool]]:
    paths = sorted((ROOT / "tests").rglob("test_*.py"))
    return {
        str(path.relative_to(ROOT)): dict(marked_tests(path.read_text(encoding="utf-8")))
        for path in paths
    }


def test_every_test_of_the_page_is_there_and_marked(by_file: dict[str, dict[str, bool]]) -> None:
    assert len(NAMED) > 200
    marked = {name for tests in by_file.values() for name, is_marked in tests.items() if is_marked}
    modules = {Path(path).stem for path in by_file}
    assert [name for name in NAMED if name not in marked | modules] == []


def test_every_file_of_the_page_has_marked_tests(by_file: dict[str, dict[str, bool]]) -> None:
    assert len(FILES) > 20
    assert [path for path in FILES if not any(by_file.get(path, {}).values())] == []


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("def test_a(): ...", {"test_a": False}),
        ("@pytest.mark.trust\ndef test_a(): ...\ndef helper(): ...", {"test_a": True}),
        ("pytestmark = [pytest.mark.trust]\nasync def test_a(): ...", {"test_a": True}),
        ("@pytest.mark.trust\nclass TestX:\n    def test_a(self): ...", {"test_a": True}),
        ("@pytest.mark.soak\ndef test_a(): ...", {"test_a": False}),
    ],
)
def test_marks_of_functions_classes_and_modules_count(source: str, found: dict[str, bool]) -> None:
    assert dict(marked_tests(source)) == found
