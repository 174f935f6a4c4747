"""The hook for commit messages accepts the form of CONTRIBUTING.md and refuses others."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.repository.commit_message import SUBJECT_MAX_CHARACTERS, problems

ROOT = Path(__file__).parents[2]
BANNED = "be" + "side"


@pytest.mark.parametrize(
    "message",
    [
        "aravis: switch off auto exposure before writing ExposureTime\n",
        "tests, docs: complete a docstring\n\nA body of any length " + "x" * 90 + ".\n",
        "# a comment\n\nlevel1: move sums on in one loop\n# Please enter\n",
        "docs/how-to: state the 99th percentile",
        "a: " + "x" * (SUBJECT_MAX_CHARACTERS - 3),
        "Merge branch 'other'",
        'Revert "aravis: switch off auto exposure"',
    ],
)
def test_a_subject_of_the_form_is_accepted(message: str) -> None:
    assert problems(message) == []


@pytest.mark.parametrize(
    ("message", "part"),
    [
        ("a: " + "x" * (SUBJECT_MAX_CHARACTERS - 2), "has 73 characters"),
        ("Switch off auto exposure", "write 'area: what changes'"),
        ("Aravis: switch off auto exposure", "write 'area: what changes'"),
        ("aravis: switch off auto exposure.", "without a full stop"),
        ("aravis:", "write 'area: what changes'"),
        ("", "write 'area: what changes'"),
        (f"page: show the map {BANNED} the image", f"has '{BANNED}'; write next to"),
        ("docs: explain the brightest " + "hundredth", "write 99th percentile"),
    ],
)
def test_another_subject_is_refused_with_what_to_write(message: str, part: str) -> None:
    assert part in "\n".join(problems(message))


def test_the_hook_runs_the_check_of_commit_messages(tmp_path: Path) -> None:
    hooks = (ROOT / ".pre-commit-config.yaml").read_text("utf-8")
    entry = re.search(
        r"id: commit-message\n.*?entry: ([^\n]+)\n(.*?)(?=- id:|\Z)", hooks, re.DOTALL
    )
    assert entry is not None
    assert "stages: [commit-msg]" in entry[2]
    assert "default_install_hook_types: [pre-commit, commit-msg]" in hooks
    program, *arguments = entry[1].split()
    assert program == ".venv/bin/python"
    message = tmp_path / "COMMIT_EDITMSG"
    for text, status in (("aravis: write ExposureTime\n", 0), ("Write ExposureTime\n", 1)):
        message.write_text(text)
        done = subprocess.run(
            [sys.executable, *arguments, str(message)],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert done.returncode == status, done.stderr
