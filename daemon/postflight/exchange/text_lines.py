"""Text files of other programs: lines, words and numbers, with file and line in each error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from daemon.mission.foreign_files import ForeignFileError, read_regular_file
from daemon.postflight.exchange.block import BlockError

TEXT_MAX_BYTES: Final = 1_000_000_000


def only_file(folder: Path, patterns: Sequence[str], example: str) -> Path:
    """The one file of a folder that fits one of several patterns.

    Raises:
        BlockError: none, or several.
    """
    found = sorted({path for pattern in patterns for path in folder.glob(pattern)})
    if len(found) != 1:
        raise BlockError(
            f"{folder}: {len(found)} files {' or '.join(patterns)}; one is needed, such as "
            f"{example}"
        )
    return found[0]


def lines_of(path: Path) -> list[tuple[int, list[str]]]:
    """Numbers and words of all lines that are not empty.

    Raises:
        BlockError: the file cannot be read.
    """
    try:
        text = read_regular_file(path, TEXT_MAX_BYTES).decode("utf-8-sig", "replace")
    except ForeignFileError as error:
        raise BlockError(str(error)) from error
    rows = ((number, line.split()) for number, line in enumerate(text.splitlines(), 1))
    return [(number, words) for number, words in rows if words]


def numbers_of(path: Path, number: int, words: Sequence[str]) -> list[float]:
    """Words of a line as finite numbers.

    Raises:
        BlockError: a word is none; it names file and line.
    """
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise BlockError(f"{path}: line {number}: {error}") from error
    if not all(math.isfinite(value) for value in values):
        raise BlockError(f"{path}: line {number}: a finite number is needed")
    return values
