"""How bright a raw frame is: a coarse histogram from a sample of its pixels."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

BINS: Final = 64
EVERY: Final = 8
"""Every eighth pixel of every eighth row: 65,000 of a frame of 4 million."""


def sampled_histogram(frame: NDArray[Any], bits: int) -> tuple[int, ...]:
    """Counts of DN in BINS equal bins of the converter's range.

    Args:
        frame: (h, w) uint16.
        bits: how many of the 16 bits count, from below: all where DN are left-justified.

    Returns:
        BINS counts; the last holds what is saturated or within a 64th of it.

    Example:
        2048 of 12 bits is half of the range: bin 32 of 64.

        >>> counts = sampled_histogram(np.full((16, 16), 2048, np.uint16), 12)
        >>> counts.index(4), sum(counts)
        (32, 4)
    """
    sample = frame[EVERY // 2 :: EVERY, EVERY // 2 :: EVERY]
    bins = np.minimum(sample.astype(np.int64) * BINS >> bits, BINS - 1)
    return tuple(int(count) for count in np.bincount(bins.ravel(), minlength=BINS))
