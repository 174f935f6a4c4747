"""Memory that the control groups of this process leave to it.

A limit of any group from that of the process up to the root holds. Version 1 and 2, and both next
to each other, are read.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Final

_LIMITS: Final = ("memory.max", "memory.high", "memory.limit_in_bytes")
_USED: Final = ("memory.current", "memory.usage_in_bytes")
_INACTIVE: Final = ("inactive_file", "total_inactive_file")


def group_free_nbytes(
    membership: Path = Path("/proc/self/cgroup"), root: Path = Path("/sys/fs/cgroup")
) -> int | None:
    """Least free memory of the groups of this process in bytes; None where none has a limit.

    Args:
        membership: groups of the process, a line for each hierarchy.
        root: where the hierarchies are mounted.

    Source: cgroups(7); Linux kernel documentation, Control Group v2 (memory.max, memory.high) and
    Memory Resource Controller (memory.limit_in_bytes).
    """
    free = [_free_nbytes(folder) for folder in _folders(membership, root)]
    return min((nbytes for nbytes in free if nbytes is not None), default=None)


def _folders(membership: Path, root: Path) -> Iterator[Path]:
    """Folders of the groups that may limit memory, from the innermost to the root."""
    try:
        lines = membership.read_text("utf-8", "replace").splitlines()
    except OSError:
        lines = ["0::/"]
    for line in lines:
        _, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if controllers and "memory" not in controllers.split(","):
            continue
        base = root / "memory" if controllers else root
        # In a container without its own view the path is of the host; then only `base` exists.
        below = PurePosixPath(path.lstrip("/"))
        places = [] if ".." in below.parts else [below, *below.parents]
        yield from (base / place for place in places or [PurePosixPath(".")])


def _free_nbytes(folder: Path) -> int | None:
    limits = [nbytes for name in _LIMITS if (nbytes := _number(folder / name)) is not None]
    used = next((nbytes for name in _USED if (nbytes := _number(folder / name)) is not None), None)
    if not limits or used is None:
        return None
    return max(0, min(limits) - used + _inactive_nbytes(folder / "memory.stat"))


def _number(path: Path) -> int | None:
    try:
        return int(path.read_text("ascii"))
    except (OSError, ValueError):
        return None  # "max", or no such file


def _inactive_nbytes(path: Path) -> int:
    """File pages that the kernel reclaims first."""
    try:
        statistics = dict(line.split() for line in path.read_text("ascii").splitlines())
        return next(
            (int(statistics[name]) for name in reversed(_INACTIVE) if name in statistics), 0
        )
    except (OSError, ValueError):
        return 0
