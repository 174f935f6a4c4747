"""Words and phrases that are not used here, and where they occur.

Run: `python -m tests.repository.vocabulary [PATH ...]`.

Names are taken apart at underscores and capitals, so that `heard_ns` and `HeardNs` both count as
`heard`. `INSTEAD` names what to write instead. `PHRASES_INSTEAD` does so for sentences, also where
a line ends within them. Words of `NAMES_INSTEAD` are plain English in a sentence; they are not
used in names of classes and functions.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from functools import cache
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
    "twinned": "cloned",
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

PHRASES_INSTEAD: Final = {
    "everything random follows from it": "seed for all random generators",
    "found by itself if left out": "discovered by mDNS if omitted",
    "if looking needs one": "access token, if reading requires one",
    "its power, its cable": "check its power and cable",
    "it is looked for by itself": "the service keeps retrying",
    "opened again by itself": "reconnecting",
    "time its exposure by itself": "has a timed exposure mode",
    "speaks by itself": "sends unrequested",
    "took that upon them": "the override is recorded with its author",
    "counts only when a person configures it": "takes effect only after it is configured",
    "what the flight cannot part": "parameters the flight cannot separate",
    "everybody may knock": "world-connectable; authorized by peer credentials",
    "kernel's word alone decides": "authorized by peer credentials",
    "could be obeyed": "could be executed",
    "what is shown is of then": "values are frozen",
    "not known here": "token rejected, unknown key",
    "this token is not known": "token rejected",
    "use it / leave it": "sign in / cancel",
    "km is well": "46 % covered, 2 gaps to re-fly",
    "nothing understandable": "no valid data for 3 s",
    "that part has no data": "9 % of the image is missing",
    "brightest hundredth": "99th percentile",
    "this package's extra": "pip install 'syntopic[EXTRA]'",
    "to its bars": "assert limits",
    "say what moved": "report the displaced sensor",
}

NAMES_INSTEAD: Final = {
    "asked": "requested, requirements",
    "complain": "emit, report",
    "kept": "retained, recorded",
    "made": "built, files",
    "turn": "rotation",
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
    "tests/repository/test_vocabulary.py": "tests that they are found",
    "CHANGELOG.md": "names what was renamed",
}

# One word in one file (or below one folder), each with its reason.
ALLOWED: Final[dict[tuple[str, str], str]] = {
    ("docs/reference/formats.md", "burnt"): "key of quality.json",
    ("daemon/configuration/model.py", "burnt"): "a former key that is refused",
    ("tests/daemon/configuration/test_configuration.py", "burnt"): "a former key that is refused",
    ("docs/explanation/decisions/0010-names-and-packages.md", "tell"): "quotes a former name",
    ("docs/explanation/decisions/0010-names-and-packages.md", "burnt"): "key of quality.json",
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

# One name of a class or function, with its reason.
ALLOWED_NAMES: Final[dict[tuple[str, str], str]] = {
    ("daemon/onboard/monitoring/mavlink/camera.py", "connection_made"): "method of asyncio",
    ("tests/daemon/onboard/monitoring/test_listener.py", "connection_made"): "method of asyncio",
    ("daemon/planning/guidance.py", "Turn"): "turn of an aircraft between lines",
    ("daemon/planning/guidance.py", "turn_onto"): "turn of an aircraft between lines",
    ("daemon/planning/guidance.py", "turn_deg"): "turn of an aircraft between lines",
    ("sim_hw/world/flight.py", "_turn_point"): "turn of an aircraft between lines",
    ("tests/daemon/mission/stores/faulty_s3.py", "_in_turn"): "one after another",
}

WORD: Final = re.compile(r"[A-Za-z]+")
DEFINED: Final = re.compile(r"^\s*(?:class|(?:async )?def)\s+(\w+)", re.MULTILINE)
PART: Final = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")


class Occurrence(NamedTuple):
    """One banned word or phrase: its place, and the line."""

    path: str
    line: int
    word: str
    text: str


def pattern_of(phrase: str) -> re.Pattern[str]:
    """The phrase, also across the lines of a comment or of adjoining string literals.

    Example:
        >>> bool(pattern_of("brightest hundredth").search("the brightest\\n# hundredth"))
        True
    """
    words = (re.escape(word) for word in phrase.split())
    return re.compile(r"[\s\"'#*`]+(?:f[\"'])?".join(words), re.IGNORECASE)


PHRASES: Final = {phrase: pattern_of(phrase) for phrase in PHRASES_INSTEAD}


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
        text = (ROOT / path).read_text("utf-8")
        yield from words_in(path, text)
        yield from phrases_in(path, text)
        if path.endswith(".py"):
            yield from names_in(path, text)


def words_in(path: str, text: str) -> Iterator[Occurrence]:
    """Words of `INSTEAD` in a text."""
    allowed = {word for (place, word) in ALLOWED if path == place or path.startswith(place)}
    for number, line in enumerate(text.splitlines(), 1):
        for name in WORD.findall(line):
            for word in parts_of(name):
                if word in INSTEAD and word not in allowed:
                    yield Occurrence(path, number, word, line.strip())


def phrases_in(path: str, text: str) -> Iterator[Occurrence]:
    """Phrases of `PHRASES_INSTEAD` in a text."""
    lower = text.lower()
    for phrase, pattern in PHRASES.items():
        if phrase.partition(" ")[0].lower() not in lower:
            continue
        for found in pattern.finditer(text):
            number = text.count("\n", 0, found.start()) + 1
            yield Occurrence(path, number, phrase, " ".join(found[0].split()))


def names_in(path: str, text: str) -> Iterator[Occurrence]:
    """Words of `NAMES_INSTEAD` in names of classes and functions; titles of tests are sentences."""
    if not any(NAMES_INSTEAD.keys() & parts_of(name) for name in DEFINED.findall(text)):
        return
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if node.name.startswith("test_") or (path, node.name) in ALLOWED_NAMES:
            continue
        for word in parts_of(node.name):
            if word in NAMES_INSTEAD:
                yield Occurrence(path, node.lineno, word, node.name)


@cache
def parts_of(name: str) -> tuple[str, ...]:
    """Words of a name, in lower case.

    Example:
        >>> parts_of("HeardNs")
        ('heard', 'ns')
    """
    return tuple(part.lower() for word in WORD.findall(name) for part in PART.findall(word))


def replacement(word: str) -> str:
    """What to write instead of a banned word or phrase."""
    tables: tuple[Mapping[str, str], ...] = (INSTEAD, PHRASES_INSTEAD, NAMES_INSTEAD)
    return next(table[word] for table in tables if word in table)


def main() -> int:
    """Print each occurrence, then the count of each word."""
    counts: dict[str, int] = {}
    for one in occurrences(tuple(sys.argv[1:])):
        print(f"{one.path}:{one.line}: {one.word}: {one.text[:120]}")
        counts[one.word] = counts.get(one.word, 0) + 1
    for word, count in sorted(counts.items(), key=lambda item: -item[1]):
        print(f"{count:6d} {word}: {replacement(word)}")
    return 1 if counts else 0


if __name__ == "__main__":
    sys.exit(main())
