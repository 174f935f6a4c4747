"""Format of the text lines of an unknown instrument, as a pattern.

Patterns are defined in `drivers.thermometers.ascii_line.pattern`.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from typing import Final

from drivers.thermometers.ascii_line.pattern import MAX_LINE, MAX_PATTERN

MIN_LINES: Final = 2
MAX_READINGS: Final = 64
_LINE: Final = re.compile(rb"[\t -~\xb0]{3,%d}(?=\r|\n)" % MAX_LINE)
_NUMBER: Final = re.compile(r"(?<![\w.])[-+]?\d{1,6}(?:[.,]\d{1,6})?(?![\w.])")
_NAMED: Final = re.compile(r"(?<=[=:])\s*[^\s=:,;]+")
_SPECIAL: Final = re.compile(r"([.^$*+?{}\[\]\\|()])")


@dataclass(frozen=True)
class LineFormat:
    """An example line, and the pattern and number of readings if the lines agree."""

    example: str
    pattern: str | None
    readings: int


def line_format_of(data: bytes) -> LineFormat | None:
    """The common format of the lines of a stream.

    A reading is the text after `=` or `:`, or else a number.

    Args:
        data: bytes as received; the first line may be incomplete.

    Returns:
        The most frequent format; None if the bytes are no text or their lines have no readings.

    Example:
        >>> found = line_format_of(b"T1=21.5 T2=OPEN\\r\\nT1=21.6 T2=-3.0\\r\\n")
        >>> found.pattern, found.readings
        ('^T1=(?P<t0>\\\\S+) T2=(?P<t1>\\\\S+)$', 2)
    """
    # The first bytes may begin in the middle of a line.
    lines_found = [match.decode("latin-1") for match in _LINE.findall(data)]
    text = sum(len(line) for line in lines_found)
    if (
        len(lines_found) < MIN_LINES
        or text < 0.8 * len(data.translate(None, b"\r\n\x00")) - MAX_LINE
    ):
        return None
    shapes = Counter(shape for line in lines_found if (shape := _shape(line)) is not None)
    if not shapes:
        return None
    (pattern, readings), often = shapes.most_common(1)[0]
    example = next(line for line in lines_found if _shape(line) == (pattern, readings))
    agreed = often >= MIN_LINES and often >= len(lines_found) - 1 and len(pattern) <= MAX_PATTERN
    return LineFormat(example, pattern if agreed else None, readings)


def _shape(line: str) -> tuple[str, int] | None:
    """The line with its readings replaced by groups, and their number.

    None if it has no reading or is a sentence of another protocol.
    """
    if line[0] in "$!#%{":
        return None
    places = list(_NAMED.finditer(line)) or list(_NUMBER.finditer(line))
    if not 1 <= len(places) <= MAX_READINGS or not any(_NUMBER.search(p[0]) for p in places):
        return None
    pattern, at = "^", 0
    for number, place in enumerate(places):
        lead = len(place[0]) - len(place[0].lstrip())
        pattern += _SPECIAL.sub(r"\\\1", line[at : place.start()])
        pattern += (r"\s*" if lead else "") + rf"(?P<t{number}>\S+)"
        at = place.end()
    return pattern + _SPECIAL.sub(r"\\\1", line[at:]) + "$", len(places)
