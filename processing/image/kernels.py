"""Interpolation kernels as tables of six weights and their slopes, by sub-pixel phase.

The default one is corrected in phase: whatever its sub-pixel offset, a wave of up to 0.35 cycles
per pixel comes out less than 0.005 px from where it belongs. How it was found, and what other
kernels leave, is in docs/reference/results/accuracy.md and
docs/explanation/decisions/0008-phase-corrected-interpolation.md; `python -m
benchmarks.interpolation` repeats both.

Source: docs/explanation/mathematics/resampling.md#phase-error; Keys (1981).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Interpolation = Literal["phase-corrected", "cubic", "lanczos", "bilinear"]
INTERPOLATIONS: Final[tuple[Interpolation, ...]] = get_args(Interpolation)
DEFAULT_INTERPOLATION: Final[Interpolation] = "phase-corrected"

PHASES: Final = 128
"""Steps of the tables to a pixel."""
MARGIN: Final = 8
"""Steps of the tables below phase 0 and above 1."""
TAPS: Final = np.arange(-2, 4)
"""Raw pixels that a sample at phase 0 .. 1 right of pixel 0 may weigh."""

PHASE_CORRECTED: Final = np.array(
    [
        [0.6310684, -1.0720910, -0.3611983, 0.8947284, -0.6523012, -2.4254571],
        [-0.1445220, -0.0597234, 0.6339735, -0.6681008, -0.2235419, 3.6279773],
        [0.0134536, 0.0538168, -0.2727752, 0.2068765, 0.8758432, -1.6885739],
    ]
)
"""Weights of the pixels 0, -1, -2 as polynomials of phase - 1/2, lowest power first. Pixel 1 - k
weighs as pixel k at the mirrored phase."""


@dataclass(frozen=True)
class Kernel:
    """A kernel as the compiled loops take it.

    Attributes:
        table: (PHASES + 1 + 2 * MARGIN, 12) float32, six weights and their slopes per px.
        reach: pixels beyond the four nearest that count, along each axis: 0, 1 or 2.
    """

    table: Array
    reach: int


def phase_corrected_weights(phase: Array) -> Array:
    """Weights of the phase-corrected kernel.

    Args:
        phase: right of pixel 0, (n,), px; accurate from -0.04 to 1.04.

    Returns:
        Weights of the pixels `TAPS`, (n, 6).

    Source: docs/explanation/mathematics/resampling.md#phase-corrected-kernel.
    """
    powers = np.power.outer(phase - 0.5, np.arange(PHASE_CORRECTED.shape[1]))
    mirrored = np.power.outer(0.5 - phase, np.arange(PHASE_CORRECTED.shape[1]))
    before, after = powers @ PHASE_CORRECTED.T, mirrored @ PHASE_CORRECTED.T
    return _normalised(np.concatenate([before[:, ::-1], after], axis=1))


def cubic_weights(phase: Array) -> Array:
    """Weights of Keys' cubic convolution with a = -1/2 (Catmull-Rom).

    Args:
        phase: right of pixel 0, (n,), px.

    Returns:
        Weights of the pixels `TAPS`, (n, 6).

    Source: Keys (1981).
    """
    d = np.abs(phase[:, None] - TAPS)
    inner = (1.5 * d - 2.5) * d * d + 1.0
    outer = ((2.5 - 0.5 * d) * d - 4.0) * d + 2.0
    return np.where(d < 1.0, inner, np.where(d < 2.0, outer, 0.0))


def lanczos_weights(phase: Array) -> Array:
    """Weights of Lanczos' kernel with three lobes, normalised.

    Args:
        phase: right of pixel 0, (n,), px.

    Returns:
        Weights of the pixels `TAPS`, (n, 6).
    """
    d = phase[:, None] - TAPS
    return _normalised(np.where(np.abs(d) < 3.0, np.sinc(d) * np.sinc(d / 3.0), 0.0))


def _bilinear_weights(phase: Array) -> Array:
    """Linear between pixels 0 and 1, and on beyond them; (n, 6) at phases (n,), px."""
    weights = np.zeros((len(phase), len(TAPS)))
    weights[:, 2], weights[:, 3] = 1.0 - phase, phase
    return weights


def _normalised(weights: Array) -> Array:
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def _kernel(weights: Callable[[Array], Array], reach: int) -> Kernel:
    phase = np.arange(-MARGIN, PHASES + MARGIN + 1) / PHASES
    step = 1e-4
    slopes = (weights(phase + step) - weights(phase - step)) / (2.0 * step)
    table = np.concatenate([weights(phase), slopes], axis=1).astype(np.float32)
    return Kernel(np.ascontiguousarray(table), reach)


KERNELS: Final[dict[Interpolation, Kernel]] = {
    "phase-corrected": _kernel(phase_corrected_weights, 2),
    "cubic": _kernel(cubic_weights, 1),
    "lanczos": _kernel(lanczos_weights, 2),
    "bilinear": _kernel(_bilinear_weights, 0),
}
