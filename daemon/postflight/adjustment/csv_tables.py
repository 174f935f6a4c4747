"""Tables of an adjustment project: CSV with a line of column names, `#` begins a remark.

Mistakes are gathered with file and line, so that all of them are reported at once.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from daemon import DaemonError
from daemon.mission.foreign_files import ForeignFileError, read_regular_file
from daemon.mission.store.durable import new_file
from processing.rig.problem_sentences import ProblemList

UNUSED = "unused"
"""In place of a standard deviation: the observation takes no part."""

_SEPARATORS = {";": "semicolons", "\t": "tabulators"}
_MAX_BYTES = 2_000_000_000
_MAX_PROBLEMS = 30
_MAX_LISTED = 10


class ProjectError(ProblemList, DaemonError, ValueError):
    """A project that cannot be read; `problems` holds one message for each mistake found."""


@dataclass
class CsvTable:
    """Rows of one file as text, and what was wrong with them."""

    file: str
    columns: tuple[str, ...]
    rows: list[list[str]]
    lines: list[int]
    header: int = 1
    problems: list[str] = field(default_factory=list)
    remarks: list[int] = field(default_factory=list)
    """Lines after the header that begin with # and contain a comma: rows that were left out."""

    def has(self, column: str) -> bool:
        return column in self.columns

    def text(self, column: str, default: str = "") -> list[str]:
        """A column of texts; an empty cell is `default`."""
        if column not in self.columns:
            return [default] * len(self.rows)
        at = self.columns.index(column)
        return [row[at] or default for row in self.rows]

    def names(self, column: str) -> list[str]:
        """A column of names, none of them twice or empty."""
        found = self.text(column)
        seen: set[str] = set()
        for name, line in zip(found, self.lines, strict=True):
            if not name:
                self.add_problem(line, f"{column} is empty")
            elif name in seen:
                self.add_problem(line, f"{column} {name!r} is given twice")
            seen.add(name)
        return found

    def numbers(self, column: str, default: float = math.nan) -> list[float]:
        """A column of numbers; an empty cell is `default`."""
        if column not in self.columns:
            return [default] * len(self.rows)
        at = self.columns.index(column)
        found = []
        for row, line in zip(self.rows, self.lines, strict=True):
            try:
                value = _number(row[at]) if row[at] else default
            except ValueError:
                self.add_problem(line, f"{column} is {row[at]!r}; a number is right")
                value = default
            found.append(value)
        return found

    def sigmas(self, column: str) -> list[float]:
        """A column of standard deviations; `unused` is infinite, an empty cell is NaN."""
        if column not in self.columns:
            return [math.nan] * len(self.rows)
        at = self.columns.index(column)
        unused = [row[at] == UNUSED for row in self.rows]
        bare = [["" if off else row[at]] for off, row in zip(unused, self.rows, strict=True)]
        found = CsvTable(self.file, (column,), bare, self.lines, problems=self.problems)
        values = zip(unused, found.numbers(column), strict=True)
        return [math.inf if off else value for off, value in values]

    def remark_sentences(self) -> list[str]:
        """A sentence where remarks after the header may be rows that were left out."""
        if not self.remarks:
            return []
        listed = ", ".join(str(line) for line in self.remarks[:_MAX_LISTED])
        more = ", ..." if len(self.remarks) > _MAX_LISTED else ""
        return [
            f"{self.file}: {len(self.remarks)} lines that begin with # contain a comma and are "
            f"left out as remarks (line {listed}{more}); quote a name that begins with #"
        ]

    def add_problem(self, line: int, what: str) -> None:
        problem = f"{self.file}:{line}: {what}"
        if len(self.problems) < _MAX_PROBLEMS and problem not in self.problems:
            self.problems.append(problem)


def _number(cell: str) -> float:
    """A finite decimal number in ASCII digits; float() reads 1_000 and full-width digits too."""
    value = float(cell)
    if not math.isfinite(value) or not cell.isascii() or "_" in cell:
        raise ValueError(cell)
    return value


