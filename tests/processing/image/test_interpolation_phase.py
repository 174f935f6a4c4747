"""Waves through the resampling come out where they belong: analytic, without the code's weights."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.interpolation import designed
from processing.image.kernels import (
    DEFAULT_INTERPOLATION,
    PHASE_CORRECTED,
    Interpolation,
    phase_corrected_weights,
)
from tests.processing.image.test_resampling import fetch

pytestmark = pytest.mark.trust

LEVEL, SWING = 24_000.0, 16_000.0
DIRECTIONS = {
    "along rows": (1.0, 0.0),
    "along columns": (0.0, 1.0),
    "diagonal": (0.5**0.5, 0.5**0.5),
}
OFFSETS = (0.0, 0.13, 0.25, 0.37, 0.5, 0.63, 0.78, 0.91)
Matrix = tuple[float, float, float, float, float, float]


def shift_and_amplitude(
    wave: tuple[float, float], matrix: Matrix, interpolation: Interpolation, window_px: int
) -> tuple[float, float, float]:
    """Largest shift along the wave in px, least and largest amplitude, over all windows.

    A wave of (cycles per raw pixel along columns, along rows) is drawn, resampled with
    raw = matrix of the target pixel, and fitted with a wave at the true places.
    """
    fx, fy = wave
    y, x = np.mgrid[:140, :180]
    frame = LEVEL + SWING * np.sin(2.0 * np.pi * (fx * x + fy * y))
    frame = (2.0 * np.rint(frame / 2.0)).astype(np.uint16)
    out, source = fetch(
        frame[None], [matrix], interpolation=interpolation, shape=(96, 128), cell=32
    )
    assert np.all(source == 1)
    c0, cx, cy, r0, rx, ry = matrix
    y, x = np.mgrid[:96, :128]
    angle = 2.0 * np.pi * (fx * (c0 + cx * x + cy * y) + fy * (r0 + rx * x + ry * y))
    shifts, amplitudes = [], []
    for top, left in itertools.product(range(0, 96, window_px), range(0, 128, window_px)):
        box = np.s_[top : top + window_px, left : left + window_px]
        shift, amplitude = _fit(out[box].astype(float), angle[box])
        shifts.append(abs(shift) / (2.0 * np.pi * np.hypot(fx, fy)))
        amplitudes.append(amplitude / SWING)
    return max(shifts), min(amplitudes), max(amplitudes)


def _fit(values: NDArray[np.float64], angle: NDArray[np.float64]) -> tuple[float, float]:
    sine, cosine = np.sin(angle).ravel(), np.cos(angle).ravel()
    design = np.stack([sine, cosine, np.ones(sine.size)], axis=1)
    a, b, _ = np.linalg.lstsq(design, values.ravel(), rcond=None)[0]
    return float(np.arctan2(b, a)), float(np.hypot(a, b))


def worst(
    cycles: float, direction: str, interpolation: Interpolation
) -> tuple[float, float, float]:
    """As `shift_and_amplitude`, over pairs of sub-pixel offsets along columns and rows."""
    dx, dy = DIRECTIONS[direction]
    found = [
        shift_and_amplitude(
            (cycles * dx, cycles * dy), (9.0 + a, 1.0, 0.0, 8.0 + b, 0.0, 1.0), interpolation, 96
        )
        for a, b in itertools.product(
            OFFSETS, OFFSETS[1::2] if direction == "diagonal" else (0.25,)
        )
        for a, b in (((b, a),) if direction == "along columns" else ((a, b),))
    ]
    return (
        max(shift for shift, _, _ in found),
        min(least for _, least, _ in found),
        max(most for _, _, most in found),
    )


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_a_wave_of_up_to_0_35_cycles_per_pixel_moves_by_less_than_0_005_px(direction: str) -> None:
    for cycles in (0.06, 0.11, 0.16, 0.21, 0.26, 0.31, 0.35):
        shift, least, most = worst(cycles, direction, DEFAULT_INTERPOLATION)
        assert shift < 0.005, (cycles, shift)
        # Along a diagonal the amplitudes of both axes multiply.
        assert least > 0.86, (cycles, least)
        assert most < (1.22 if direction == "diagonal" else 1.11), (cycles, most)


def test_diagonal_waves_of_0_35_cycles_per_pixel_along_both_axes_hold_as_well() -> None:
    shift, _, _ = worst(0.35 * 2.0**0.5, "diagonal", DEFAULT_INTERPOLATION)
    assert shift < 0.005


@pytest.mark.parametrize(
    ("interpolation", "cycles", "shift"),
    [
        ("cubic", 0.225, 0.036),
        ("cubic", 0.35, 0.104),
        ("lanczos", 0.05, 0.0169),
        ("lanczos", 0.35, 0.036),
    ],
)
def test_what_other_kernels_leave_is_as_documented(
    interpolation: Interpolation, cycles: float, shift: float
) -> None:
    found, _, _ = worst(cycles, "along rows", interpolation)
    assert found == pytest.approx(shift, rel=0.1)


@pytest.mark.parametrize(
    "matrix",
    [
        (9.9, 1.0011, -0.0004, 8.95, 0.0006, 0.9988),
        (9.02, 0.9989, 0.0007, 9.0, -0.0008, 1.0009),
        (9.5, 1.003, -0.002, 8.4, 0.0025, 0.997),
    ],
)
@pytest.mark.parametrize("wave", [(0.35, 0.0), (0.0, 0.35), (0.17, 0.19), (-0.24, 0.25)])
def test_runs_whose_phase_drifts_hold_it_too(matrix: Matrix, wave: tuple[float, float]) -> None:
    # Windows of 8 pixels: phases drift by 0.024 px at most within one.
    shift, _, _ = shift_and_amplitude(wave, matrix, DEFAULT_INTERPOLATION, 16)
    assert shift < 0.005


def test_a_level_surface_and_integer_pixels_come_out_as_they_are() -> None:
    rng = np.random.default_rng(3)
    frame = (2 * rng.integers(1000, 30_000, (1, 130, 170))).astype(np.uint16)
    out, _ = fetch(frame, [(7.0, 1.0, 0.0, 9.0, 0.0, 1.0)], interpolation=DEFAULT_INTERPOLATION)
    assert np.array_equal(out, frame[0, 9:105, 7:135])
    phases = np.linspace(-0.04, 1.04, 109)
    weights = phase_corrected_weights(phases)
    assert np.abs(weights.sum(axis=1) - 1.0).max() < 1e-12
    assert np.abs(weights - phase_corrected_weights(1.0 - phases)[:, ::-1]).max() < 1e-6


def test_the_weights_in_use_are_those_of_the_design() -> None:
    found, _ = designed()
    assert np.abs(found - PHASE_CORRECTED).max() < 1e-6


@pytest.mark.parametrize("hole", [(0, 0), (0, 1)])
def test_no_value_is_drawn_from_a_pixel_without_data(hole: tuple[int, int]) -> None:
    """Wherever a hole lies in the cell, what is left of a level surface is level."""
    for shift in (0.0, 0.01, 0.5, 0.985, 0.999):
        frame = np.full((1, 130, 170), 30_000, np.uint16)
        frame[0, 40 + hole[0], 41 + hole[1]] = 0
        matrix = (7.0 + shift, 1.0005, 0.0004, 9.0 + shift, 0.0004, 0.9995)
        out, source = fetch(frame, [matrix], interpolation=DEFAULT_INTERPOLATION, cell=32)
        # Rows lean by 0.0004: taps of neighbouring columns may lie one row further, at no weight.
        assert np.abs(out[source != 0] - 30_000.0).max() <= 6
        assert 25 <= np.sum(source == 0) <= 49
