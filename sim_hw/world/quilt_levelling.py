"""Gains that bring neighbouring patches of a quilt to one brightness and colour.

Every patch has a gain at each of its corners, bilinear between them, so that nothing is blurred.
Differences too large for light alone are borders of the ground and stay.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

BORDER_LOG = 0.35
"""A difference of signal by this factor (1.42) is taken for another kind of ground."""
HOLD = 0.03
"""Weight of a gain of one, in weights of an overlap."""
STIFFNESS = 0.3
"""Weight of equal gains at two corners of a patch."""
ROUNDS = 150
GAIN_MAX = 1.35


def corner_gains(left: Array, right: Array, top: Array, bottom: Array) -> Array:
    """Gains at the corners of patches in a grid.

    Args:
        left, right, top, bottom: logarithm of the mean signal in the two halves of the overlap on
            that side of each patch, (rows, columns, 2, bands); the first half is the upper or the
            left one.

    Returns:
        (rows, columns, 2, 2, bands) float32, upper row of corners first.
    """
    rows, columns, _, bands = left.shape
    log = np.zeros((rows, columns, 2, 2, bands), np.float32)
    across = left[:, 1:] - right[:, :-1]
    down = top[1:] - bottom[:-1]
    for _ in range(ROUNDS):
        total = np.zeros_like(log)
        weight = np.full(log.shape, HOLD, np.float32)
        # Towards the mean of the other corners of the patch.
        total += STIFFNESS * (log.sum(axis=(2, 3), keepdims=True) - log)
        weight += 3 * STIFFNESS
        _pull(total[:, 1:, :, 0], weight[:, 1:, :, 0], log[:, :-1, :, 1] - across, across)
        _pull(total[:, :-1, :, 1], weight[:, :-1, :, 1], log[:, 1:, :, 0] + across, across)
        _pull(total[1:, :, 0], weight[1:, :, 0], log[:-1, :, 1] - down, down)
        _pull(total[:-1, :, 1], weight[:-1, :, 1], log[1:, :, 0] + down, down)
        log = 0.3 * log + 0.7 * total / weight
    limit = np.log(GAIN_MAX)
    return np.asarray(np.exp(np.clip(log, -limit, limit)), dtype=np.float32)


def _pull(total: Array, weight: Array, target: Array, difference: Array) -> None:
    """Add equations of overlaps; a border of the ground does not count."""
    worst = np.abs(difference).max(axis=-1, keepdims=True)
    trust = np.exp(-((worst / BORDER_LOG) ** 2)).astype(np.float32)
    total += trust * target
    weight += trust


def scaled(patch: NDArray[np.uint16], corners: Array) -> NDArray[np.uint16]:
    """A patch times its gains.

    Args:
        patch: (size, size, bands).
        corners: (2, 2, bands); bilinear between them.

    Returns:
        (size, size, bands), saturated.
    """
    rows, columns, bands = patch.shape
    share = np.linspace(0.0, 1.0, columns, dtype=np.float32)[:, None]
    upper, lower = (c[0] + share * (c[1] - c[0]) for c in corners)
    out = np.empty((rows, columns * bands), np.uint16)
    _scale(patch.reshape(rows, -1), upper.ravel(), lower.ravel(), out)
    return out.reshape(patch.shape)


@numba.njit(cache=True, nogil=True, fastmath=True)
def _scale(patch: NDArray[np.uint16], upper: Array, lower: Array, out: NDArray[np.uint16]) -> None:
    rows, n = patch.shape
    for i in range(rows):
        v = np.float32(i) / np.float32(rows - 1)
        for k in range(n):
            gain = upper[k] + v * (lower[k] - upper[k])
            value = np.float32(patch[i, k]) * gain + np.float32(0.5)
            out[i, k] = np.uint16(np.int32(min(value, np.float32(65535.0))))
