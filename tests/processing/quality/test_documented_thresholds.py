"""Thresholds have the defaults that docs/reference/formats.md states, and are named there."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest

from processing.quality.report import Thresholds

DOCUMENT = Path(__file__).parents[3] / "docs/reference/formats.md"


def documented() -> dict[str, float]:
    """Defaults by name, from the rows of the table of thresholds."""
    table = DOCUMENT.read_text().split("| threshold | flag | default |")[1].split("\n\n")[0]
    found = {}
    for row in table.splitlines():
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        names = re.findall(r"`(\w+)`", cells[0])
        values = re.findall(r"-?\d+(?:\.\d+)?", cells[-1].split("(")[0])
        assert len(names) == len(values), row
        found |= dict(zip(names, map(float, values), strict=True))
    return found


def test_defaults_are_those_of_the_document() -> None:
    defaults = dataclasses.asdict(Thresholds())
    assert defaults == pytest.approx(documented(), rel=1e-3)
