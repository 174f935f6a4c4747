"""The devices that pixels can be computed on, and why one of them cannot be used.

Imports neither numba nor a driver until a device is asked for.
"""

from __future__ import annotations

from typing import Final, Literal, get_args

from processing import ProcessingError

Device = Literal["cpu", "cuda", "cuda-reference"]
"""`cuda-reference` computes the bits of `cuda` on the processor, without an accelerator."""
DEVICES: Final[tuple[Device, ...]] = get_args(Device)
DEFAULT_DEVICE: Final[Device] = "cpu"


class AcceleratorError(ProcessingError, ValueError):
    """A device that cannot be used; the message names the cure."""


def why_unusable(device: Device) -> str | None:
    """Try whether pixels can be computed on a device.

    Args:
        device: as configured.

    Returns:
        None where it can be used, else a sentence with what is missing and the cure.

    Example:
        >>> why_unusable("cpu") is None
        True
    """
    if device != "cuda":
        return None
    reason = _cuda_fault()
    if reason is None:
        return None
    return (
        f'[processing] device is "cuda", but {reason}. Install the NVIDIA driver and the CUDA '
        'toolkit, or set device = "cpu"; "cuda-reference" computes the pixels of "cuda" on the '
        "processor, slowly"
    )


def require_device(device: Device) -> None:
    """Make sure that pixels can be computed on a device.

    Args:
        device: as configured.

    Raises:
        AcceleratorError: it cannot be used; the message states why.

    Example:
        >>> require_device("cuda-reference")
    """
    sentence = why_unusable(device)
    if sentence is not None:
        raise AcceleratorError(sentence)


def with_same_pixels(device: Device) -> Device:
    """The device that computes the pixels of another one on this machine.

    Args:
        device: on which an exposure was processed.

    Returns:
        "cuda-reference" for "cuda" where that cannot be used, else the device itself.

    Example:
        >>> with_same_pixels("cpu")
        'cpu'
    """
    return device if why_unusable(device) is None else "cuda-reference"


def _cuda_fault() -> str | None:
    """What keeps numba from computing on a CUDA device; None where nothing does."""
    from numba import config, cuda

    if config.ENABLE_CUDASIM:
        return None
    if not cuda.is_available():
        return f"no such device can be used ({_first_line(cuda.cuda_error())})"
    from numba.cuda.cudadrv.error import NvvmSupportError
    from numba.cuda.cudadrv.nvvm import NVVM

    try:
        NVVM()
    except (NvvmSupportError, OSError) as error:
        return f"its compiler NVVM cannot be loaded ({_first_line(error)})"
    return None


def _first_line(reason: object) -> str:
    """The first line of a reason that is not empty, without its full stop."""
    lines = [line.strip().rstrip(".:") for line in str(reason).splitlines()]
    return next((line for line in lines if line), "no reason given")
