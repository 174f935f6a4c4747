"""The list of skips that a machine without devices may have, and the run that fails on others."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.skips import NEEDS, as_table, expected_reasons, need_of

ROOT = Path(__file__).parents[2]
EXPECTED = {r"no lens \d": "hardware"}


def test_every_listed_skip_states_what_it_needs() -> None:
    assert set(expected_reasons().values()) <= set(NEEDS)


@pytest.mark.parametrize(("reason", "need"), [("no lens 3", "hardware"), ("no lens 33", None)])
def test_a_reason_must_match_the_list_as_a_whole(reason: str, need: str | None) -> None:
    assert need_of(reason, EXPECTED) == need


def test_the_table_counts_reasons() -> None:
    assert as_table(["no lens 3", "no npm", "no lens 3"], EXPECTED) == [
        "NOT LISTED    1  no npm",
        "hardware      2  no lens 3",
    ]


@pytest.mark.parametrize(
    ("reason", "options", "status"),
    [
        ("no programs", ["--fail-on-skip"], 1),
        ("no programs", [], 0),
        ("runs in a virtual machine: make test-v4l2", ["--fail-on-skip"], 0),
        ("no programs", ["--fail-on-skip", "-n1"], 1),
    ],
)
def test_a_skip_that_is_not_listed_fails_a_strict_run(
    reason: str, options: list[str], status: int, tmp_path: Path
) -> None:
    (tmp_path / "conftest.py").write_text("from tests.support.skips import *\n")
    (tmp_path / "test_some.py").write_text(
        f"import pytest\n\ndef test_a() -> None:\n    pytest.skip({reason!r})\n"
    )
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *options, str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == status, done.stdout
    assert f"1  {reason}" in done.stdout
