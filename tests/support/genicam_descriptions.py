"""Descriptions of real cameras, which are not in the repository, and a small one of our own."""

from __future__ import annotations

import functools
import zipfile
from pathlib import Path
from typing import Final

import pytest

ARCHIVE: Final = Path(__file__).parents[3] / "shared" / "data" / "genicam" / "descriptions.zip"
needs_descriptions = pytest.mark.skipif(
    not ARCHIVE.is_file(), reason="needs the descriptions in ../shared/data/genicam"
)


def names() -> list[str]:
    """The names of the descriptions, without suffix; empty where they are absent."""
    if not ARCHIVE.is_file():
        return []
    with zipfile.ZipFile(ARCHIVE) as archive:
        return sorted(Path(name).stem for name in archive.namelist() if name.endswith(".xml"))


@functools.cache
def description(name: str) -> bytes:
    """The description of this name."""
    with zipfile.ZipFile(ARCHIVE) as archive:
        return archive.read(f"{name}.xml")
