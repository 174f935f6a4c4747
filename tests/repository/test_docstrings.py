"""Docstrings of public functions are complete."""

from __future__ import annotations

import ast

import pytest

from tests.repository.docstrings import ROOT, incomplete, missing_sections

COMPLETE: tuple[str, ...] = (
    "drivers/base",
    "drivers/cameras",
    "drivers/contract.py",
    "drivers/detection",
    "drivers/receivers",
    "drivers/thermometers",
    "drivers/timescales",
    "drivers/transport",
    "drivers/triggers",
    "processing/bundle",
    "processing/calibration",
    "processing/geometry",
    "processing/image",
    "processing/matching",
    "processing/mosaic",
    "processing/pipelines",
    "processing/quality",
    "processing/radiometry",
    "processing/rig",
)
"""Packages whose docstrings are complete."""


@pytest.mark.parametrize("package", COMPLETE)
def test_docstrings_are_complete(package: str) -> None:
    top = ROOT / package.split("/", maxsplit=1)[0]
    found = [
        f"{path.relative_to(ROOT)}:{line} {name}: {', '.join(absent)}"
        for path, line, name, absent in incomplete(ROOT / package, top)
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("source", "absent"),
    [
        ('def f(a: int) -> int:\n    """F."""', ["Args: a", "Returns"]),
        ('def f(a: int) -> None:\n    """F.\n\n    Args:\n        a: it.\n    """', []),
        ('def f(a: int) -> None:\n    """F.\n\n    Args:\n        b: it.\n    """', ["Args: a"]),
        ('def f() -> int:\n    """F.\n\n    Returns:\n        it.\n    """', []),
        ('def f() -> None:\n    """F."""\n    raise OSError("x")', ["Raises: OSError"]),
        ("def f() -> None:\n    pass", ["a docstring"]),
    ],
)
def test_missing_sections_are_found(source: str, absent: list[str]) -> None:
    function = ast.parse(source).body[0]
    assert isinstance(function, ast.FunctionDef)
    assert missing_sections(function) == absent
