"""Records of measurements: the data that the tables and figures in the documents are made from.

Every `*.json` next to this file is one record: what was measured, with which command, on which
machine and when. `python -m benchmarks.records` writes them into the documents, between the lines
`<!-- record: NAME -->` and `<!-- end of record -->`. Figures are never edited in a document.
"""

from __future__ import annotations

import json
import os
import re
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Final

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, model_validator

FOLDER: Final = Path(__file__).parent
ROOT: Final = FOLDER.parents[1]
WIDTH: Final = 100
END: Final = "<!-- end of record -->"
NOT_RECORDED: Final = "not recorded"
IN_ROWS: Final = "in the rows"
"""Command or machine: each row of the record states its own, where it is known."""
_BLOCK: Final = re.compile(
    r"^<!-- record: (?P<name>[a-z0-9-]+) -->\n(?P<content>.*?)^<!-- end of record -->$",
    re.MULTILINE | re.DOTALL,
)
_LIST_MARK: Final = re.compile(r"([-+*#>]|\d+[.)])\s")

Text = Annotated[str, StringConstraints(min_length=1, pattern=r"^[^\n]+$")]
Day = Annotated[str, StringConstraints(pattern=r"^20\d\d-[01]\d-[0-3]\d$")]


class RecordError(ValueError):
    """A record or a document that names it cannot be used; the message names file and cause."""


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Table(_Model):
    """Figures in rows; a cell holds what is printed."""

    columns: tuple[str, ...] = Field(min_length=1)
    rows: tuple[tuple[str, ...], ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _rows_fill_the_columns(self) -> Table:
        for number, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                raise ValueError(
                    f"row {number} has {len(row)} cells; there are {len(self.columns)} columns"
                )
        return self


class Part(_Model):
    """One part of a record in the order of the document: a sentence, a list item or a table."""

    text: Text | None = None
    item: Text | None = None
    table: Table | None = None

    @model_validator(mode="after")
    def _is_one_of_them(self) -> Part:
        if sum(value is not None for value in (self.text, self.item, self.table)) != 1:
            raise ValueError("give one of text, item and table")
        return self


class Record(_Model):
    """One measurement: how, where and when it was made, and what came out.

    `command` and `machine` are `NOT_RECORDED` where the source of an old record does not state
    them, and `IN_ROWS` where rows differ.
    `conditions` are what else mattered: load of the machine, seeds, the state of the code.
    """

    date: tuple[Day, ...] = Field(min_length=1)
    command: Text
    machine: Text
    conditions: Text | None = None
    figures: tuple[Part, ...] = Field(min_length=1)


def read_record(path: Path) -> Record:
    """Read one record.

    Raises:
        RecordError: it is not valid; every error is named.
    """
    try:
        return Record.model_validate(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        raise RecordError(f"{path}: {error}") from error


def all_records() -> dict[str, Record]:
    """All records by the name of their file.

    Raises:
        RecordError: one is not valid.
    """
    return {path.stem: read_record(path) for path in sorted(FOLDER.glob("*.json"))}


def documents() -> list[Path]:
    """The documents that may hold records."""
    return [
        ROOT / "README.md",
        ROOT / "benchmarks" / "README.md",
        *sorted((ROOT / "docs").rglob("*.md")),
    ]


def rendered(name: str, record: Record, document: Path) -> str:
    """Markdown of a record, with a link to its file from a document."""
    lines: list[str] = []
    for part in record.figures:
        if part.table is not None:
            lines += ["", *_table(part.table), ""]
        elif part.item is not None:
            lines += _wrapped(part.item, "- ", "  ")
        else:
            assert part.text is not None
            lines += ["", *_wrapped(part.text, "", ""), ""]
    address = Path(os.path.relpath(FOLDER / f"{name}.json", document.parent)).as_posix()
    is_stated = record.command not in (NOT_RECORDED, IN_ROWS)
    known = [
        f"`{record.command}`" if is_stated else f"command {record.command}",
        f"machine {record.machine}"
        if record.machine in (NOT_RECORDED, IN_ROWS)
        else record.machine,
        " and ".join(record.date),
        *([record.conditions] if record.conditions else []),
    ]
    source = f"Record [{name}]({address}): {'; '.join(known)}."
    lines += ["", *_wrapped(source, "", "")]
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines)).strip("\n") + "\n"


def updated(text: str, document: Path, records: dict[str, Record]) -> str:
    """A document's text with its records as they are now.

    Raises:
        RecordError: it names a record that does not exist, or a record does not end.
    """

    def replaced(found: re.Match[str]) -> str:
        name = found["name"]
        if name not in records:
            raise RecordError(f"{document}: no record {name} in {FOLDER}")
        # Blank lines: some renderers take what follows a comment for HTML.
        return f"<!-- record: {name} -->\n\n{rendered(name, records[name], document)}\n{END}"

    if text.count("<!-- record: ") != len(_BLOCK.findall(text)) or text.count(END) != len(
        _BLOCK.findall(text)
    ):
        raise RecordError(f"{document}: a record has no line {END}")
    return _BLOCK.sub(replaced, text)


def used_records(text: str) -> Iterator[str]:
    """Names of the records in a document."""
    return (found["name"] for found in _BLOCK.finditer(text))


def without_records(text: str) -> str:
    """A document's own text."""
    return _BLOCK.sub("", text)


def _table(table: Table) -> list[str]:
    rows: Sequence[Sequence[str]] = [table.columns, ["---"] * len(table.columns), *table.rows]
    return ["|" + "".join(f" {cell} |" if cell else " |" for cell in row) for row in rows]


def _wrapped(text: str, first: str, later: str) -> list[str]:
    lines = textwrap.wrap(
        text,
        WIDTH,
        initial_indent=first,
        subsequent_indent=later,
        break_long_words=False,
        break_on_hyphens=False,
    )
    result = lines[:1]
    for line in lines[1:]:
        # A word that would begin a list or a heading stays at the end of the line before.
        if _LIST_MARK.match(line.lstrip()):
            result[-1] += " " + line.lstrip()
        else:
            result.append(line)
    return result
