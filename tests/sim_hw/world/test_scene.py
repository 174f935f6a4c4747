"""The emulated ground repeats no patch, has no blurred seam, and keeps what it is given."""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from sim_hw.world import quilt_layout, quilt_levelling, quilting, spline
from sim_hw.world.scene import (
    UNIT,
    SceneError,
    SceneSettings,
    emulated_nir,
    open_scene,
    radiance,
    shipped_pictures,
)
from sim_hw.world.seeding import random_stream

SETTINGS = SceneSettings(seed=1, width_px=1500, height_px=1200, sample_m=0.2, colour_ratio=3)


PLANS = pytest.mark.parametrize("plan", [quilting.plan_quilt, quilting.plan_land])


@pytest.fixture(scope="module")
def sources() -> list[quilting.Picture]:
    return [radiance(path) for path in shipped_pictures()]


@PLANS
def test_a_line_of_the_small_rig_repeats_no_patch(plan, sources: list[quilting.Picture]) -> None:
    quilt = plan(sources, height_px=13623, width_px=4246, random=random_stream(1, "quilt"))
    used = [patch for row in quilt.rows for patch in row]
    assert len(used) == len(set(used)) == 43 * 14
    assert quilt.reused == 0


@PLANS
def test_one_cell_is_not_used_twice_near_itself(plan, sources: list[quilting.Picture]) -> None:
    quilt = plan(sources, height_px=13623, width_px=4246, random=random_stream(1, "quilt"))
    for upper, lower in pairwise(quilt.rows):
        for one, right in pairwise(upper):
            assert one.cell != right.cell
        for one, below in zip(upper, lower, strict=True):
            assert one.cell != below.cell


@PLANS
def test_every_sample_is_one_of_a_source_and_none_is_a_blend(plan) -> None:
    random = np.random.default_rng(0)
    # Two sources of values no other holds: a blend of them would be seen at once.
    low = random.integers(0, 1000, (800, 800, 4), dtype=np.uint16)
    high = random.integers(60000, 61000, (800, 800, 4), dtype=np.uint16)
    quilt = plan([low, high], height_px=1400, width_px=1400, random=random)
    quilt = replace(quilt, gains=None)
    picture = quilting.assemble([low, high], quilt, height_px=1400, width_px=1400)
    assert picture.shape == (1400, 1400, 4)
    assert np.all((picture < 1000) | (picture >= 60000))
    assert 0.02 < np.mean(picture < 1000) < 0.98


def test_the_cut_follows_the_least_difference() -> None:
    error = np.full((200, 30), 10.0, dtype=np.float32)
    way = np.clip(15 + np.cumsum(random_stream(2, "way").integers(-1, 2, 200)), 0, 29)
    error[np.arange(200), way] = 0.0
    assert np.array_equal(quilting.least_error_cut(error), way)


def test_patches_meet_better_at_a_seam_than_by_chance(sources: list[quilting.Picture]) -> None:
    size = {"height_px": 1648, "width_px": 1648}
    quilt = quilting.plan_quilt(sources, **size, random=random_stream(1, "quilt"))
    picture = np.sqrt(quilting.assemble(sources, quilt, **size)[..., 1].astype(np.float64))
    step = quilting.PATCH_PX - quilting.OVERLAP_PX
    across = np.abs(np.diff(picture, axis=1))
    seam = np.mean(
        [across[:, k * step : k * step + quilting.OVERLAP_PX].max(1).mean() for k in (1, 2)]
    )
    straight = np.mean(
        [
            np.abs(picture[:, k * step] - np.roll(picture[:, k * step - 1], 577)).mean()
            for k in (1, 2)
        ]
    )
    assert seam < straight


def test_neighbours_fit_and_are_of_one_brightness(sources: list[quilting.Picture]) -> None:
    """A patch differs from its neighbours by far less than from any other; levelling helps."""
    size = {"height_px": 2288, "width_px": 2288}
    quilt = quilting.plan_land(sources, **size, random=random_stream(1, "quilt"))
    step = quilting.PATCH_PX - quilting.OVERLAP_PX
    differences = []
    for gains in (quilt.gains, None):
        picture = quilting.assemble(sources, replace(quilt, gains=gains), **size)
        tiles = picture[: 7 * step, : 7 * step, 1].reshape(7, step, 7, step).astype(np.float64)
        # Strips on both sides of a seam, past the reach of its cut.
        left = np.log(tiles[..., 316:318].mean(axis=(1, 3)))[:, :-1]
        right = np.log(tiles[..., 50:52].mean(axis=(1, 3)))[:, 1:]
        differences.append(np.sqrt(np.mean((left - right) ** 2)))
        spread = np.log(tiles.mean(axis=(1, 3))).std()
    levelled, plain = differences
    assert levelled < plain < 1.5 * spread


