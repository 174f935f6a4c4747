"""Images on the ground: held against collinearity equations that are written out here."""

from __future__ import annotations

import numpy as np
import pytest

from processing.geometry.terrain_rays import HeightModel
from processing.image.orthoimage.ground_grid import GroundGrid, ground_surface, heights_on
from processing.image.orthoimage.ground_resampling import (
    ImagePose,
    project,
    reduced_image,
    resample_to_ground,
    window_seen,
)

SIZE = (180, 240)
CENTRE = np.array([40.0, 30.0, 1000.0])


def _rotation(omega: float, phi: float, kappa: float) -> np.ndarray:
    """Rx(omega) Ry(phi) Rz(kappa), written out."""
    so, co, sp, cp, sk, ck = (f(v) for v in (omega, phi, kappa) for f in (np.sin, np.cos))
    return (
        np.array([[1, 0, 0], [0, co, -so], [0, so, co]])
        @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        @ np.array([[ck, -sk, 0], [sk, ck, 0], [0, 0, 1]])
    )


POSE = ImagePose(100.0, 0.05, SIZE[1], SIZE[0], CENTRE, _rotation(0.02, -0.03, 0.7))
"""Half a metre on the ground."""
MODEL = HeightModel(
    np.add.outer(np.linspace(20.0, -10.0, 31), np.linspace(0.0, 25.0, 41)),
    -160.0, 180.0, 10.0, -12.0,
)  # fmt: skip
GRID = GroundGrid(-10.0, 70.0, 0.4, 250, 200)


def _seen(ground: np.ndarray) -> np.ndarray:
    """Column and row of ground points (n, 3) by the collinearity equations."""
    r = POSE.rotation
    d = ground - CENTRE
    u, v, w = (d @ r[:, k] for k in range(3))
    x, y = -POSE.f_mm * u / w, -POSE.f_mm * v / w
    return np.stack(
        [x / POSE.pixel_mm + (SIZE[1] - 1) / 2, (SIZE[0] - 1) / 2 - y / POSE.pixel_mm], axis=-1
    )


def _ground() -> np.ndarray:
    e, n = np.meshgrid(GRID.columns_m, GRID.rows_m)
    return np.stack([e, n, heights_on(GRID, MODEL)], axis=-1)


def _light(at: np.ndarray) -> np.ndarray:
    """A smooth picture as a function of column and row."""
    return 5000.0 + 900.0 * np.sin(at[..., 0] / 2.1) + 900.0 * np.cos(at[..., 1] / 2.7 + 0.4)


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    c, r = np.meshgrid(np.arange(SIZE[1]), np.arange(SIZE[0]))
    return _light(np.stack([c, r], axis=-1)).round().astype(np.uint16)[None]


def test_ground_pixels_lie_in_the_image_where_collinearity_puts_them() -> None:
    found = project(ground_surface(GRID, MODEL), POSE)
    assert np.moveaxis(found, 0, -1) == pytest.approx(_seen(_ground()), abs=1e-4)


def test_a_resampled_pixel_has_the_signal_of_its_place_in_the_image(image) -> None:
    tile = resample_to_ground(image, POSE, ground_surface(GRID, MODEL))[0]
    at = _seen(_ground())
    inner = ((at > 3) & (at < [SIZE[1] - 4, SIZE[0] - 4])).all(axis=-1)
    assert inner.sum() > 10_000
    # A shift of 0.05 px along one axis changes the signal by 15 RMS; the kernel's own is 0.02.
    assert np.sqrt(np.mean((tile - _light(at))[inner] ** 2)) < 10.0
    wrong = _light(at + np.array([0.05, 0.0]))
    assert np.sqrt(np.mean((tile - wrong)[inner] ** 2)) > 14.0
    outside = ((at < -0.6) | (at > [SIZE[1] - 0.4, SIZE[0] - 0.4])).any(axis=-1)
    assert outside.any() and not tile[outside].any()


def test_the_lattice_carries_a_system_other_than_that_of_the_grid(image) -> None:
    turn = _rotation(0.0, 0.0, 0.3)

    def cartesian(points: np.ndarray) -> np.ndarray:
        return points @ turn.T + [100.0, -50.0, 7.0]

    moved = ImagePose(
        POSE.f_mm, POSE.pixel_mm, SIZE[1], SIZE[0],
        turn @ CENTRE + [100.0, -50.0, 7.0], turn @ POSE.rotation,
    )  # fmt: skip
    plain = resample_to_ground(image, POSE, ground_surface(GRID, MODEL))
    carried = resample_to_ground(image, moved, ground_surface(GRID, MODEL, cartesian))
    assert carried == pytest.approx(plain, abs=0.01)


