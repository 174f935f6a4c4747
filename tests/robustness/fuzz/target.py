"""A parser that is fuzzed, and files for those that read files."""

from __future__ import annotations

import atexit
import functools
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

INPUT_MAX_S = 1.0


INPUT_MAX_NBYTES = 64_000_000


INPUT_MAX_SIZE = 16_384
"""No longer inputs are tried: what is long is bounded by the limits of each reader."""


@dataclass(frozen=True)
class Target:
    """A parser, the errors that it documents, and inputs to begin with."""

    parse: Callable[[bytes], object]
    errors: tuple[type[Exception], ...]
    seeds: tuple[bytes, ...]

    def run(self, data: bytes) -> None:
        """Parse; a documented error is an answer."""
        try:
            self.parse(data)
        except self.errors as error:
            # Sentences are made when they are read.
            str(error).encode("utf-8", "backslashreplace")


@functools.cache
def scratch_folder() -> Path:
    place = tempfile.mkdtemp(prefix="fuzz-")
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    return Path(place)


def scratch_file(name: str, data: bytes) -> Path:
    path = scratch_folder() / name
    path.write_bytes(data)
    return path
