"""A table of a rig file that answers typed questions and remembers every mistake.

What the questions are is in `processing.rig.rig_file`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

NUMBER_LIMIT = 1e12
"""No length, angle, count or coefficient of a camera, in the units of the file, comes near."""
TEXT_MAX_CHARACTERS = 1000
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.\-]{0,63}")


def plain_name(name: str) -> bool:
    """Whether a sensor or file name is safe in a path: letters, digits, `_`, `-`, inner dots."""
    return _NAME.fullmatch(name) is not None and ".." not in name


class RigError(ValueError):
    """A rig file that cannot be used; `problems` holds one sentence for each mistake found."""

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(problems))


class TomlTable:
    """A TOML table that answers typed questions and notes every mistake with its full key."""

    def __init__(
        self, content: Mapping[str, Any], path: str, file: str, problems: list[str]
    ) -> None:
        self.content = content
        self.path = path
        self.file = file
        self.problems = problems
        self.known_keys: set[str] = set()

    def add_problem(self, key: str, hint: str) -> None:
        found = f"is {_shown(self.content[key])}" if key in self.content else "is missing"
        self.problems.append(f"{self.file}: {self._key(key)} {found}; {hint}")

    def number(
        self,
        key: str,
        default: float | None = None,
        *,
        positive: bool = False,
        requirement: str = "",
        limits: tuple[float, float] | None = None,
    ) -> float:
        value = self._get(key, default, "a number is needed")
        if value is None:
            return 1.0
        if not _is_number(value):
            self.add_problem(key, "a finite number is needed")
            return 1.0
        if positive and value <= 0:
            self.add_problem(key, requirement or "it is positive")
            return 1.0
        if limits is not None and not limits[0] <= value <= limits[1]:
            self.add_problem(key, f"it lies between {limits[0]:g} and {limits[1]:g}")
            return 1.0
        return float(value)

    def integer(
        self,
        key: str,
        default: int | None = None,
        *,
        positive: bool = False,
        limits: tuple[int, int] = (-(2**53), 2**53),
    ) -> int:
        value = self._get(key, default, "a whole number is needed")
        if value is None:
            return 1
        if isinstance(value, bool) or not isinstance(value, int):
            self.add_problem(key, "a whole number is needed")
            return 1
        if positive and value <= 0:
            self.add_problem(key, "it is positive")
            return 1
        if not limits[0] <= value <= limits[1]:
            self.add_problem(key, f"it lies between {limits[0]} and {limits[1]}")
            return 1
        return value

    def name(self, key: str) -> str:
        """A text that is safe as a file name."""
        value = self.text(key)
        if value and not plain_name(value):
            self.add_problem(key, "letters, digits, '_', '-' and inner dots only, 64 at most")
            return ""
        return value

    def text(self, key: str, default: str | None = None) -> str:
        value = self._get(key, default, "a text is needed")
        if value is not None and not isinstance(value, str):
            self.add_problem(key, "a text is needed")
            return ""
        if value and not (len(value) <= TEXT_MAX_CHARACTERS and value.isprintable()):
            self.add_problem(key, f"{TEXT_MAX_CHARACTERS} characters at most, all of them visible")
            return ""
        return value or ""

    def choice(self, key: str, allowed: Sequence[str], default: str | None = None) -> str:
        value = self._get(key, default, f"it is one of {', '.join(allowed)}")
        if value is not None and value not in allowed:
            self.add_problem(key, f"it is one of {', '.join(allowed)}")
        return value if isinstance(value, str) and value in allowed else allowed[0]

    def texts(self, key: str) -> tuple[str, ...]:
        value = self._get(key, None, "a list of texts is needed")
        if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
            if value is not None:
                self.add_problem(key, "a list of texts is needed")
            return ()
        return tuple(value)

    def triple(self, key: str) -> tuple[float, float, float]:
        value = self._get(key, None, "three numbers are needed")
        good = isinstance(value, list) and len(value) == 3 and all(map(_is_number, value))
        if not good:
            if value is not None:
                self.add_problem(key, "three numbers are needed")
            return (0.0, 0.0, 0.0)
        return (float(value[0]), float(value[1]), float(value[2]))

    def steps(self, key: str) -> tuple[float, ...]:
        """Two numbers or more, ascending by equal steps."""
        hint = "two numbers or more are needed, ascending by equal steps"
        values = _numbers(self._get(key, None, hint))
        steps = [b - a for a, b in pairwise(values)]
        if not steps or min(steps) <= 0 or max(steps) - min(steps) > 1e-6 * max(steps):
            if key in self.content:
                self.add_problem(key, hint)
            return (0.0, 1.0)
        return values

    def matrix(self, key: str, rows: int, columns: int) -> tuple[tuple[float, ...], ...]:
        """Lists of numbers, so many and so long."""
        hint = f"{rows} lists of {columns} numbers are needed"
        value = self._get(key, None, hint)
        found = tuple(_numbers(row) for row in value) if isinstance(value, list) else ()
        if len(found) != rows or any(len(row) != columns for row in found):
            if key in self.content:
                self.add_problem(key, hint)
            return ((0.0,) * columns,) * rows
        return found

    def table(self, key: str, *, optional: bool = False) -> TomlTable:
        value = self._get(key, {} if optional else None, f"a table [{self._key(key)}] is needed")
        if value is not None and not isinstance(value, dict):
            self.add_problem(key, "a table is needed")
        content = value if isinstance(value, dict) else {}
        return TomlTable(content, self._key(key), self.file, self.problems)

    def tables(self, key: str) -> Iterator[TomlTable]:
        value = self._get(key, None, f"at least one [[{self._key(key)}]] is needed")
        if value is not None and not (
            isinstance(value, list) and all(isinstance(v, dict) for v in value)
        ):
            self.add_problem(key, f"a list of tables [[{self._key(key)}]] is needed")
            value = None
        for index, content in enumerate(value or ()):
            yield TomlTable(content, f"{self._key(key)}[{index}]", self.file, self.problems)

    def with_defaults(self, defaults: TomlTable) -> TomlTable:
        """This table with another's values where it has none of its own."""
        defaults.known_keys.update(defaults.content)
        return TomlTable({**defaults.content, **self.content}, self.path, self.file, self.problems)

    def refuse_unknown(self) -> None:
        for key in self.content:
            if key not in self.known_keys:
                self.add_problem(key, "no such key; check the spelling")

    def _get(self, key: str, default: Any, hint: str) -> Any:
        self.known_keys.add(key)
        if key not in self.content:
            if default is None:
                self.add_problem(key, hint)
            return default
        return self.content[key]

    def _key(self, key: str) -> str:
        return f"{self.path}.{key}" if self.path else key


def _numbers(value: object) -> tuple[float, ...]:
    """A list's numbers; none of them where one is no finite number."""
    if not isinstance(value, list):
        return ()
    return tuple(float(v) for v in value) if all(map(_is_number, value)) else ()


def _is_number(value: object) -> bool:
    """Whether it is a number of a size that a camera may have; a TOML integer has any size."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and -NUMBER_LIMIT <= value <= NUMBER_LIMIT  # type: ignore[operator]


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
