"""Images that lie otherwise are turned by quarters, and pixels with them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import ndimage

from processing.geometry.rotation import rotation_matrix
from processing.geometry.terrain_rays import HeightModel
from processing.matching.block_matching import (
    BlockMatching,
    BlockTiePoints,
    match_block,
)
from processing.matching.plane_rectification import quarter_rotations, rectified, rotated_px
from processing.rig import VirtualImage


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_pixels_rotate_with_their_image_and_back(quarters: int) -> None:
    image = np.arange(5 * 7).reshape(5, 7)
    rotated = np.rot90(image, quarters)
    c, r = np.meshgrid(np.arange(7), np.arange(5))
    px = np.stack([c.ravel(), r.ravel()], axis=1).astype(float)
    at = rotated_px(px, 7, 5, quarters).astype(int)
    assert (rotated[at[:, 1], at[:, 0]] == image.ravel()).all()
    back = rotated_px(at.astype(float), rotated.shape[1], rotated.shape[0], (4 - quarters) % 4)
    assert (back == px).all()


IMAGE = VirtualImage(320, 240, 7.2, 51.0, 1)
GROUND_PX_M = 0.15


class FlatGround:
    """Level ground with random texture about a middle, as images of any pose see it."""

    def __init__(self, place: np.ndarray, rotations: np.ndarray, middle_m: tuple[float, float]):
        random = np.random.default_rng(3)
        texture = ndimage.gaussian_filter(random.normal(size=(900, 900)), 1.5)
        self.coefficients = ndimage.spline_filter(texture / texture.std() * 500.0 + 5000.0)
        self.place, self.rotations, self.middle_m = place, rotations, middle_m

    def ground_of(self, k: int, at: np.ndarray) -> np.ndarray:
        xy = (at - np.array([319, 239]) / 2) * [0.0072, -0.0072]
        ray = np.column_stack([xy, np.full(len(xy), -51.0)]) @ self.rotations[k].T
        return self.place[k] - ray * (self.place[k, 2] / ray[:, 2])[:, None]

    def look(self, k: int) -> np.ndarray:
        c, r = np.meshgrid(np.arange(IMAGE.width_px), np.arange(IMAGE.height_px))
        ground = self.ground_of(k, np.stack([c.ravel(), r.ravel()], axis=1).astype(float))
        east, north = ((ground[:, :2] - self.middle_m) / GROUND_PX_M).T
        light = ndimage.map_coordinates(
            self.coefficients, [450.0 - north, 450.0 + east], order=3, prefilter=False, mode="wrap"
        )
        return light.reshape(240, 320).astype(np.float32)

    def errors_px(self, tied: BlockTiePoints) -> np.ndarray:
        """Of image points of the second image, against where the first one's truly are in it."""
        one, other = tied.image == 0, tied.image == 1
        at = {int(p): xy for p, xy in zip(tied.point[one], tied.px[one], strict=True)}
        ground = self.ground_of(0, np.array([at[int(p)] for p in tied.point[other]]))
        seen = (ground - self.place[1]) @ self.rotations[1]
        true = np.array([319, 239]) / 2 + seen[:, :2] * [-51.0, 51.0] / seen[:, 2:] / 0.0072
        return tied.px[other] - true


def test_obliques_of_opposite_flights_that_look_alike_are_tied_through_the_ground() -> None:
    """Ahead of one flight and behind the other: the image is upside down and at another
    position."""
    tilt = math.radians(45.0)
    ahead = rotation_matrix(tilt, 0.0, 0.0)
    behind = rotation_matrix(tilt, 0.02, 0.0) @ rotation_matrix(0.0, 0.0, math.pi)
    place = np.array([[0.0, 0.0, 1000.0], [10.0, -14.0, 1003.0], [0.0, 0.0, 1000.0]])
    rotations = np.stack([ahead, behind, rotation_matrix(-tilt, 0.0, 0.0)])
    ground = FlatGround(place, rotations, (0.0, 1000.0))
    tied = match_block(ground.look, IMAGE, place, rotations, 0.5, BlockMatching(cells=(10, 8)))
    assert set(tied.tried) == {(0, 1)}, "the third looks the other way"
    assert tied.matched[0, 1] > 20
    error = ground.errors_px(tied)
    assert float(np.sqrt(np.mean(error**2))) < 0.02
    assert float(np.abs(error.mean(axis=0)).max()) < 0.01


