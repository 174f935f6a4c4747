"""Patterns of stitching of the images of a block, from `mosaic.json` of each exposure."""

from __future__ import annotations

from daemon.mission.layout import Mission
from daemon.onboard.triangulation.exposure_patterns import exposure_patterns
from daemon.orientation.exterior_orientation import ExteriorOrientation
from processing.bundle.frame_patterns import FramePatterns


def stitching_patterns_of(
    mission: Mission, oriented: tuple[ExteriorOrientation, ...]
) -> tuple[FramePatterns | None, ...]:
    """Patterns by image.

    Returns:
        None for images of heads and for exposures whose record has no patterns; empty if no image
        has any.
    """
    found = tuple(
        exposure_patterns(mission, one.exposure) if one.is_virtual else None for one in oriented
    )
    return found if any(own is not None for own in found) else ()
