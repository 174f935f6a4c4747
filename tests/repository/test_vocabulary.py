"""Words of `tests.repository.vocabulary` stand nowhere, and each exception is one."""

import subprocess

from tests.repository.vocabulary import ALLOWED, INSTEAD, ROOT, occurrences


def test_no_word_to_avoid_is_used() -> None:
    found = [
        f"{one.path}:{one.line}: {one.word}: write {INSTEAD[one.word]}" for one in occurrences()
    ]
    assert found == []


def test_every_exception_is_needed() -> None:
    for path, word in ALLOWED:
        text = (ROOT / path).read_text("utf-8").lower()
        assert word in text, (path, word)


def test_public_class_names_are_unique() -> None:
    listed = subprocess.run(
        [
            "git",
            "grep",
            "-hoE",
            r"^class [A-Z]\w+",
            "--",
            "daemon",
            "drivers",
            "processing",
            "sim_hw",
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    ).stdout.split("\n")
    names = [line.partition(" ")[2] for line in listed if line]
    twice = sorted({name for name in names if names.count(name) > 1})
    assert twice == []
