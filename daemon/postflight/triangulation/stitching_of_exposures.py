"""Patterns of stitching of the images of a block, from `mosaic.json` of each exposure."""

from __future__ import annotations

import json

from daemon.mission.foreign_files import ForeignFileError, read_regular_file
from daemon.mission.layout import Mission
from daemon.orientation.exterior_orientation import ExteriorOrientation
from processing.bundle.frame_patterns import FramePatterns
from processing.mosaic.stitching_patterns import PATTERNS_KEY, patterns_from_json

_MAX_BYTES = 50_000_000


def stitching_patterns_of(
    mission: Mission, oriented: tuple[ExteriorOrientation, ...]
) -> tuple[FramePatterns | None, ...]:
    """Patterns by image.

    Returns:
        None for images of heads and for exposures whose record has no patterns; empty if no image
        has any.
    """
    found = tuple(_of_exposure(mission, one) for one in oriented)
    return found if any(own is not None for own in found) else ()


def _of_exposure(mission: Mission, eo: ExteriorOrientation) -> FramePatterns | None:
    if not eo.is_virtual:
        return None
    try:
        path = mission.level2(eo.exposure) / "mosaic.json"
        content = json.loads(read_regular_file(path, _MAX_BYTES))
        patterns = patterns_from_json(content[PATTERNS_KEY])
    except (OSError, ForeignFileError, KeyError, TypeError, ValueError, RecursionError):
        return None
    return patterns if patterns.count else None
