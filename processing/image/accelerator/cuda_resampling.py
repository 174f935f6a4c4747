"""Resampling in integers on a CUDA device: the function of one pixel is that of the processor."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import cuda
from numpy.typing import NDArray

from processing.image.accelerator.cuda_kernel import cuda_compiled_kernel
from processing.image.accelerator.fixed_resampling import fixed_pixel, in_integers
from processing.image.kernels import Interpolation

Array = NDArray[Any]

_BLOCK: Final = (32, 8)
"""Threads of a block: columns and rows of target pixels."""

_pixel: Final = cuda_compiled_kernel(device=True)(fixed_pixel.py_func)


def resample_cuda(
    frames: Array,
    valid: Array,
    lattices: Array,
    cell_px: int,
    weights: Array,
    gains: Array,
    *,
    offsets: Array | None = None,
    interpolation: Interpolation,
    out: Array,
    source: Array,
    unclean: Array | None = None,
) -> None:
    """Fetch every target pixel in integers, on the device; bits as of `resample_fixed`.

    Args:
        frames: as in `processing.image.resampling.resample`, like all that follow.
        valid: usable area of each frame.
        lattices: raw positions at the nodes.
        cell_px: lattice spacing: 8, 16, 32 or 64.
        weights: seam weights.
        gains: factors of the signal.
        offsets: added after the gain; None adds nothing.
        interpolation: name of the kernel.
        out: (height, width) uint16, overwritten; 0 is no data.
        source: (height, width) uint8, overwritten.
        unclean: not needed, every pixel is looked at.

    Raises:
        ValueError: as `processing.image.accelerator.fixed_resampling.in_integers`.

    Source: docs/explanation/mathematics/resampling.md#evaluation and #saturation-and-holes.
    """
    del unclean
    given = in_integers(
        frames,
        valid,
        lattices,
        cell_px,
        weights,
        gains,
        offsets=offsets,
        interpolation=interpolation,
        shape=out.shape,
    )
    words, marks = cuda.device_array(out.shape, np.uint16), cuda.device_array(out.shape, np.uint8)
    columns, rows = -(-out.shape[1] // _BLOCK[0]), -(-out.shape[0] // _BLOCK[1])
    _resample[(columns, rows), _BLOCK](
        cuda.to_device(frames),
        cuda.to_device(given.valid),
        cuda.to_device(given.positions),
        cuda.to_device(given.serving),
        cuda.to_device(weights),
        cuda.to_device(given.gains),
        cuda.to_device(given.offsets),
        cuda.to_device(given.table),
        given.reach,
        given.cell_bits,
        words,
        marks,
    )
    out[:] = words.copy_to_host()
    source[:] = marks.copy_to_host()


@cuda_compiled_kernel()
def _resample(
    frames,
    valid,
    positions,
    serving,
    weights,
    gains,
    offsets,
    table,
    reach,
    cell_bits,
    out,
    source,
):
    """One target pixel to a thread."""
    x = np.int64(cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x)
    y = np.int64(cuda.blockIdx.y * cuda.blockDim.y + cuda.threadIdx.y)
    if y < out.shape[0] and x < out.shape[1]:
        word, mark = _pixel(
            frames,
            valid,
            positions,
            serving,
            weights,
            gains,
            offsets,
            table,
            reach,
            cell_bits,
            y,
            x,
        )
        out[y, x] = np.uint16(word)
        source[y, x] = np.uint8(mark)
