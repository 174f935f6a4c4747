"""The kernels that make pixels, for each device behind one interface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import NDArray

from processing.image.accelerator.devices import Device, require_device
from processing.image.kernels import Interpolation
from processing.image.resampling import resample
from processing.radiometry.level1 import CPU_PASSES, RadiometricPasses

Array = NDArray[Any]


class Resample(Protocol):
    """A function like `processing.image.resampling.resample`."""

    def __call__(
        self,
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
    ) -> None: ...


@dataclass(frozen=True)
class PixelKernels:
    """Correction and resampling on one device.

    The passes of all devices have the same bits. `resample` of "cuda" and of "cuda-reference" have
    the same bits, that of "cpu" computes in floating point.
    """

    passes: RadiometricPasses
    resample: Resample


def pixel_kernels(device: Device) -> PixelKernels:
    """The kernels of a device.

    Args:
        device: as configured.

    Returns:
        Correction and resampling on it.

    Raises:
        AcceleratorError: the device cannot be used; the message states why.

    Example:
        >>> pixel_kernels("cpu").resample is resample
        True
    """
    require_device(device)
    if device == "cpu":
        return PixelKernels(CPU_PASSES, resample)
    if device == "cuda-reference":
        from processing.image.accelerator.fixed_resampling import resample_fixed

        return PixelKernels(CPU_PASSES, resample_fixed)
    from processing.image.accelerator.cuda_radiometry import flat_pass, map_pass
    from processing.image.accelerator.cuda_resampling import resample_cuda

    return PixelKernels(RadiometricPasses(flat_pass, map_pass), resample_cuda)
