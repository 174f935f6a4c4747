"""Rules of commit subjects: `python -m tests.repository.commit_message FILE`.

`pre-commit` runs this with the file of the message before each commit.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Final

from tests.repository.vocabulary import INSTEAD, parts_of, phrases_in, replacement

SUBJECT_MAX_CHARACTERS: Final = 72
FORM: Final = re.compile(r"[a-z0-9][\w./-]*(?:, [a-z0-9][\w./-]*)*: \S.*[^.\s]")
OF_GIT: Final = ("Merge ", 'Revert "', "fixup! ", "squash! ")
"""Beginnings of subjects that git writes."""


def subject_of(message: str) -> str:
    """The first line of a message that is no comment; empty without one.

    Example:
        >>> subject_of("# a comment\\n\\narea: what\\n\\nWhy.\\n")
        'area: what'
    """
    lines = (line.strip() for line in message.splitlines() if not line.startswith("#"))
    return next(filter(None, lines), "")


def problems(message: str) -> list[str]:
    """What the subject of a message violates, one sentence each."""
    subject = subject_of(message)
    if subject.startswith(OF_GIT):
        return []
    found = []
    if len(subject) > SUBJECT_MAX_CHARACTERS:
        found.append(
            f"the subject has {len(subject)} characters; write at most {SUBJECT_MAX_CHARACTERS}"
        )
    if FORM.fullmatch(subject) is None:
        found.append(f"the subject is {subject!r}; write 'area: what changes', without a full stop")
    words = [word for word in parts_of(subject) if word in INSTEAD]
    phrases = [one.word for one in phrases_in("subject", subject)]
    found += [f"the subject has '{word}'; write {replacement(word)}" for word in words + phrases]
    return found


def main() -> int:
    """Print what the message in a file violates."""
    found = problems(Path(sys.argv[1]).read_text("utf-8"))
    for problem in found:
        print(problem, file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
