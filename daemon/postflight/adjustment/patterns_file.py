"""`patterns.json` of an adjustment project: patterns of stitching of its images."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from daemon.mission.foreign_files import ForeignFileError, read_regular_file, within
from processing.bundle.frame_patterns import FramePatterns
from processing.bundle.network import Network
from processing.mosaic.stitching_patterns import patterns_from_json, patterns_json

PATTERNS_FILE: Final = "patterns.json"
PATTERNS_MAX_BYTES: Final = 500_000_000


def patterns_of_project(
    folder: Path, name: str | None, images: Sequence[str], problems: list[str]
) -> tuple[FramePatterns | None, ...]:
    """Patterns of the images of a project, in their order; empty without a file.

    Args:
        problems: receives a sentence for each mistake.
    """
    if name is None:
        return ()
    try:
        path = within(folder, name, "project.toml: files")
        content = json.loads(read_regular_file(path, PATTERNS_MAX_BYTES))
        by_image = content["images"]
        if not isinstance(by_image, Mapping):
            raise TypeError("images is no table by name")
        foreign = sorted(set(by_image) - set(images))
        if foreign:
            problems.append(f"{name}: image {foreign[0]!r} is not there")
        return tuple(
            patterns_from_json(by_image[image]) if image in by_image else None for image in images
        )
    except ForeignFileError as error:
        problems.append(str(error))
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        problems.append(f"{name}: {error}; `syntopic triangulate` writes such a file")
    return ()


def write_patterns(path: Path, network: Network) -> None:
    """The patterns of a network's images, by name."""
    content: dict[str, Any] = {
        name: patterns_json(own)
        for name, own in zip(network.images.names, network.patterns, strict=True)
        if own is not None
    }
    path.write_text(json.dumps({"images": content}) + "\n", encoding="utf-8")
