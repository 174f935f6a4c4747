"""Each flag has a test that provokes it: the table of docs/reference/results/accuracy.md."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

from processing.quality.report import Flag

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs/reference/results/accuracy.md"
TABLE = PAGE.read_text().partition("| flag | provoked by |")[2]


def test_the_table_has_every_flag_once_and_names_tests_there_are() -> None:
    rows = [line.split("|") for line in TABLE.splitlines() if line.startswith("| `")]
    flag_counts = Counter(name for row in rows for name in re.findall(r"`(\w+)`", row[1]))
    assert flag_counts == Counter(str(flag.name) for flag in Flag)
    tests = re.findall(r"`(tests/\S+\.py)::(\w+)`", TABLE)
    assert tests
    for file, name in tests:
        assert f"def {name}(" in (ROOT / file).read_text(), f"{file} has no {name}"
