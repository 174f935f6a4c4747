"""Words that are not used here, and where they occur.

Run: `python -m tests.repository.vocabulary [PATH ...]`.

Names are taken apart at underscores and capitals, so that `heard_ns` and `HeardNs` both count as
`heard`. `INSTEAD` names what to write instead.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

ROOT: Final = Path(__file__).parents[2]

INSTEAD: Final = {
    "told": "reported, emitted, stated, configured",
    "tell": "report, emit, state, distinguish",
    "tells": "reports, states",
    "telling": "reporting",
    "teller": "emitter",
    "says": "states, reports, contains",
    "said": "stated, reported",
    "heard": "received",
    "hear": "receive",
    "hears": "receives",
    "hearing": "ingest, receiving",
    "beside": "next to, in addition to",
    "anew": "again",
    "reckon": "compute",
    "reckoned": "computed",
    "reckons": "computes",
    "foreseen": "provisional, expected",
    "foresee": "expect",
    "burnt": "saturated",
    "knock": "connect",
    "knocks": "connects",
    "twin": "clone",
    "desk": "dispatcher, context",
    "keeping": "storing, storage",
    "departure": "startup",
    "lanes": "pipelines, pool, thread",
    "lane": "pipeline, thread",
    "lacks": "has no, misses",
    "lack": "missing prerequisite",
    "lacking": "missing",
    "wish": "request",
    "wishes": "requests",
    "wished": "requested",
    "mistaken": "wrong, confounded",
    "stranger": "unknown sender",
    "strangers": "unknown senders",
    "lone": "single",
    "settle": "finalize, lock",
    "settled": "finalized, locked",
    "settles": "finalizes",
    "mend": "repair, correct",
    "mends": "repairs",
    "mended": "repaired, corrected",
}

SUFFIXES: Final = {
    ".py",
    ".md",
    ".toml",
    ".html",
    ".js",
    ".css",
    ".json",
    ".service",
    ".sh",
    ".yml",
}

# Files that quote foreign or old words, each with its reason.
EXCEPTED: Final = {
    "tests/repository/vocabulary.py": "lists the words",
    "CHANGELOG.md": "names what was renamed",
}

# One word in one file (or below one folder), each with its reason.
ALLOWED: Final[dict[tuple[str, str], str]] = {
    ("docs/reference/formats.md", "burnt"): "key of quality.json",
    ("daemon/configuration/model.py", "burnt"): "a former key that is refused",
    ("tests/daemon/configuration/test_configuration.py", "burnt"): "a former key that is refused",
    ("docs/explanation/decisions/0010-names-and-packages.md", "tell"): "quotes a former name",
    ("processing/quality/figures/stitching.py", "burnt"): "key of quality.json",
    ("processing/quality/stitching_findings.py", "burnt"): "key of quality.json",
    ("tests/processing/quality/test_report.py", "burnt"): "key of quality.json",
    ("sim_hw/world/traffic.py", "lane"): "lanes of a road",
    ("sim_hw/world/traffic.py", "lanes"): "lanes of a road",
    ("sim_hw/world/ground_types.py", "lane"): "lanes of a road",
    ("sim_hw/world/ground_types.py", "lanes"): "lanes of a road",
    ("daemon/mission/log/flight_log.py", "tell"): "method of a binary stream",
    ("daemon/mission/mirror/mirrored_log.py", "tell"): "method of a binary stream",
}

WORD: Final = re.compile(r"[A-Za-z]+")
PART: Final = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")


class Occurrence(NamedTuple):
    """One banned word: its place, and the line."""

    path: str
    line: int
    word: str
    text: str


def occurrences(paths: tuple[str, ...] = ()) -> Iterator[Occurrence]:
    """Every banned word in the tracked text files, or in those below `paths`."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--", *paths],
        cwd=ROOT,
        capture_output=True,
        check=True,
        timeout=60,
    ).stdout.decode()
    for path in filter(None, listed.split("\0")):
        if path in EXCEPTED or Path(path).suffix not in SUFFIXES or "/vendor/" in path:
            continue
        if not (ROOT / path).is_file():
            continue
        allowed = {word for (place, word) in ALLOWED if path == place or path.startswith(place)}
        for number, text in enumerate((ROOT / path).read_text("utf-8").splitlines(), 1):
            for name in WORD.findall(text):
                for part in PART.findall(name):
                    word = part.lower()
                    if word in INSTEAD and word not in allowed:
                        yield Occurrence(path, number, word, text.strip())


def main() -> int:
    """Print each occurrence, then the count of each word."""
    counts: dict[str, int] = {}
    for one in occurrences(tuple(sys.argv[1:])):
        print(f"{one.path}:{one.line}: {one.word}: {one.text[:120]}")
        counts[one.word] = counts.get(one.word, 0) + 1
    for word, count in sorted(counts.items(), key=lambda item: -item[1]):
        print(f"{count:6d} {word}: {INSTEAD[word]}")
    return 1 if counts else 0


if __name__ == "__main__":
    sys.exit(main())
