"""Control measured in photographs as viewers display them, turned by Orientation of EXIF.

Pixels of a block are those of the file as it is stored. Viewers turn portrait photographs, and
columns and rows read there are of another image.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.postflight.triangulation.control_mistakes import contradiction_m
from daemon.postflight.triangulation.ground_control import GroundControl
from daemon.postflight.triangulation.photograph_block import PhotographBlock

Array = NDArray[np.float64]

_SHARE: Final = 0.3
"""Pixels are of displayed photographs if that reduces the contradictions to less than this."""


def stored_px(orientation: int, shown_px: Array, size_px: tuple[int, int]) -> Array:
    """Pixels of the stored image from those of the displayed one.

    Args:
        orientation: of EXIF, 1 to 8.
        shown_px: columns and rows (n, 2) of the displayed image, zero in the middle of its upper
            left pixel.
        size_px: columns and rows of the stored image.

    Returns:
        Columns and rows (n, 2) of the stored image.

    Source: CIPA DC-008 (EXIF 2.32), 4.6.4, Orientation.

    Example:
        >>> stored_px(6, np.array([[299.0, 0.0]]), (400, 300)).tolist()
        [[0.0, 0.0]]
    """
    last = np.array(size_px) - 1.0
    stored = shown_px[:, ::-1] if orientation in (5, 6, 7, 8) else shown_px
    from_right = orientation in (2, 3, 7, 8)
    from_below = orientation in (3, 4, 6, 7)
    return np.column_stack([
        last[0] - stored[:, 0] if from_right else stored[:, 0],
        last[1] - stored[:, 1] if from_below else stored[:, 1],
    ])  # fmt: skip


def as_stored(
    found: PhotographBlock, control: GroundControl
) -> tuple[GroundControl, tuple[str, ...]]:
    """Control with pixels of the stored photographs, whichever it was measured in.

    Args:
        found: oriented photographs.
        control: its points, measured in these photographs.

    Returns:
        The control itself unless it agrees with the photographs only as they are displayed; then
        the converted control and a sentence.
    """
    turned = found.orientation[control.image] if len(found.orientation) else np.zeros(0, np.int64)
    if not np.any(turned > 1):
        return control, ()
    px = control.px.copy()
    for row in np.flatnonzero(turned > 1):
        size = found.sizes[found.camera_of[control.image[row]]]
        px[row] = stored_px(int(turned[row]), px[[row]], (size.width_px, size.height_px))[0]
    shown = replace(control, px=px)
    if not contradiction_m(found, shown) < _SHARE * contradiction_m(found, control):
        return control, ()
    number = len(np.unique(control.image[turned > 1]))
    return shown, (
        f"control is measured in photographs as viewers display them: columns and rows of "
        f"{number} photographs with an Orientation in EXIF are converted to those of the file",
    )
