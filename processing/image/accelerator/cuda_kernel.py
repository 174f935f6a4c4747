"""The decorators of kernels for CUDA devices, and floating-point steps that are never fused.

numba compiles for CUDA with fused multiply-adds wherever a product is added to something. Each step
here is one instruction that rounds once, so a kernel rounds exactly where its source states.

Quirk: `numba.cuda.jit` has no option against contraction; the functions `*_rn` of libdevice are
exempt from it. Upstream: PTX ISA, 9.7.3, mul: "an explicit rounding modifier is treated
conservatively by the code optimizer".
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import config, cuda
from numba.cuda import libdevice


def cuda_compiled_kernel(*, device: bool = False) -> Any:
    """Decorate a kernel for CUDA devices, or a function that such kernels call.

    Args:
        device: whether kernels call it.

    Returns:
        The decorator; with NUMBA_ENABLE_CUDASIM=1 numba's simulator runs the source.
    """
    return cuda.jit(device=device, fastmath=False)


if config.ENABLE_CUDASIM:

    @cuda_compiled_kernel(device=True)
    def fused(a, b, c):
        """A product plus a summand, rounded once, float32."""
        return np.float32(np.float64(a) * np.float64(b) + np.float64(c))

    @cuda_compiled_kernel(device=True)
    def difference(a, b):
        """A difference, rounded once, float32."""
        return np.float32(a) - np.float32(b)

    @cuda_compiled_kernel(device=True)
    def quotient(a, b):
        """A quotient, rounded once, float32."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.float32(a) / np.float32(b)

    @cuda_compiled_kernel(device=True)
    def whole(a):
        """Towards zero, within the range of int32; 0 where it is no number."""
        return int(np.clip(np.trunc(np.nan_to_num(np.float64(a), nan=0.0)), -(2**31), 2**31 - 1))

else:

    @cuda_compiled_kernel(device=True)
    def fused(a, b, c):
        """A product plus a summand, rounded once, float32."""
        return libdevice.fmaf_rn(a, b, c)

    @cuda_compiled_kernel(device=True)
    def difference(a, b):
        """A difference, rounded once, float32."""
        return libdevice.fsub_rn(a, b)

    @cuda_compiled_kernel(device=True)
    def quotient(a, b):
        """A quotient, rounded once, float32."""
        return libdevice.fdiv_rn(a, b)

    @cuda_compiled_kernel(device=True)
    def whole(a):
        """Towards zero, within the range of int32; 0 where it is no number."""
        return libdevice.float2int_rz(a)
