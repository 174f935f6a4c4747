"""Resampling in integers on a CUDA device: the function of one pixel is that of the processor."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import cuda
from numpy.typing import NDArray

from processing.image.accelerator.cuda_kernel import cuda_compiled_kernel
from processing.image.accelerator.fixed_resampling import (
    FixedResampling,
    IntegerResampling,
    fixed_pixel,
)

Array = NDArray[Any]

_BLOCK: Final = (32, 8)
"""Threads of a block: columns and rows of target pixels."""

_pixel: Final = cuda_compiled_kernel(device=True)(fixed_pixel.py_func)


def _on_device(
    frames: Array, weights: Array, given: FixedResampling, out: Array, source: Array
) -> None:
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


resample_cuda: Final = IntegerResampling(_on_device)
"""On the device, with the bits of `resample_fixed`."""


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
