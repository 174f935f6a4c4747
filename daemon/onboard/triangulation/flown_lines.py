"""Flight lines by heading and place, where no plan names them.

Without a plan every exposure is recorded under the same name. Lines decide when the block is
adjusted, which images tie across, and whether the block is a single strip.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.pipelines.live_triangulation import MeasuredImage

Array = NDArray[Any]

TURN_DEG: Final = 45.0
"""Change of heading, from the first image of a line, that begins another."""
ASIDE_SHARE: Final = 0.3
"""Of the width of an image on the ground: an image farther aside begins another line."""


class FlownLines:
    """Names the line of each image.

    Args:
        planned: names of a plan; lines recorded under these are not divided.
    """

    def __init__(self, planned: tuple[str, ...] = ()) -> None:
        self._planned = frozenset(planned)
        self._images: list[MeasuredImage] = []
        self._recorded: str | None = None
        self._counts: dict[str, int] = {}

    def name(self, image: MeasuredImage, width_m: float) -> str:
        """The line of the next image.

        Args:
            image: with the line as it was recorded.
            width_m: of an image on the ground, across the line.

        Returns:
            The recorded name of a planned line; else that of the part of the flight.
        """
        recorded = image.line
        if recorded in self._planned:
            return recorded
        if recorded != self._recorded or self._is_left(image, width_m):
            self._images, self._recorded = [], recorded
            self._counts[recorded] = self._counts.get(recorded, 0) + 1
        self._images.append(image)
        count = self._counts[recorded]
        if not recorded:
            return f"line {count}"
        return recorded if count == 1 else f"{recorded}, part {count}"

    def _is_left(self, image: MeasuredImage, width_m: float) -> bool:
        """Whether an image belongs to another line than those since the last turn."""
        first, last = self._images[0], self._images[-1]
        cosine = float(_heading(first) @ _heading(image))
        if cosine < math.cos(math.radians(TURN_DEG)):
            return True
        along = (last.position_m - first.position_m)[:2]
        if len(self._images) < 2:
            along = first.velocity_mps[:2]
        length = float(np.hypot(*along))
        if not length > 0.0:
            return False
        step = (image.position_m - first.position_m)[:2]
        aside_m = abs(float(along[0] * step[1] - along[1] * step[0])) / length
        return aside_m > ASIDE_SHARE * width_m


def _heading(image: MeasuredImage) -> Array:
    """Horizontal direction of the camera's y axis, of length one."""
    forward = image.rotation[:2, 1]
    return np.asarray(forward / max(float(np.hypot(*forward)), 1e-9))
