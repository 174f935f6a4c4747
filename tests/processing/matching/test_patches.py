"""Least-squares matching: no sub-pixel bias, and a sigma one can believe."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.matching.patches import INTERPOLATION, match_patches, select_features
from tests.processing.textures import Texture, box_means

PHASES = np.linspace(0.0, 1.0, 9)
Array = NDArray[np.float64]


def grid(first: int, last: int, step: int) -> NDArray[np.int64]:
    at = np.arange(first, last, step)
    return np.array([(c, r) for r in at for c in at], dtype=np.int64)


def match(
    a: Array,
    b: Array,
    at_a: NDArray[np.int64],
    at_b: NDArray[np.int64],
    *,
    ratio: int = 1,
    half: int = 9,
    search: int = 6,
) -> Array:
    limits = np.array([0, b.shape[1] - 1, 0, b.shape[0] - 1], dtype=np.int64)
    found = match_patches(
        a.astype(np.float32),
        b.astype(np.float32),
        at_a,
        at_b,
        limits,
        ratio,
        half,
        search,
        False,
        INTERPOLATION,
    )
    return np.asarray(found)


def pan_errors(
    texture: Texture, noise: float, rng: np.random.Generator
) -> list[tuple[Array, Array]]:
    """Errors (n, 2) and predicted sigmas (n,) at each sub-pixel phase."""
    result = []
    size = texture.fx.size
    at = grid(24, size - 24, 22)
    for phase in PHASES:
        dx, dy = 2.0 + phase, 0.5 * phase - 1.0
        a = texture.moved(0.0, 0.0) + rng.normal(0.0, noise, (size, size))
        b = 0.8 * texture.moved(dx, dy) + 500.0 + rng.normal(0.0, noise, (size, size))
        found = match(a, b, at, at)
        ok = (found[:, 7] > 0) & (found[:, 5] > 0.6) & (found[:, 6] > 0.05)
        error = found[ok, 2:4] - found[ok, 0:2] - (dx, dy)
        assert ok.mean() > 0.9
        assert np.abs(error).max() < 1.0
        result.append((error, found[ok, 4]))
    return result


@pytest.mark.parametrize(("noise", "bar"), [(0.0, 0.001), (20.0, 0.003), (60.0, 0.01)])
def test_the_mean_error_stays_below_a_hundredth_of_a_pixel_at_every_phase(
    noise: float, bar: float
) -> None:
    rng = np.random.default_rng(11)
    texture = Texture(800, rng)
    means = np.array([error.mean(axis=0) for error, _ in pan_errors(texture, noise, rng)])
    assert np.abs(means).max() < bar


@pytest.mark.parametrize("noise", [10.0, 20.0, 60.0])
def test_the_predicted_sigma_is_the_true_one_within_a_tenth(noise: float) -> None:
    rng = np.random.default_rng(12)
    runs = pan_errors(Texture(800, rng), noise, rng)
    errors = np.concatenate([error for error, _ in runs])
    sigmas = np.concatenate([sigma for _, sigma in runs])
    normalised = errors / sigmas[:, None]
    assert np.sqrt(np.mean(normalised**2)) == pytest.approx(1.0, abs=0.1)
    assert np.mean(np.abs(normalised) < 3.0) > 0.99


@pytest.mark.parametrize("cutoff", [0.12, 0.3])
@pytest.mark.parametrize("noise", [20.0, 60.0])
def test_pan_to_green_is_unbiased_at_every_phase_too(cutoff: float, noise: float) -> None:
    """Also where the texture is finer than green can resolve (cutoff 0.3 is 0.9 per green px)."""
    rng = np.random.default_rng(13)
    size = 900
    texture = Texture(size, rng, cutoff=cutoff)
    at_green = grid(24, size // 3 - 24, 16)
    # One pixel off on purpose: the centre box need not lie on green's raster.
    at_pan = 3 * at_green + np.array([1, -1])
    means, normalised = [], []
    for phase in PHASES:
        dx, dy = 3.0 * phase + 1.0, 1.5 * phase - 1.0
        pan = texture.moved(0.0, 0.0) + rng.normal(0.0, noise, (size, size))
        green = 0.7 * box_means(texture.moved(dx, dy), 3)
        green = green + rng.normal(0.0, 0.7 * noise, green.shape)
        found = match(pan, green, at_pan, at_green, ratio=3, half=7, search=3)
        ok = (found[:, 7] > 0) & (found[:, 5] > 0.6) & (found[:, 6] > 0.05)
        assert ok.mean() > 0.85
        # Green pixel c has its centre at PAN 3 c + 1.
        truth = (found[ok, 0:2] + (dx, dy) - 1.0) / 3.0
        error = found[ok, 2:4] - truth
        means.append(error.mean(axis=0))
        normalised.append(error / found[ok, 4:5])
    assert np.abs(means).max() < 0.01
    assert np.sqrt(np.mean(np.concatenate(normalised) ** 2)) == pytest.approx(1.0, abs=0.2)


def test_an_even_ratio_keeps_the_half_pixel_between_centres() -> None:
    rng = np.random.default_rng(14)
    size = 800
    texture = Texture(size, rng, cutoff=0.15)
    at_green = grid(24, size // 2 - 24, 16)
    pan, green = texture.moved(0.0, 0.0), box_means(texture.moved(0.4, -0.8), 2)
    found = match(pan, green, 2 * at_green, at_green, ratio=2, half=7, search=3)
    ok = found[:, 7] > 0
    error = found[ok, 2:4] - (found[ok, 0:2] + (0.4, -0.8) - 0.5) / 2.0
    assert ok.mean() > 0.9
    assert np.abs(error.mean(axis=0)).max() < 0.003


def test_a_repeated_pattern_is_not_matched_because_its_peak_is_not_unique() -> None:
    column = np.arange(200.0)
    stripes = np.sin(2.0 * np.pi * column / 5.0)
    pattern = 2000.0 + 200.0 * (stripes[None, :] + stripes[:, None])
    at = grid(40, 160, 20)
    found = match(pattern, pattern, at, at)
    assert not np.any((found[:, 7] > 0) & (found[:, 6] > 0.05))


def test_a_flat_patch_and_one_off_the_search_are_not_matched() -> None:
    flat = np.full((200, 200), 1000.0)
    at = grid(40, 160, 20)
    assert not match(flat, flat, at, at)[:, 7].any()
    texture = Texture(400, np.random.default_rng(15))
    at = grid(60, 340, 20)
    found = match(texture.moved(0, 0), texture.moved(15.0, 0.0), at, at)
    assert np.mean((found[:, 7] > 0) & (found[:, 5] > 0.6)) < 0.02


def test_saturated_or_missing_pixels_keep_a_patch_from_being_used() -> None:
    texture = Texture(300, np.random.default_rng(16)).moved(0.0, 0.0)
    raw = (8.0 * texture).astype(np.uint16) & 0xFFFE
    at = np.array([[100, 100], [200, 200], [100, 200]], dtype=np.int64)
    damaged = raw.copy()
    damaged[100, 104] |= 1
    damaged[203, 200] = 0
    limits = np.array([0, 299, 0, 299], dtype=np.int64)
    found = match_patches(raw, damaged, at, at, limits, 1, 9, 6, True, INTERPOLATION)
    assert found[:, 7].tolist() == [0.0, 0.0, 1.0]
    assert found[2, 0:2] == pytest.approx(found[2, 2:4], abs=1e-3)
    broken = texture.astype(np.float32)
    broken[100, 104] = np.nan
    limits_ok = match_patches(
        texture.astype(np.float32), broken, at, at, limits, 1, 9, 6, False, INTERPOLATION
    )
    assert limits_ok[:, 7].tolist() == [0.0, 1.0, 1.0]


def test_a_corner_is_preferred_to_an_edge() -> None:
    frame = np.zeros((120, 120), dtype=np.float32)
    frame[60:, 60:] = 100.0
    cells = np.array([[30, 90, 30, 90]], dtype=np.int64)
    ((column, row, eigenvalue),) = select_features(frame, cells, 9, 2, False)
    assert abs(column - 60) <= 10
    assert abs(row - 60) <= 10
    assert eigenvalue > 0
    edge = np.zeros((120, 120), dtype=np.float32)
    edge[:, 60:] = 100.0
    assert select_features(edge, cells, 9, 2, False)[0, 2] == pytest.approx(0.0, abs=1e-6)
