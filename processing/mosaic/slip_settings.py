"""When a band of residuals of `processing.mosaic.readout_slips` is a slip."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class SlipSettings:
    """When a band of residuals is a slip.

    A band holds at least two bins of `bin_points` tie points; the mean of their medians differs
    from the median of the rest of the frame by more than `limit` standard deviations of
    independent points, and by more than `min_shift_px`. The second decides on ground where errors
    of neighbouring points are correlated: relief, trees, clouds, vehicles
    (docs/explanation/validity.md). All of a band moves: `min_share` of its points have its shift,
    of vehicles on a road fewer. A head drops whole lines: a band moves by `min_own_px` of its
    frame's own pixels at least, of which the adjustment leaves `remaining_share`. `unit_px` is the
    pixel that points are matched in, PAN pixels.
    """

    bin_points: int = 7
    limit: float = 15.0
    own_limit: float = 10.0
    min_share: float = 0.6
    min_own_px: float = 0.5
    max_rounds: int = 4
    unit_px: float = 1.0

    def min_shift_px(self, points: int) -> float:
        """The smallest shift of a band that residuals show.

        Args:
            points: tie points in the band.

        Returns:
            PAN pixels.

        Source: docs/explanation/mathematics/validity.md#read-out-slips.
        """
        return (0.15 + 1.7 / math.sqrt(points)) * self.unit_px

    def min_whole_px(self, share: float, own_px: float) -> float:
        """The smallest shift of a band that a head can cause: it shifts by whole pixels.

        Args:
            share: part of the frame in the band.
            own_px: size of the frame's own pixel, PAN pixels.

        Returns:
            PAN pixels.

        Source: docs/explanation/mathematics/validity.md#read-out-slips.
        """
        return self.min_own_px * own_px * remaining_share(share)


def remaining_share(share: float) -> float:
    """What a frame's own shift, rotation and scale leave of a band's shift against the rest.

    A straight line fitted to a step of one at the end of a frame takes this much of it; a band in
    the middle keeps more.

    Args:
        share: part of the frame in the band, 0 to 1.

    Returns:
        Shift that is left over the shift; 0.25 for half a frame.

    Example:
        >>> remaining_share(0.5), remaining_share(0.1)
        (0.25, 0.73)
    """
    return 1.0 - 3.0 * share * (1.0 - share)