def read_table(path: Path, needed: Sequence[str], known: Sequence[str]) -> CsvTable:
    """Read a table.

    Args:
        path: the file.
        needed: columns it must have.
        known: columns it may have in addition.

    Raises:
        ProjectError: no such file, columns that are missing, not known or named twice, or a remark
            that looks like a row.
    """
    try:
        text = read_regular_file(path, _MAX_BYTES).decode("utf-8-sig")
    except ForeignFileError as error:
        raise ProjectError([str(error)]) from error
    except UnicodeDecodeError as error:
        raise ProjectError([f"{path}: cannot be read ({error}); save it as UTF-8"]) from error
    columns: tuple[str, ...] = ()
    rows: list[list[str]] = []
    lines: list[int] = []
    problems: list[str] = []
    remarks: list[int] = []
    header = 1
    for number, line in enumerate(text.splitlines(), 1):
        bare = line.strip()
        if not bare:
            continue
        if bare.startswith("#"):
            if is_row(bare, columns) and len(problems) < _MAX_PROBLEMS:
                name = bare.split(",")[0]
                problems.append(
                    f"{path.name}:{number}: {name!r} looks like a name, and # begins a remark: "
                    "write a space after the # of a remark, or rename it"
                )
            elif columns and "," in bare:
                remarks.append(number)
            continue
        cells = [cell.strip() for cell in next(csv.reader([bare]))]
        if not columns:
            columns, header = tuple(cells), number
            if found := next((own for own in _SEPARATORS if len(bare.split(own)) > len(cells)), ""):
                raise ProjectError(
                    [
                        f"{path.name}:{number}: cells are separated by {_SEPARATORS[found]}; write "
                        "commas, and decimals with points"
                    ]
                )
            missing = [c for c in needed if c not in columns]
            foreign = [c for c in columns if c not in needed and c not in known]
            repeated = list(dict.fromkeys(c for c in columns if c and columns.count(c) > 1))
            if repeated:
                problems.append(f"{path.name}:{number}: columns {repeated} are named twice")
            if missing:
                problems.append(f"{path.name}:{number}: columns {missing} are missing")
            if foreign:
                allowed = ", ".join([*needed, *known])
                problems.append(f"{path.name}:{number}: columns {foreign} are not among {allowed}")
            if problems:
                raise ProjectError(problems)
            continue
        if len(cells) != len(columns):
            if len(problems) < _MAX_PROBLEMS:
                hint = "; write decimals with points" if len(cells) > len(columns) else ""
                hint = "; separate cells by commas" if ";" in bare or "\t" in bare else hint
                problems.append(
                    f"{path.name}:{number}: {len(cells)} cells for {len(columns)} columns{hint}"
                )
            continue
        rows.append(cells)
        lines.append(number)
    if not columns:
        problems.append(f"{path.name}: empty; its first line names the columns {list(needed)}")
    if problems:
        raise ProjectError(problems)
    return CsvTable(path.name, columns, rows, lines, header, remarks=remarks)


def is_row(remark: str, columns: Sequence[str]) -> bool:
    """Whether a line that begins with # has the cells of a row and no space after the #.

    Args:
        remark: the line.
        columns: of the table.

    Returns:
        True where a name that begins with # was probably meant.
    """
    first = remark.lstrip("#")[:1]
    has_name = bool(first) and not first.isspace()
    return len(columns) > 1 and has_name and remark.count(",") == len(columns) - 1


def write_table(
    path: Path, remark: str, columns: Sequence[str], rows: Iterable[Sequence[str | float]]
) -> None:
    """Write a table; numbers in their shortest exact form, NaN as empty cells, inf as unused."""
    with new_file(path) as part, part.open("w", encoding="utf-8", newline="") as file:
        for line in remark.splitlines():
            file.write(f"# {line}\n")
        file.write(",".join(columns) + "\n")
        writer = csv.writer(file, lineterminator="\n")
        for row in rows:
            cells = [_cell(value) for value in row]
            if cells[0].startswith("#"):
                # A name that begins with the mark of a remark is quoted, or the row would be one.
                file.write('"' + cells[0].replace('"', '""') + '"' + "," * (len(cells) > 1))
                cells = cells[1:]
            if cells:
                writer.writerow(cells)
            else:
                file.write("\n")


def _cell(value: str | float) -> str:
    if isinstance(value, str):
        return value
    if math.isinf(value):
        return UNUSED
    return "" if math.isnan(value) else repr(float(value))
