"""Patterns with named groups, matched in a time proportional to the length of the line.

The syntax is the part of Python's regular expressions that can be matched without backtracking.
No configured pattern and no received line can block the driver.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from drivers import DriverError

MAX_PATTERN: Final = 400
MAX_STEPS: Final = 800
"""Maximum number of steps, with counted repeats expanded."""
MAX_LINE: Final = 256
_LATIN: Final = "".join(map(chr, range(256)))
_REPEAT: Final = re.compile(r"\{(\d{0,4})(,?)(\d{0,4})\}")
_GROUP: Final = re.compile(r"\?P<([A-Za-z_]\w*)>|\?:")


def _compiled(text: str) -> re.Pattern[str]:
    with warnings.catch_warnings():
        # Quirk: Python warns that a bracket inside a class may get another meaning. It is a bracket
        # here. Upstream: manual: Python, re, section Regular Expression Syntax, sets.
        warnings.simplefilter("ignore", FutureWarning)
        return re.compile(text, re.ASCII | re.DOTALL)


class PatternError(DriverError, ValueError):
    """A pattern cannot be used; the message contains the reason."""


@dataclass(frozen=True)
class _Step:
    """One step of the program: `kind` char, split, save, begin, end or match."""

    kind: str
    characters: frozenset[str] = frozenset()
    nexts: tuple[int, ...] = ()
    slot: int = 0


class LinePattern:
    """A pattern, searched in a line of Latin-1 text.

    Supported are characters, `.`, classes, `\\d \\w \\s` and their opposites, groups, `|`, `* + ?`,
    `{m,n}`, their lazy forms, `^` and `$`. Elements that need backtracking are refused.

    Raises:
        PatternError: the pattern does not compile, or uses an unsupported element.

    Example:
        >>> LinePattern(r"T=(?P<nose>[-+]?\\d+\\.\\d)").search("12:00 T=-5.2 C")
        {'nose': '-5.2'}
    """

    def __init__(self, text: str) -> None:
        if len(text) > MAX_PATTERN:
            raise PatternError(f"it has {len(text)} characters; at most {MAX_PATTERN}")
        try:
            _compiled(text)
        except (re.error, RecursionError, OverflowError) as error:
            raise PatternError(f"it does not compile: {error}") from error
        self._text = text
        self._at = 0
        self.groups: list[str] = []
        self._steps: list[_Step] = []
        self._built = 0
        try:
            build_program = self._alternatives()
            self._start = build_program(self._add(_Step("match")))
        except RecursionError as error:
            raise PatternError("its groups are nested too deeply") from error

    def search(self, line: str) -> Mapping[str, str] | None:
        """Search a line for the leftmost match.

        Args:
            line: Latin-1 text; at most `MAX_LINE` characters are searched.

        Returns:
            Text by named group, in the order of the pattern, without groups that did not
            participate; None if the pattern does not match.
        """
        line = line[:MAX_LINE]
        found: tuple[int, ...] | None = None
        empty = (-1,) * (2 * len(self.groups))
        threads: list[tuple[int, tuple[int, ...]]] = []
        for at in range(len(line) + 1):
            if found is None:
                threads.append((self._start, empty))
            elif not threads:
                break
            character = line[at] if at < len(line) else ""
            following: list[tuple[int, tuple[int, ...]]] = []
            seen: set[int] = set()
            # Depth first in the order of preference, as Python's own matching would try them.
            stack = threads[::-1]
            while stack:
                number, slots = stack.pop()
                if number in seen:
                    continue
                seen.add(number)
                step = self._steps[number]
                if step.kind == "char":
                    if character in step.characters:
                        following.append((step.nexts[0], slots))
                elif step.kind == "match":
                    found = slots
                    break
                elif step.kind == "save":
                    slots = (*slots[: step.slot], at, *slots[step.slot + 1 :])
                    stack.append((step.nexts[0], slots))
                elif step.kind == "split":
                    stack.extend((following_step, slots) for following_step in step.nexts[::-1])
                elif at == (0 if step.kind == "begin" else len(line)):
                    stack.append((step.nexts[0], slots))
            threads = following
        if found is None:
            return None
        return {
            name: line[found[2 * index] : found[2 * index + 1]]
            for index, name in enumerate(self.groups)
            if found[2 * index] >= 0 and found[2 * index + 1] >= 0
        }

    # From text to steps: every part is a function from the step that follows to its own first step

    def _add(self, step: _Step) -> int:
        self._count_step()
        self._steps.append(step)
        return len(self._steps) - 1

    def _count_step(self) -> None:
        self._built += 1
        if self._built > MAX_STEPS:
            raise PatternError(f"with its repeats written out it has more than {MAX_STEPS} steps")

    def _peek(self) -> str:
        return self._text[self._at : self._at + 1]

    def _alternatives(self) -> Callable[[int], int]:
        branches = [self._sequence()]
        while self._peek() == "|":
            self._at += 1
            branches.append(self._sequence())
        if len(branches) == 1:
            return branches[0]
        return lambda after: self._add(
            _Step("split", nexts=tuple(branch(after) for branch in branches))
        )

    def _sequence(self) -> Callable[[int], int]:
        parts: list[Callable[[int], int]] = []
        while self._peek() not in ("", "|", ")"):
            parts.append(self._repeated(self._part()))

        def build(after: int) -> int:
            for part in reversed(parts):
                after = part(after)
            return after

        return build

    def _repeated(self, part: Callable[[int], int]) -> Callable[[int], int]:
        least, most = 1, 1
        counted = _REPEAT.match(self._text, self._at)
        if self._peek() and self._peek() in "*+?":
            least, most = {"*": (0, -1), "+": (1, -1), "?": (0, 1)}[self._peek()]
            self._at += 1
        elif counted and (counted[1] or counted[2]):
            least = int(counted[1] or 0)
            most = (int(counted[3]) if counted[3] else -1) if counted[2] else least
            self._at = counted.end()
        else:
            return part
        lazy = self._peek() == "?"
        if lazy:
            self._at += 1
        elif self._peek() == "+":
            raise PatternError(f"possessive repeats are not supported (at {self._at})")

        def build(after: int) -> int:
            first = after
            if most < 0:
                first = self._add(_Step("split"))
                body = part(first)
                nexts = (after, body) if lazy else (body, after)
                self._steps[first] = _Step("split", nexts=nexts)
            for optional in [True] * (most - least) + [False] * least:
                # Counted although it may be empty: nested empty repeats take time as well.
                self._count_step()
                first = part(first)
                if optional:
                    nexts = (after, first) if lazy else (first, after)
                    first = self._add(_Step("split", nexts=nexts))
            return first

        return build

    def _part(self) -> Callable[[int], int]:
        begin = self._at
        character = self._peek()
        if character == "(":
            return self._group()
        if character in "^$":
            self._at += 1
            kind = "begin" if character == "^" else "end"
            return lambda after: self._add(_Step(kind, nexts=(after,)))
        if character == "[":
            self._at += 2 if self._text[self._at + 1 : self._at + 2] == "^" else 1
            self._at += 2 if self._peek() == "\\" else 1  # a bracket in the first place is itself
            while self._peek() != "]":
                self._at += 2 if self._peek() == "\\" else 1
            self._at += 1
        elif character == "\\":
            escaped = self._text[self._at + 1 : self._at + 2]
            if escaped.isalnum() and escaped not in "dDwWsSt":
                raise PatternError(f"\\{escaped} at {begin} is not supported")
            self._at += 2
        else:
            self._at += 1
        one = _compiled(self._text[begin : self._at])
        characters = frozenset(c for c in _LATIN if one.fullmatch(c))
        return lambda after: self._add(_Step("char", characters, (after,)))

    def _group(self) -> Callable[[int], int]:
        begin = self._at
        self._at += 1
        name = None
        if self._peek() == "?":
            opened = _GROUP.match(self._text, self._at)
            if opened is None:
                raise PatternError(f"{self._text[begin : begin + 4]!r} at {begin} is not supported")
            name = opened[1]
            self._at = opened.end()
        index = len(self.groups)
        if name is not None:
            self.groups.append(name)
        inner = self._alternatives()
        self._at += 1
        if name is None:
            return inner

        def build(after: int) -> int:
            closing = self._add(_Step("save", nexts=(after,), slot=2 * index + 1))
            return self._add(_Step("save", nexts=(inner(closing),), slot=2 * index))

        return build
