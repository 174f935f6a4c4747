"""Patterns that stitching may have left in the image of an exposure, from its `mosaic.json`."""

from __future__ import annotations

import json
from typing import Final

from daemon.mission.foreign_files import ForeignFileError, read_regular_file
from daemon.mission.layout import Mission
from processing.bundle.frame_patterns import FramePatterns
from processing.mosaic.stitching_patterns import PATTERNS_KEY, patterns_from_json

_MAX_BYTES: Final = 50_000_000


def exposure_patterns(mission: Mission, number: int) -> FramePatterns | None:
    """Patterns of the stitched image; None where its record has none or cannot be read."""
    try:
        path = mission.level2(number) / "mosaic.json"
        content = json.loads(read_regular_file(path, _MAX_BYTES))
        patterns = patterns_from_json(content[PATTERNS_KEY])
    except (OSError, ForeignFileError, KeyError, TypeError, ValueError, RecursionError):
        return None
    return patterns if patterns.count else None
