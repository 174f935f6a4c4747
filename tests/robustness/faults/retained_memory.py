"""Bytes that objects of this repository keep."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Iterable, Mapping


def retained_nbytes(roots: Iterable[object]) -> int:
    """Bytes held in the data that parsers keep: containers, text and numbers, each once."""
    seen: set[int] = set()
    waiting = list(roots)
    total = 0
    while waiting:
        item = waiting.pop()
        if id(item) in seen or isinstance(item, type) or callable(item):
            continue
        seen.add(id(item))
        total += sys.getsizeof(item)
        if isinstance(item, Mapping):
            waiting += [*item.keys(), *item.values()]
        elif isinstance(item, list | tuple | set | frozenset | deque):
            waiting += item
        elif hasattr(item, "__dict__") and type(item).__module__.split(".")[0] in _OURS:
            waiting.append(vars(item))
        elif hasattr(item, "__slots__"):
            waiting += [getattr(item, name, None) for name in item.__slots__]
    return total


_OURS = frozenset(("drivers", "sim_hw", "tests"))