@pytest.mark.parametrize("kappa_deg", [1.7, 178.3, 91.0])
def test_crab_between_two_lines_does_not_move_matches(kappa_deg) -> None:
    """By quarter turns alone these errors are 0.03 to 0.05 px."""
    place = np.array([[0.0, 0.0, 1000.0], [6.0, -4.0, 1002.0]])
    rotations = np.stack([np.eye(3), rotation_matrix(0.003, -0.002, math.radians(kappa_deg))])
    ground = FlatGround(place, rotations, (0.0, 0.0))
    tied = match_block(ground.look, IMAGE, place, rotations, 0.5, BlockMatching(cells=(10, 8)))
    assert tied.matched[0, 1] > 20
    error = ground.errors_px(tied)
    assert float(np.sqrt(np.mean(error**2))) < 0.01


def test_a_height_model_predicts_where_the_plan_does_not() -> None:
    """Ground 300 m above that of the plan moves points by more than is searched."""
    place = np.array([[0.0, 0.0, 940.0], [14.0, 0.0, 940.0]])
    rotations = np.stack([np.eye(3), np.eye(3)])
    ground = FlatGround(place, rotations, (0.0, 0.0))
    around = {"x_m": -500.0, "y_m": 500.0, "step_x_m": 100.0, "step_y_m": -100.0}

    def matched(ground_m: float, settings: BlockMatching, heights: HeightModel | None) -> int:
        tied = match_block(
            ground.look, IMAGE, place, rotations, ground_m, settings, heights=heights
        )
        return tied.matched.get((0, 1), 0)

    narrow = BlockMatching(cells=(10, 8), first_search_px=3)
    model = HeightModel(np.zeros((11, 11)), **around)
    assert matched(-300.0, narrow, None) == 0
    assert matched(-300.0, narrow, model) > 20
    unknown = HeightModel(np.full((11, 11), np.nan), **around)
    unknown.height_m[:, :1] = 0.0
    assert matched(0.0, narrow, unknown) == matched(0.0, narrow, None) > 20


def test_images_that_differ_by_a_shift_and_quarter_turns_are_not_resampled() -> None:
    random = np.random.default_rng(1)
    there = random.normal(size=(240, 320)).astype(np.float32)
    here = (np.array([0.0, 0.0, 1000.0]), np.eye(3))
    for quarters in range(4):
        turned = rotation_matrix(0.0, 0.0005, quarters * math.pi / 2)
        seen, into, back = rectified(
            there, IMAGE, here, (np.array([5.0, -3.0, 1000.0]), turned), 0.0
        )
        assert np.array_equal(seen, np.rot90(there, quarters))
        assert np.allclose(back(into(np.array([[20.0, 30.0]]))), [[20.0, 30.0]])
        turned = turned @ rotation_matrix(0.0, 0.0, 0.003)
        seen, into, back = rectified(
            there, IMAGE, here, (np.array([5.0, -3.0, 1000.0]), turned), 0.0
        )
        assert seen.shape == there.shape and np.isnan(seen).any()
        assert np.allclose(back(into(np.array([[20.0, 30.0]]))), [[20.0, 30.0]])


@pytest.mark.parametrize(("degrees", "quarters"), [(3, 0), (93, 1), (178, 2), (-88, 3)])
def test_the_other_way_and_crosswise_follow_from_the_rotations(degrees, quarters) -> None:
    here = rotation_matrix(0.01, -0.02, 0.3)
    there = rotation_matrix(-0.015, 0.01, 0.3 + math.radians(degrees))
    assert quarter_rotations(here, there) == quarters
