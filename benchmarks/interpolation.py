"""Phase error, amplitude, noise and overshoot of the interpolation kernels, by frequency.

    python -m benchmarks.interpolation
    python -m benchmarks.interpolation --design

Everything follows from the weights; that the compiled resampling has them is tested in
`tests/processing/image/test_interpolation_phase.py`. `--design` finds the weights of the
phase-corrected kernel again. Record in docs/reference/results/accuracy.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from processing.image.kernels import (
    PHASE_CORRECTED,
    TAPS,
    cubic_weights,
    lanczos_weights,
    phase_corrected_weights,
)

Array = NDArray[Any]

KERNELS: Final[dict[str, Callable[[Array], Array]]] = {
    "cubic": cubic_weights,
    "lanczos": lanczos_weights,
    "phase-corrected": phase_corrected_weights,
}
FREQUENCIES: Final = (0.05, 0.10, 0.15, 0.20, 0.25, 0.30, 0.35, 0.40)

DESIGN_PHASE_PX: Final = 0.0033
"""Largest phase error along one axis: along a diagonal two of them make 0.0047 px."""
DESIGN_CYCLES: Final = 0.352
DESIGN_BEYOND_PX: Final = 0.04
"""Phases below 0 and above 1 that the weights hold for as well."""


def response(weights: Array, phases: Array, cycles: float) -> Array:
    """Response (n,) of weights (n, 6) at phases (n,), over that of the true shift."""
    return np.asarray(
        (weights * np.exp(2j * np.pi * cycles * (TAPS - phases[:, None]))).sum(axis=1)
    )


def table() -> str:
    """Markdown: the largest phase error and the range of the amplitude over all phases."""
    phases = np.linspace(0.0, 1.0, 1001)
    lines = ["| cycles per pixel | " + " | ".join(KERNELS) + " |", "|---" * 4 + "|"]
    for cycles in FREQUENCIES:
        cells = []
        for weights in KERNELS.values():
            seen = response(weights(phases), phases, cycles)
            error = np.abs(np.angle(seen)).max() / (2.0 * np.pi * cycles)
            amplitude = np.abs(seen)
            cells.append(f"{error:.4f}; {amplitude.min():.2f} to {amplitude.max():.2f}")
        lines.append(f"| {cycles:.2f} | " + " | ".join(cells) + " |")
    noise, steps = [], []
    for weights in KERNELS.values():
        power = (weights(phases) ** 2).sum(axis=1)
        noise.append(f"{power.min():.2f} to {power.max():.2f}")
        steps.append(f"{np.cumsum(weights(phases), axis=1).max() - 1.0:.3f}")
    lines.append("| noise power passed, one axis | " + " | ".join(noise) + " |")
    lines.append("| overshoot at a step of one pixel | " + " | ".join(steps) + " |")
    return "\n".join(lines)


def designed(degree: int = 5) -> tuple[Array, float]:
    """Polynomials of the weights, (3, degree + 1), and the deviation of their amplitude from 1.

    A linear programme: phase errors up to `DESIGN_CYCLES` are bounded, the weights' sum is one at
    every phase, whole pixels come out as they are, and the largest deviation of the amplitude is as
    small as can be; at low frequencies it counts twice.
    """
    cycles = np.linspace(0.01, DESIGN_CYCLES, 60)
    count = 3 * (degree + 1)
    rows, limits = [], []
    for phase in np.linspace(-DESIGN_BEYOND_PX, 0.5, 55):
        at = 2.0 * np.pi * cycles[:, None] * (TAPS - phase)
        basis = _basis(phase, degree)
        real, imaginary = np.cos(at) @ basis, np.sin(at) @ basis
        bound = (DESIGN_PHASE_PX * 2.0 * np.pi * cycles)[:, None] * real
        none, some = np.zeros((len(cycles), 1)), (0.5 + 0.5 * cycles / DESIGN_CYCLES)[:, None]
        rows += [np.hstack([imaginary - bound, none]), np.hstack([-imaginary - bound, none])]
        rows += [np.hstack([real, -some]), np.hstack([-real, -some])]
        zeros, ones = np.zeros(len(cycles)), np.ones(len(cycles))
        limits += [zeros, zeros, ones, -ones]
    equal = np.zeros((0, count + 1))
    for power in range(0, degree + 1, 2):
        sums = np.zeros(count + 1)
        sums[power :: degree + 1][:3] = 1.0
        equal = np.vstack([equal, sums])
    equal = np.vstack([equal, np.hstack([_basis(0.0, degree)[:5], np.zeros((5, 1))])])
    wanted = np.array([0.5] + [0.0] * (len(equal) - 6) + [0.0, 0.0, 1.0, 0.0, 0.0])
    found = linprog(
        np.append(np.zeros(count), 1.0),
        A_ub=np.vstack(rows),
        b_ub=np.concatenate(limits),
        A_eq=equal,
        b_eq=wanted,
        bounds=[(None, None)] * count + [(0.0, None)],
    )
    if not found.success:
        raise RuntimeError(f"the linear programme ended without weights: {found.message}")
    solution = np.asarray(found.x)
    return solution[:-1].reshape(3, degree + 1), float(solution[-1])


def _basis(phase: float, degree: int) -> Array:
    """Weights of `TAPS` at a phase as a linear function of all coefficients, (6, n)."""
    basis = np.zeros((len(TAPS), 3 * (degree + 1)))
    powers = np.arange(degree + 1)
    for k in range(3):
        of = slice(k * (degree + 1), (k + 1) * (degree + 1))
        basis[2 - k, of] = (phase - 0.5) ** powers
        basis[3 + k, of] = (0.5 - phase) ** powers
    return basis


def main() -> None:
    parser = argparse.ArgumentParser(description="Phase error of interpolation kernels.")
    parser.add_argument("--design", action="store_true", help="Find the weights again.")
    if parser.parse_args().design:
        found, deviation = designed()
        print(np.array2string(found, precision=7, separator=", ", suppress_small=True))
        print(f"amplitude within {deviation:.3f}, below half of that at low frequencies")
        print(f"largest difference from those in use: {np.abs(found - PHASE_CORRECTED).max():.1e}")
        return
    print(table())


if __name__ == "__main__":
    main()
