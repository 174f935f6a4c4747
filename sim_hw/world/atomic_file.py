"""Files of the emulator appear under their name when they are complete."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """A file next to `path` to write to; it takes that name when the block ends without an error.

    Otherwise it is removed, and an earlier file is unchanged. It is not synced: what is emulated
    can be made again after a power loss.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