def test_tiles_are_parts_of_the_whole(image) -> None:
    whole = resample_to_ground(image, POSE, ground_surface(GRID, MODEL))
    part = GRID.window(70, 65, 100, 90)
    surface = ground_surface(part, MODEL, step_px=16)
    seen = window_seen(surface, POSE)
    assert seen is not None
    c, r, width, height = seen
    assert width * height < 0.6 * SIZE[0] * SIZE[1]
    cut = image[:, r : r + height, c : c + width]
    tile = resample_to_ground(cut, POSE.window(*seen), surface)
    assert tile == pytest.approx(whole[:, 65:155, 70:170], abs=0.01)


def test_a_missing_pixel_leaves_a_hole_and_moves_nothing_else(image) -> None:
    holed = image.copy()
    holed[0, 80:100, 100:130] = 0
    whole = resample_to_ground(image, POSE, ground_surface(GRID, MODEL))[0]
    tile = resample_to_ground(holed, POSE, ground_surface(GRID, MODEL))[0]
    at = _seen(_ground())
    hole = ((at > [99, 79]) & (at < [130, 100])).all(axis=-1)
    assert hole.any() and not tile[hole].any()
    far = ((at < [97, 77]) | (at > [132, 102])).any(axis=-1)
    assert (tile[far] == whole[far]).all()
    border = ~hole & ~far
    assert np.abs(tile[border] - _light(at)[border])[tile[border] > 0].max() < 250.0


def test_ground_of_unknown_height_has_no_data(image) -> None:
    heights = MODEL.height_m.copy()
    heights[12:14, 18:20] = np.nan
    model = HeightModel(heights, MODEL.x_m, MODEL.y_m, MODEL.step_x_m, MODEL.step_y_m)
    tile = resample_to_ground(image, POSE, ground_surface(GRID, model))[0]
    unknown = np.isnan(heights_on(GRID, model))
    assert unknown.any() and not tile[unknown].any()


def test_only_wanted_pixels_are_computed(image) -> None:
    wanted = np.zeros((GRID.height_px, GRID.width_px), bool)
    wanted[50:60] = True
    tile = resample_to_ground(image, POSE, ground_surface(GRID, MODEL), wanted=wanted)[0]
    assert not tile[~wanted].any() and tile[wanted].any()


def test_a_reduced_image_is_where_the_full_one_is(image) -> None:
    grid = GRID.coarser(8)
    surface = ground_surface(grid, MODEL, step_px=8)
    pixels = np.zeros((1, *SIZE), np.uint16)
    c = np.arange(SIZE[1])
    pixels[0] = 1000 + 10 * c
    tile = resample_to_ground(reduced_image(pixels, 6), POSE.reduced(6), surface)[0]
    column = project(surface, POSE)[0]
    inner = tile > 0
    assert inner.sum() > 100
    inside = inner & (column > 12) & (column < SIZE[1] - 12)
    assert tile[inside] == pytest.approx(1000 + 10 * column[inside], abs=1.5)  # 0.025 of a block


def test_a_block_with_a_missing_pixel_has_no_data() -> None:
    pixels = np.full((1, 12, 15), 500, np.uint16)
    pixels[0, 5, 7] = 0
    for factor in (2, 3, 4):
        small = reduced_image(pixels, factor)[0]
        assert small[5 // factor, 7 // factor] == 0
        assert (small == 0).sum() == 1


def test_an_image_of_another_size_is_refused(image) -> None:
    with pytest.raises(ValueError, match="the pose is of"):
        resample_to_ground(image[:, 1:], POSE, ground_surface(GRID, 0.0))


def test_a_camera_that_looks_up_sees_no_ground(image) -> None:
    up = ImagePose(100.0, 0.05, SIZE[1], SIZE[0], CENTRE, _rotation(np.pi, 0.0, 0.0))
    surface = ground_surface(GRID, 0.0)
    assert window_seen(surface, up) is None
    assert not resample_to_ground(image, up, surface).any()
