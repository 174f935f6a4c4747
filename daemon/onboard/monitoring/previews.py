"""Previews of an exposure for clients without the page: thumbnail pieces and a few vectors.

They have the lowest priority and are read from the mission folder after processing.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daemon.mission.layout import exposure_name

PIECE_BYTES = 700
"""A piece fits into a datagram and into the burst of the slowest link."""

THUMBNAIL_MAX_BYTES = 40_000
RESIDUALS_MAX_BYTES = 1_000_000
VECTORS_MAX = 40


@dataclass(frozen=True)
class Preview:
    """`pieces` of a JPEG, `vectors` as in residuals.json, their ends in thousandths of a pixel."""

    pieces: tuple[bytes, ...] = ()
    vectors: tuple[tuple[int, ...], ...] = ()
    size_px: tuple[int, int] = (0, 0)


def read_preview(mission: str | None, number: int) -> Preview:
    """Read the preview of an exposure; empty if no usable file exists."""
    if mission is None:
        return Preview()
    folder = Path(mission) / "L2" / exposure_name(number)
    jpeg = _read(folder / "thumbnail.jpg", THUMBNAIL_MAX_BYTES)
    pieces = tuple(jpeg[at : at + PIECE_BYTES] for at in range(0, len(jpeg), PIECE_BYTES))
    try:
        content = json.loads(_read(folder / "residuals.json", RESIDUALS_MAX_BYTES) or b"null")
        return Preview(pieces, *_thinned(content)) if content else Preview(pieces)
    except (ValueError, KeyError, TypeError):
        return Preview(pieces)


def _thinned(content: Mapping[str, Any]) -> tuple[tuple[tuple[int, ...], ...], tuple[int, int]]:
    vectors = content["vectors"]
    step = max(1, -(-len(vectors) // VECTORS_MAX))
    thinned = tuple(
        (int(column), int(row), round(1000 * right), round(1000 * down), int(kind))
        for column, row, right, down, kind in vectors[::step]
    )
    return thinned, (int(content["width_px"]), int(content["height_px"]))


def _read(path: Path, max_bytes: int) -> bytes:
    try:
        return path.read_bytes() if path.stat().st_size <= max_bytes else b""
    except OSError:
        return b""
