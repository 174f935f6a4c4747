"""Figures of quality are typed: no module looks one up by a string.

Telemetry passes JSON from the worker to watchers; the names that it selects are names of typed
figures. A wrong one would only be a missing figure.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from daemon.onboard.monitoring.flight_state import FIGURES_REPORTED
from processing.quality.figures import FIGURES

ROOT = Path(__file__).parents[2]


def names_read(text: str) -> Iterator[str]:
    """Strings that look up a figure: `figures["..."]` and `figures.get("...")`."""
    for node in ast.walk(ast.parse(text)) if "figures" in text else ():
        match node:
            case ast.Subscript(value=ast.Name(id="figures"), slice=ast.Constant(value=str(name))):
                yield name
            case ast.Call(
                func=ast.Attribute(value=ast.Name(id="figures"), attr="get"),
                args=[ast.Constant(value=str(name)), *_],
            ):
                yield name


def test_names_of_figures_in_the_telemetry_are_documented_figures() -> None:
    assert set(FIGURES_REPORTED) - set(FIGURES) == set()


def test_no_module_looks_figures_up_by_their_names() -> None:
    found = {
        path.relative_to(ROOT).as_posix()
        for package in ("daemon", "processing")
        for path in (ROOT / package).rglob("*.py")
        if set(names_read(path.read_text("utf-8"))) & set(FIGURES)
    }
    assert found == set()


def test_a_lookup_is_found() -> None:
    assert list(names_read('a = figures["x"]\nb = figures.get("y", 0)\nc = other["z"]\n')) == [
        "x",
        "y",
    ]
