"""Quirks of libraries, kernels and devices in drivers: `python -m tests.drivers.quirks`.

A comment that begins with `# Quirk:` states the behaviour and what the driver does about it. It
ends with `Upstream:` and a reference: an issue or pull request as owner/repository#number,
`manual:` with a document and its clause, or `no report known (date)`. This module writes their
table, docs/reference/drivers/quirks.md.
"""

from __future__ import annotations

import io
import re
import sys
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
DRIVERS = ROOT / "drivers"
PAGE = ROOT / "docs" / "reference" / "drivers" / "quirks.md"
MARKER = "Quirk:"
UPSTREAM = "Upstream:"
ISSUE = re.compile(r"\b([\w-]+/[\w.-]+)#(\d+)\b")
MANUAL = re.compile(r"\bmanual: [^,.]+\S*, \S+")
DATE = re.compile(r" \(\d{4}-\d{2}-\d{2}\)")
UNREPORTED = re.compile(r"\bno report known \(\d{4}-\d{2}-\d{2}\)")
UNMARKED = re.compile(
    r"\b(some|most|many|few) (heads|cameras|receivers|chips|autopilots|manufacturers)\b"
    r"|\bworkaround\b|\bAravis (prints|drops|needs|counts|reports|sends|enlarges|would|ignores)\b"
    r"|\b(pyserial|pymavlink|pyubx2|tifffile|PyGObject|gpsd) (raises|sends|ignores|never)\b",
    re.IGNORECASE,
)
"""Words of comments on quirks; a comment with them and without the marker is reported."""
LOWER_CASE_NAMES = {"gpsd", "pymavlink", "pyserial", "pyubx2", "tifffile", "vivid"}
HEAD = """# Quirks

Reference: behaviour of libraries, kernels and devices for which a driver has code of its own.

Each row is a comment `# Quirk:` in the code, with the issue or pull request of the library, or the
clause of the manual. Where no report is known, the comment has the date of the search. A quirk that
its library has corrected can be removed when the oldest supported version has the correction.

`python -m tests.drivers.quirks` writes this page; `tests/drivers/test_quirks.py` compares it.
"""


@dataclass(frozen=True)
class Quirk:
    """One marked comment: its place, the behaviour, and the reference."""

    path: str
    line: int
    text: str
    upstream: str

    @property
    def has_reference(self) -> bool:
        """Whether the reference is an issue, a clause of a manual, or a dated search."""
        return any(form.search(self.upstream) for form in (ISSUE, MANUAL, UNREPORTED))


def comment_blocks(source: str) -> Iterator[list[tuple[int, str]]]:
    """Comments on lines of their own, consecutive ones together: number and text of each line."""
    block: list[tuple[int, str]] = []
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type != tokenize.COMMENT or token.line[: token.start[1]].strip():
            continue
        number, text = token.start[0], token.string.removeprefix("#").strip()
        if block and block[-1][0] != number - 1:
            yield block
            block = []
        block.append((number, text))
    if block:
        yield block


def parts(block: list[tuple[int, str]]) -> Iterator[tuple[int, str]]:
    """Quirks and other comments of a block, each with its first line; a reference ends a quirk."""
    number, words = block[0][0], ""
    for line, text in block:
        is_complete = UPSTREAM in words and words.endswith(".")
        if words and (text.startswith(MARKER) or is_complete):
            yield number, words
            words = ""
        number = line if not words else number
        words = f"{words} {text}".strip()
    yield number, words


def quirks_of(source: str, path: str) -> list[Quirk]:
    """The marked comments of a module."""
    found = []
    for block in comment_blocks(source):
        for line, words in parts(block):
            if words.startswith(MARKER):
                text, _, upstream = words.removeprefix(MARKER).partition(UPSTREAM)
                found.append(Quirk(path, line, text.strip(), upstream.strip().removesuffix(".")))
    return found


def unmarked(source: str) -> list[tuple[int, str]]:
    """Comments that describe a quirk and have no marker."""
    return [
        (line, words)
        for block in comment_blocks(source)
        for line, words in parts(block)
        if not words.startswith(MARKER) and UNMARKED.search(words)
    ]


def modules() -> Iterator[tuple[str, str]]:
    """Path below the root and source of every module of the drivers."""
    for path in sorted(DRIVERS.rglob("*.py")):
        yield path.relative_to(ROOT).as_posix(), path.read_text("utf-8")


def page() -> str:
    """The page with the table of all quirks, a section for each package."""
    packages: dict[str, list[Quirk]] = {}
    for path, source in modules():
        for quirk in quirks_of(source, path):
            packages.setdefault(Path(path).parent.as_posix(), []).append(quirk)
    lines = [HEAD]
    for package, quirks in sorted(packages.items()):
        lines += [f"## {package}", "", "| module | behaviour | reference |", "|---|---|---|"]
        lines += [
            f"| `{Path(quirk.path).name}` | {_cell(quirk.text)} | {_linked(quirk.upstream)} |"
            for quirk in quirks
        ]
        lines.append("")
    return "\n".join(lines)


def _cell(text: str) -> str:
    text = re.sub(r"\b(_?[a-z]+(?:_[a-z]+)+)\b", r"`\1`", text.replace("`", ""))
    first = text.split(" ", maxsplit=1)[0]
    if first.removesuffix("'s") not in LOWER_CASE_NAMES:
        text = text[:1].upper() + text[1:]
    return text.replace("|", "\\|")


def _linked(upstream: str) -> str:
    upstream = DATE.sub("", upstream.replace("manual: ", ""))
    upstream = re.sub(r"(?<![\w/#-])([\w/-]*(?:_[\w]+|\.(?:c|h|rst)))(?![\w#(])", r"`\1`", upstream)
    return ISSUE.sub(r"[\1#\2](https://github.com/\1/issues/\2)", upstream)


def main() -> int:
    """Write the page."""
    PAGE.write_text(page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
