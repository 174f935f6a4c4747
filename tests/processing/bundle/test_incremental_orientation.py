"""Images of which nothing is known are oriented as they were, or stated as not oriented."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from processing.bundle.damped_adjustment import FreeBlock, damped_adjustment
from processing.bundle.incremental_orientation import (
    PhotographTracks,
    _Growing,
    orient_photographs,
)
from processing.bundle.network import INTERIOR, CameraModel
from processing.geometry.positions_fit import NotPlacedError, fit_positions

F, PIXEL, K1 = 4.3, 0.002, -1.5e-3
HALF = (2.4, 1.8)


def scene(relief_m: float, *, seed: int = 1, images: int = 8, noise_px: float = 0.4):
    """Two strips of nadir images with free headings; projection is written here."""
    random = np.random.default_rng(seed)
    ground = np.column_stack(
        [random.uniform(-120, 120, (3000, 2)), relief_m * random.uniform(-1, 1, 3000)]
    )
    place, turn = [], []
    for k in range(images):
        place.append([-60 + 35.0 * (k % 4), 40.0 * (k // 4) - 20, 90 + random.normal(0, 2)])
        tilt = Rotation.from_euler("xyz", [*random.normal(0, 6, 2), 170 * (k // 4)], degrees=True)
        turn.append(tilt.as_matrix())
    place, turn = np.array(place), np.array(turn)
    rows = []
    for k in range(images):
        seen = (ground - place[k]) @ turn[k]
        ideal = -F * seen[:, :2] / seen[:, 2:]
        ideal[np.abs(ideal).max(axis=1) > 4.0] = 9.0
        measured = ideal.copy()
        for _ in range(10):
            r2 = (measured**2).sum(axis=1, keepdims=True)
            measured = ideal - K1 * r2 * measured
        inside = (np.abs(measured) < HALF).all(axis=1)
        seen_px = measured[inside] + random.normal(0, noise_px * PIXEL, (inside.sum(), 2))
        at = np.flatnonzero(inside)
        rows.append(np.column_stack([np.full(len(at), k), at, seen_px]))
    rows = np.concatenate(rows)
    _, point = np.unique(rows[:, 1].astype(int), return_inverse=True)
    tracks = PhotographTracks(
        rows[:, 0].astype(np.int64), point, rows[:, 2:], images, int(point.max()) + 1
    )
    return tracks, place, turn


def camera(f_mm: float = F) -> CameraModel:
    return CameraModel(
        "C", f_mm, free=frozenset(("df", "k1")), sigma={"df": 0.02 * f_mm, "k1": 5e-3},
        pixel_mm=PIXEL,
    )  # fmt: skip


@pytest.mark.parametrize("relief_m", [0.0, 12.0], ids=["level", "hilly"])
def test_images_without_attitudes_come_back_to_the_truth(relief_m) -> None:
    tracks, place, turn = scene(relief_m)
    found = orient_photographs([camera(1.01 * F)], tracks)
    assert found is not None and found.oriented.all()
    fit = fit_positions(found.station, place)
    assert np.abs(fit.residual_m).max() < 0.6
    away = Rotation.from_matrix(turn.transpose(0, 2, 1) @ fit.rotation @ found.rotation)
    assert np.degrees(away.magnitude()).max() < 0.6
    tied = np.bincount(tracks.point)[tracks.point] >= 2
    assert found.used[tied].mean() > 0.95


def test_images_of_two_cameras_keep_an_interior_orientation_each() -> None:
    """Every other image is of a camera with 1.5 times the principal distance and pixel size."""
    tracks, place, _ = scene(12.0)
    of_image = np.arange(8) % 2
    xy_mm = tracks.xy_mm * np.where(of_image[tracks.image] == 1, 1.5, 1.0)[:, None]
    both = replace(tracks, xy_mm=xy_mm, camera=of_image)
    larger = replace(
        camera(0.99 * 1.5 * F), name="D", pixel_mm=1.5 * PIXEL, sigma={"df": 0.15, "k1": 3e-3}
    )
    found = orient_photographs([camera(1.01 * F), larger], both)
    assert found is not None and found.oriented.all()
    assert np.abs(fit_positions(found.station, place).residual_m).max() < 0.6
    k1 = found.interior[:, INTERIOR.index("k1")]
    assert k1 == pytest.approx([K1, K1 / 1.5**2], rel=0.1)
    df = found.interior[:, INTERIOR.index("df")]
    ratio = (0.99 * 1.5 * F - df[1]) / (1.01 * F - df[0])
    assert ratio == pytest.approx(1.5, rel=2e-3)


def test_hovering_at_a_place_does_not_keep_a_block_from_being_oriented() -> None:
    """Seven images of one place have more common points than any pair with a base."""
    tracks, place, _ = scene(12.0, noise_px=0.0)
    own = tracks.image == 1
    random = np.random.default_rng(6)
    image = np.concatenate([tracks.image, *(np.full(own.sum(), 8 + k) for k in range(6))])
    point = np.concatenate([tracks.point, np.tile(tracks.point[own], 6)])
    xy_mm = np.concatenate([tracks.xy_mm, np.tile(tracks.xy_mm[own], (6, 1))])
    xy_mm = xy_mm + random.normal(0.0, 0.4 * PIXEL, xy_mm.shape)
    found = orient_photographs([camera()], PhotographTracks(image, point, xy_mm, 14, tracks.points))
    assert found is not None and found.oriented.all()
    places = np.concatenate([place, np.repeat(place[1:2], 6, axis=0)])
    assert np.abs(fit_positions(found.station, places).residual_m).max() < 0.6


def test_the_larger_of_two_unconnected_groups_is_oriented() -> None:
    """The first two images have the most common points, and nothing in common with the others."""
    tracks, place, _ = scene(12.0)
    apart = tracks.image < 2
    count = np.bincount(tracks.point[apart])
    keep = ~apart | (np.append(count, np.zeros(tracks.points, int))[tracks.point] == 2)
    point = np.where(apart, tracks.point + tracks.points, tracks.point)[keep]
    found = orient_photographs(
        [camera()],
        PhotographTracks(tracks.image[keep], point, tracks.xy_mm[keep], 8, 2 * tracks.points),
    )
    assert found is not None
    assert np.flatnonzero(found.oriented).tolist() == [2, 3, 4, 5, 6, 7]
    own = found.oriented
    assert np.abs(fit_positions(found.station[own], place[own]).residual_m).max() < 0.6


def test_unrelated_images_are_left_without_orientation() -> None:
    tracks, place, _ = scene(12.0)
    random = np.random.default_rng(3)
    wrong = np.isin(tracks.image, (2, 5))
    xy = tracks.xy_mm.copy()
    xy[wrong] = random.uniform(-1, 1, (wrong.sum(), 2)) * HALF
    found = orient_photographs(
        [camera()], PhotographTracks(tracks.image, tracks.point, xy, 8, tracks.points)
    )
    assert found is not None
    assert found.oriented.tolist() == [True, True, False, True, True, False, True, True]
    own = found.oriented
    assert np.abs(fit_positions(found.station[own], place[own]).residual_m).max() < 0.6


def test_images_without_common_points_are_not_oriented() -> None:
    tracks, *_ = scene(12.0)
    alone = np.arange(len(tracks.image), dtype=np.int64)
    assert orient_photographs(
        [camera()], PhotographTracks(tracks.image, alone, tracks.xy_mm, 8, len(alone))
    ) is None  # fmt: skip


def test_one_wrong_position_does_not_move_the_block() -> None:
    random = np.random.default_rng(2)
    model = random.normal(size=(9, 3))
    turn = Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix()
    known = 40.0 * model @ turn.T + [1.0, 2.0, 3.0] + random.normal(0, 0.01, (9, 3))
    known[4] += [0.0, 500.0, 0.0]
    fit = fit_positions(model, known)
    assert not fit.used[4] and fit.used.sum() >= 6
    assert abs(fit.scale - 40.0) < 0.1
    assert np.allclose(fit.rotation, turn, atol=1e-3)


def test_positions_on_one_line_are_refused() -> None:
    model = np.random.default_rng(5).normal(size=(6, 3))
    line = np.outer(np.arange(6.0), [30.0, 10.0, 0.0])
    with pytest.raises(NotPlacedError, match="one line"):
        fit_positions(model, line)


def test_wrong_tracks_do_not_shrink_the_principal_distance_to_nothing() -> None:
    """With none, all image points would coincide and every track would fit."""
    tracks, place, turn = scene(12.0, images=4)
    tied = np.bincount(tracks.point)[tracks.point] >= 2
    points, point = np.unique(tracks.point[tied], return_inverse=True)
    random = np.random.default_rng(7)
    xy_mm = random.uniform(-1, 1, (len(point), 2)) * HALF
    xyz = random.uniform(-60, 60, (len(points), 3))
    started = FreeBlock(place[:4], turn[:4], xyz, np.zeros((1, 10)))
    found = damped_adjustment(
        [camera()], np.zeros(4, np.int64), started, tracks.image[tied], point, xy_mm
    )
    df = found.interior[0, INTERIOR.index("df")]
    assert abs(df) <= 5.0 * camera().sigma["df"]
    assert F + df > 0.8 * F


def test_an_image_that_sees_points_of_one_place_only_is_left_without_orientation() -> None:
    """OpenCV ends in an assertion then; points of wrong tracks come to lie so."""
    tracks, *_ = scene(12.0)
    block = _Growing((camera(),), tracks)
    own = block._rows[0]
    block.xyz[tracks.point[own]] = 1e-5 * np.column_stack([block.ideal[own], np.ones(len(own))])
    assert not block._resect(0)


def test_an_adjustment_without_fitting_points_changes_nothing() -> None:
    """As in a trial whose first images contradict each other."""
    camera = CameraModel("head", F, interior=np.zeros(len(INTERIOR)), pixel_mm=PIXEL)
    image, point = np.repeat([0, 1, 2], 20), np.tile(np.arange(20), 3)
    xy_mm = np.random.default_rng(2).uniform(-1.0, 1.0, (60, 2))
    block = _Growing((camera,), PhotographTracks(image, point, xy_mm, 3, 20))
    block.station[:2], block.rotation[:2] = np.eye(3)[:2], np.eye(3)
    block.adjust()
    assert not block.used().any()
    assert np.array_equal(block.station[:2], np.eye(3)[:2])
