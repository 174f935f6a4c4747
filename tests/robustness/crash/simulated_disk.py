"""A disk that may lose power after any operation, and every state it may be found in then.

The weakest promises of POSIX, not those of a good file system: bytes are safe when their file was
synced, names when the folder that holds them was, and nothing else is. A rename is atomic. What is
not safe may be there or not, in any combination.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

from tests.robustness.crash.write_log import Operation

REBUILT = "-shm"
"""SQLite rebuilds this file; it is never put on a disk here."""


@dataclass
class _Node:
    """A file or folder. What it holds for sure, and what was asked for since."""

    is_folder: bool
    data: bytes = b""
    entries: dict[str, int] = field(default_factory=dict)
    pending: list[_Change] = field(default_factory=list)
    position: int = 0


@dataclass(frozen=True)
class _Change:
    """Bytes put at an offset, or (`data` None) a new size."""

    offset: int
    data: bytes | None


@dataclass
class _Naming:
    """One atomic change of names: (folder, name) to a node, or to nothing."""

    changes: tuple[tuple[int, str, int | None], ...]
    unsynced: set[int]


Chosen = Callable[[Sequence[object]], Sequence[bool]]
"""Of things not safe yet, in order, which survive."""

Tree = Mapping[str, bytes | None]
"""Path below the root to bytes, None for a folder."""


class Disk:
    """Takes operations below `root` and computes what may be left of them."""

    def __init__(self, root: Path) -> None:
        self._root = PurePosixPath(root)
        self._nodes: dict[int, _Node] = {0: _Node(is_folder=True)}
        self._namings: list[_Naming] = []

    def apply(self, operation: Operation) -> None:
        """Do what the program did."""
        path = operation.path
        if operation.kind in ("create", "mkdir"):
            node = self._find(path)
            if node is None:
                self._nodes[len(self._nodes)] = _Node(is_folder=operation.kind == "mkdir")
                self._name((*self._place(path), len(self._nodes) - 1))
            elif operation.empties:
                self._change(node, _Change(0, None))
        elif operation.kind == "rename":
            folder, name = self._place(path)
            moved = self._entries(folder)[name]
            self._name((folder, name, None), (*self._place(operation.target), moved))
        elif operation.kind == "exchange":
            (folder, name), (other, target_name) = self._place(path), self._place(operation.target)
            one, two = self._entries(folder)[name], self._entries(other)[target_name]
            self._name((folder, name, two), (other, target_name, one))
        elif operation.kind == "unlink":
            self._name((*self._place(path), None))
        elif operation.kind == "sync":
            self._sync(self._need(path))
        elif operation.kind == "truncate":
            self._change(self._need(path), _Change(operation.size, None))
        else:
            node = self._nodes[self._need(path)]
            offset = node.position if operation.offset is None else operation.offset
            node.pending.append(_Change(offset, operation.data))
            if operation.offset is None:
                node.position += len(operation.data)

    def left(self, names: Chosen, data: Chosen, *, zeros: bool = False) -> Tree:
        """What is found after the power came back.

        Args:
            names: which of the changes of names survive.
            data: which of the changes of a file's bytes survive.
            zeros: sizes survive, bytes that were not safe are zero.
        """
        entries = {i: dict(n.entries) for i, n in self._nodes.items() if n.is_folder}
        for naming, survives in zip(self._namings, names(self._namings), strict=True):
            if survives:
                _rename(entries, naming)
        tree: dict[str, bytes | None] = {}

        def visit(folder: int, path: str) -> None:
            for name, node in sorted(entries[folder].items()):
                if name.endswith(REBUILT):
                    continue
                where = f"{path}{name}"
                if self._nodes[node].is_folder:
                    tree[where] = None
                    visit(node, f"{where}/")
                else:
                    tree[where] = self._bytes(self._nodes[node], data, zeros=zeros)

        visit(0, "")
        return tree

    def torn(self, operation: Operation) -> Tree:
        """What is found after a kill in the middle of a write that is about to be done."""
        node = self._nodes[self._need(operation.path)]
        position = node.position
        half = operation.data[: len(operation.data) // 2]
        self.apply(replace(operation, data=half))
        tree = self.left(select_all, select_all)
        node.pending.pop()
        node.position = position
        return tree

    @property
    def unsafe(self) -> int:
        """How many changes a power cut may take."""
        return len(self._namings) + sum(len(node.pending) for node in self._nodes.values())

    def _bytes(self, node: _Node, chosen: Chosen, *, zeros: bool) -> bytes:
        content = bytearray(node.data)
        for change, survives in zip(node.pending, chosen(node.pending), strict=True):
            if not survives and not zeros:
                continue
            if change.data is None:
                content = content[: change.offset].ljust(change.offset, b"\0")
                continue
            end = change.offset + len(change.data)
            if len(content) < end:
                content += bytes(end - len(content))
            if survives:
                content[change.offset : end] = change.data
        return bytes(content)

    def _change(self, node: int, change: _Change) -> None:
        self._nodes[node].pending.append(change)
        if change.data is None:
            self._nodes[node].position = min(self._nodes[node].position, change.offset)

    def _name(self, *changes: tuple[int, str, int | None]) -> None:
        self._namings.append(_Naming(changes, {folder for folder, _, _ in changes}))

    def _sync(self, number: int) -> None:
        node = self._nodes[number]
        node.data = self._bytes(node, select_all, zeros=False)
        node.pending.clear()
        for naming in self._namings:
            naming.unsynced.discard(number)
        # A change of two folders is safe when both are; until then so is nothing that follows it.
        while self._namings and not self._namings[0].unsynced:
            self._commit_names(self._namings.pop(0))
        pending = []
        blocked: set[tuple[int, str]] = set()
        for naming in self._namings:
            touched = {(folder, name) for folder, name, _ in naming.changes}
            if naming.unsynced or touched & blocked:
                blocked |= touched
                pending.append(naming)
            else:
                self._commit_names(naming)
        self._namings = pending

    def _commit_names(self, naming: _Naming) -> None:
        _rename({i: n.entries for i, n in self._nodes.items() if n.is_folder}, naming)

    def _entries(self, folder: int) -> dict[str, int]:
        """What a folder holds as the program sees it."""
        entries = {folder: dict(self._nodes[folder].entries)}
        for naming in self._namings:
            _rename(entries, naming)
        return entries[folder]

    def _place(self, path: str) -> tuple[int, str]:
        where = PurePosixPath(path)
        return self._need(str(where.parent)), where.name

    def _need(self, path: str) -> int:
        node = self._find(path)
        assert node is not None, f"{path} is not there"
        return node

    def _find(self, path: str) -> int | None:
        node = 0
        for part in PurePosixPath(path).relative_to(self._root).parts:
            if not self._nodes[node].is_folder or part not in (entries := self._entries(node)):
                return None
            node = entries[part]
        return node


def _rename(entries: Mapping[int, dict[str, int]], naming: _Naming) -> None:
    for folder, name, node in naming.changes:
        if folder not in entries:
            continue
        if node is None:
            entries[folder].pop(name, None)
        else:
            entries[folder][name] = node


def select_all(items: Sequence[object]) -> Sequence[bool]:
    return [True] * len(items)


def select_none(items: Sequence[object]) -> Sequence[bool]:
    return [False] * len(items)


def select_last(items: Sequence[object]) -> Sequence[bool]:
    return [index == len(items) - 1 for index in range(len(items))]


def select_all_but_first(items: Sequence[object]) -> Sequence[bool]:
    return [index > 0 for index in range(len(items))]


ALL_WRITTEN = "all kept, as after kill -9"
TORN = "all kept, the last write half done"
DROPPED = "all unsynced dropped"
ZEROS = "names and sizes kept, bytes zero"
VARIANTS: Mapping[str, Callable[[Disk], Tree]] = {
    ALL_WRITTEN: lambda disk: disk.left(select_all, select_all),
    DROPPED: lambda disk: disk.left(select_none, select_none),
    ZEROS: lambda disk: disk.left(select_all, select_none, zeros=True),
    "names kept, bytes dropped": lambda disk: disk.left(select_all, select_none),
    "bytes kept, names dropped": lambda disk: disk.left(select_none, select_all),
    "only the last change survives": lambda disk: disk.left(select_last, select_last),
    "all but the first survive": lambda disk: disk.left(select_all_but_first, select_all_but_first),
}
"""States tried at each cut, in addition to a torn write and arbitrary survivors."""


def variants(disk: Disk, names: Collection[str]) -> Iterator[tuple[str, Tree]]:
    """What may be left, by the name of the variant."""
    for name, left in VARIANTS.items():
        if name in names and (name == ALL_WRITTEN or disk.unsafe):
            yield name, left(disk)


def at_random(disk: Disk, rng: random.Random, count: int) -> Iterator[tuple[str, Tree]]:
    """Arbitrary sets of survivors, every other time with zeros in place of what was lost."""

    def chosen(items: Sequence[object]) -> Sequence[bool]:
        return [rng.random() < 0.5 for _ in items]

    for index in range(count if disk.unsafe else 0):
        yield "arbitrary survivors", disk.left(chosen, chosen, zeros=bool(index % 2))


def put(tree: Tree, folder: Path) -> None:
    """Make a state real in an empty folder."""
    folder.mkdir()
    for path, data in tree.items():
        if data is None:
            (folder / path).mkdir()
        else:
            (folder / path).write_bytes(data)
