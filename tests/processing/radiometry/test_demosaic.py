"""Demosaicking moves nothing: not by a hundredth of a pixel, at any phase, in any arrangement."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.matching.patches import INTERPOLATION, match_patches
from processing.radiometry.calibration import neutral_radiometry
from processing.radiometry.corrector import corrector_for
from processing.radiometry.demosaic import demosaic
from processing.radiometry.level1 import level1_from_level0
from processing.rig import find_rig

Array = NDArray[np.float64]

ARRAYS = ("RGGB", "BGGR", "GRBG", "GBRG")
LETTERS = {"R": 0, "G": 1, "B": 2}


def behind_filters(colours: Array, array: str) -> NDArray[np.uint16]:
    """Level-1 words of a Bayer head that sees colours (3, h, w)."""
    mosaic = np.empty(colours.shape[1:], np.uint16)
    for k, letter in enumerate(array):
        at = (slice(k // 2, None, 2), slice(k % 2, None, 2))
        mosaic[at] = 2 * np.rint(colours[LETTERS[letter]][at] / 2).astype(np.uint16)
    return mosaic


def waves(rng: np.random.Generator, *, sigma_px: float, count: int = 400) -> tuple[Array, ...]:
    """A random texture as a sum of waves, blurred by a Gaussian: known at any place, not only at
    whole pixels. Its amplitudes fall with frequency, as those of ground do."""
    radius = rng.uniform(0.01, 0.7, count)
    direction = rng.uniform(0, 2 * np.pi, count)
    amplitude = np.exp(-2 * (np.pi * sigma_px * radius) ** 2) / np.sqrt(radius + 0.03)
    phase = rng.uniform(0, 2 * np.pi, count)
    return radius * np.cos(direction), radius * np.sin(direction), amplitude, phase


def seen(texture: tuple[Array, ...], size: int, dx: float, dy: float) -> Array:
    """The texture moved by (dx, dy), (size, size), between 4000 and 28000 counts."""
    fx, fy, amplitude, phase = texture
    at = np.arange(size, dtype=np.float64)
    along_x = np.exp(2j * np.pi * np.outer(fx, at - dx))
    along_y = np.exp(2j * np.pi * np.outer(fy, at - dy))
    waves_ = (along_y * (amplitude * np.exp(1j * phase))[:, None]).T @ along_x
    return np.asarray(16000 + 2300 * waves_.real / np.sqrt(np.sum(amplitude**2) / 2))


@pytest.mark.parametrize("array", ARRAYS)
def test_grey_stays_what_it_is(array: str) -> None:
    mosaic = np.full((40, 50), 12346, np.uint16)
    out = np.empty((3, 40, 50), np.uint16)
    demosaic(mosaic, array, out=out)
    assert (out[:, 1:-1, 1:-1] == 12346).all()
    assert set(np.unique(out)) <= {0, 12346}


@pytest.mark.parametrize("array", ARRAYS)
def test_colours_are_separated_and_measured_pixels_as_they_are(array: str) -> None:
    flat = np.stack([np.full((40, 50), v, np.float64) for v in (9000, 20000, 4000)])
    mosaic = behind_filters(flat, array)
    out = np.empty((3, 40, 50), np.uint16)
    demosaic(mosaic, array, out=out)
    inner = out[:, 2:-2, 2:-2].astype(int)
    assert np.abs(inner - flat[:, 2:-2, 2:-2]).max() <= 2
    for k, letter in enumerate(array):
        at = (slice(k // 2 + 2, -2, 2), slice(k % 2 + 2, -2, 2))
        assert np.array_equal(out[LETTERS[letter]][at], mosaic[at])


@pytest.mark.parametrize("array", ARRAYS)
@pytest.mark.parametrize("band", ["red", "green", "blue"])
def test_a_long_wave_is_not_shifted_in_any_colour(array: str, band: str) -> None:
    """A wave of 16 px: its phase after demosaicking is its own to 1e-3 px."""
    k = ("red", "green", "blue").index(band)
    size, f = 160, 1 / 16
    at = np.arange(size)
    for fx, fy in ((f, 0.0), (0.0, f), (f, -f)):
        phase = 2 * np.pi * (fx * at[None, :] + fy * at[:, None]) + 0.4
        colours = np.stack([16000 + 6000 * np.cos(phase)] * 3)
        out = np.empty((3, size, size), np.uint16)
        demosaic(behind_filters(colours, array), array, out=out)
        inner = (slice(16, -16), slice(16, -16))
        carrier = np.exp(-1j * phase[inner])
        phase_shift = np.angle(np.sum((out[k][inner] - 16000.0) * carrier))
        assert abs(phase_shift) / (2 * np.pi * np.hypot(fx, fy)) < 1e-3


def match_bias(
    array: str | None, *, sigma_px: float, band: str = "green"
) -> tuple[float, float, float]:
    """Mean error in x and y and RMS (px) of matching a sharp plain frame with a Bayer head's band.

    Both see the same texture; the head is moved by 16 parts of a pixel, a new texture for each.
    """
    rng = np.random.default_rng(7)
    size, half = 300, 7
    errors = []
    grid = np.arange(24, size - 24, 16)
    at = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2).astype(np.int64)
    for step in range(16):
        dx, dy = (step % 4) / 4 + 0.06, (step // 4) / 4 + 0.06
        texture = waves(rng, sigma_px=sigma_px, count=200)
        plain = 2 * np.rint(seen(texture, size, 0.0, 0.0) / 2).astype(np.uint16)
        moved = np.stack([seen(texture, size, dx, dy)] * 3)
        other = np.empty((3, size, size), np.uint16)
        if array is None:
            other[:] = 2 * np.rint(moved / 2).astype(np.uint16)
        else:
            demosaic(behind_filters(moved, array), array, out=other)
        found = match_patches(
            plain,
            np.ascontiguousarray(other[("red", "green", "blue").index(band)]),
            at,
            at,
            np.array([0, size - 1, 0, size - 1], np.int64),
            1,
            half,
            3,
            True,
            INTERPOLATION,
        )
        good = found[found[:, 7] > 0]
        errors.append(good[:, 2:4] - good[:, 0:2] - (dx, dy))
    every = np.concatenate(errors)
    off = np.hypot(*(every - np.median(every, axis=0)).T)
    inliers = every[off < 5 * np.median(off)]
    mean = inliers.mean(axis=0)
    return float(mean[0]), float(mean[1]), float(np.sqrt(np.mean(inliers**2)))


@pytest.mark.parametrize("array", ["RGGB", "GRBG"])
def test_green_matches_without_bias_over_all_phases(array: str) -> None:
    bias_x, bias_y, rms = match_bias(array, sigma_px=0.55)
    assert abs(bias_x) < 0.002 and abs(bias_y) < 0.002
    # What is left is detail too fine for half of the pixels: it differs from place to place.
    assert rms < 0.03


def test_pixels_without_data_stay_without_and_pull_nothing() -> None:
    """A gradient next to a hole comes out as the gradient: mirror images fall away together."""
    ramp = 8000.0 + 100.0 * np.arange(60)[None, :] + np.zeros((60, 1))
    mosaic = behind_filters(np.stack([ramp] * 3), "RGGB")
    mosaic[:, 30] = 0
    mosaic[20] = 0
    out = np.empty((3, 60, 60), np.uint16)
    demosaic(mosaic, "RGGB", out=out)
    assert (out[:, :, 30] == 0).all() and (out[:, 20] == 0).all()
    has = out > 0
    has[:, [0, -1]] = False
    assert has[:, 2:-2, 2:29].mean() > 0.9
    wrong = np.abs(out - np.broadcast_to(ramp, out.shape))[has]
    assert wrong.max() <= 3


def test_saturation_is_handed_on_to_what_it_took_part_in() -> None:
    mosaic = np.full((40, 40), 20000, np.uint16)
    mosaic[20, 21] = 65535
    out = np.empty((3, 40, 40), np.uint16)
    demosaic(mosaic, "RGGB", out=out)
    marked = (out & 1).astype(bool)
    assert marked[1, 20, 21] and marked[1, 20, 20] and marked[0, 20, 21]
    assert not marked[:, :16].any() and not marked[:, 25:].any()


def test_a_defect_of_a_bayer_head_is_filled_from_its_own_colour() -> None:
    sensor = dataclasses.replace(
        find_rig("ultracam-l-mini").sensor("RGB"), width_px=40, height_px=40
    )
    flat = np.stack([np.full((40, 40), v, np.float64) for v in (600, 2000, 300)])
    raw = behind_filters(flat, "RGGB") + np.uint16(sensor.black_dn)
    raw[20, 20], raw[21, 21], raw[20, 25] = 4000, 4000, 90
    defect = np.zeros((40, 40), np.uint8)
    defect[[20, 21, 20], [20, 21, 25]] = 1
    corrector = corrector_for(
        sensor, dataclasses.replace(neutral_radiometry(sensor), defect=defect)
    )
    level1 = np.zeros((40, 40), np.uint16)
    level1_from_level0(
        corrector, raw, temperature_c=20.0, exposure_time_s=0.0, tdi_shifts=0, out=level1
    )
    assert (level1[20, 20], level1[21, 21], level1[20, 25]) == (4800, 2400, 16000)


def test_what_is_no_bayer_pattern_is_refused() -> None:
    frame = np.zeros((4, 4), np.uint16)
    with pytest.raises(ValueError, match="no R, B and two greens"):
        demosaic(frame, "none", out=np.zeros((3, 4, 4), np.uint16))
    with pytest.raises(ValueError, match="out is"):
        demosaic(frame, "RGGB", out=np.zeros((3, 4, 5), np.uint16))