def test_levelling_keeps_the_borders_of_the_ground_and_evens_out_the_light() -> None:
    """Four patches in a row: light of +-10 %, and a border to ground half as bright."""
    signal = np.log(np.array([1.1, 0.9, 0.45, 0.5], np.float32)).reshape(1, 4, 1, 1)
    side = np.broadcast_to(signal, (1, 4, 2, 1))
    none = np.zeros((1, 4, 2, 1), np.float32)
    gains = quilt_levelling.corner_gains(side, side, none, none)[0, ..., 0]
    level = gains * np.exp(signal[0])
    seams = level[1:, :, 0] / level[:-1, :, 1]
    assert seams[0] == pytest.approx([1.0, 1.0], abs=0.06)
    assert seams[2] == pytest.approx([1.0, 1.0], abs=0.06)
    assert (seams[1] < 0.65).all()


def test_gains_are_bilinear_and_saturate() -> None:
    patch = np.full((5, 5, 2), 40000, np.uint16)
    corners = np.array([[[1.0, 1.0], [2.0, 0.5]], [[0.5, 1.0], [1.0, 0.5]]], np.float32)
    found = quilt_levelling.scaled(patch, corners)
    assert found[0, :, 0].tolist() == [40000, 50000, 60000, 65535, 65535]
    assert found[4, :, 0].tolist() == [20000, 25000, 30000, 35000, 40000]
    assert found[:, 2, 1].tolist() == [30000] * 5


def test_an_arrangement_finds_the_only_order_that_fits() -> None:
    """Patches whose right edge fits one left edge alone, in a row."""
    n = 6
    right_of = np.ones((n, n), np.float32)
    right_of[np.arange(n - 1), np.arange(1, n)] = 0.0
    order = quilt_layout.arrange(
        (1, n), right_of, np.ones((n, n), np.float32), np.zeros(n, np.float32),
        np.arange(n), np.random.default_rng(3),
    )  # fmt: skip
    assert order.tolist() == [list(range(n))]


def test_costly_patches_are_left_out_as_long_as_there_are_others() -> None:
    own = np.array([0.0, 9.0, 0.0, 0.0, 9.0, 0.0], np.float32)
    same = np.ones((6, 6), np.float32)
    order = quilt_layout.arrange((2, 2), same, same, own, np.arange(6), np.random.default_rng(0))
    assert sorted(order.ravel()) == [0, 2, 3, 5]


def test_a_scene_is_built_once_and_found_again(tmp_path: Path) -> None:
    first = open_scene(SETTINGS, tmp_path)
    stamp = next(tmp_path.glob("scene-*/pan.npy")).stat().st_mtime_ns
    again = open_scene(SETTINGS, tmp_path)
    assert next(tmp_path.glob("scene-*/pan.npy")).stat().st_mtime_ns == stamp
    assert np.array_equal(first.bands["pan"], again.bands["pan"])
    assert first.bands["pan"].shape == (1200, 1500)
    assert first.bands["green"].shape == (600, 750)
    open_scene(replace(SETTINGS, seed=2), tmp_path)
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("wavelength_px", [30.0, 10.0, 5.0, 3.0])
def test_the_lens_passes_what_a_gaussian_of_its_size_passes(wavelength_px: float) -> None:
    x = np.arange(300)
    wave = np.cos(2 * np.pi * x / wavelength_px)
    picture = np.tile(wave, (64, 1)).astype(np.float32)
    line = spline.coefficients(picture, 0.55)[32]
    seen = np.convolve(line, [1 / 120, 26 / 120, 66 / 120, 26 / 120, 1 / 120], mode="same")
    taps = np.exp(-0.5 * (np.arange(-6, 7) / 0.55) ** 2)
    transfer = (taps * np.cos(2 * np.pi * np.arange(-6, 7) / wavelength_px)).sum() / taps.sum()
    assert seen[60:240] == pytest.approx(transfer * wave[60:240], abs=2e-4)


def test_radiances_are_linear_and_white_is_one(sources: list[quilting.Picture]) -> None:
    for source in sources:
        level = np.percentile(source.reshape(-1, 4)[::31], 99.5, axis=0) / UNIT
        assert level == pytest.approx([1, 1, 1, 1], abs=0.05)


def test_emulated_near_infrared_is_bright_on_green_leaves_only() -> None:
    leaf, soil = np.array([[[0.03, 0.06, 0.03]]], "f4"), np.array([[[0.3, 0.25, 0.2]]], "f4")
    assert emulated_nir(leaf)[0, 0] > 2.5 * leaf[0, 0, 1]
    assert emulated_nir(soil)[0, 0] == pytest.approx(0.32, abs=0.03)


def test_a_geotiff_without_rasterio_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rasterio", None)
    raster = tmp_path / "field.tif"
    raster.write_bytes(b"II*\0")
    with pytest.raises(SceneError, match=r"syntopic\[geotiff\]"):
        open_scene(replace(SETTINGS, file=str(raster)), tmp_path / "cache")
    assert not list((tmp_path / "cache").iterdir())
