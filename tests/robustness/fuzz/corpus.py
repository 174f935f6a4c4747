"""The committed inputs of each parser: one a line, as base64, shortest first."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from pathlib import Path

FOLDER = Path(__file__).parent / "corpus"
INPUT_MAX_NBYTES = 4_096
FILE_MAX_NBYTES = 40_000


def read(name: str) -> list[bytes]:
    """The inputs of a parser; none before any were found."""
    path = FOLDER / f"{name}.txt"
    return [base64.b64decode(line) for line in path.read_text().split()] if path.exists() else []


def write(name: str, inputs: Iterable[bytes]) -> None:
    """Replace the inputs of a parser by the shortest of these."""
    lines, nbytes = [], 0
    for data in sorted(set(inputs), key=lambda data: (len(data), data)):
        line = base64.b64encode(data).decode()
        nbytes += len(line) + 1
        if len(data) > INPUT_MAX_NBYTES or nbytes > FILE_MAX_NBYTES:
            break
        lines.append(line)
    FOLDER.mkdir(exist_ok=True)
    (FOLDER / f"{name}.txt").write_text("\n".join(lines) + "\n")
