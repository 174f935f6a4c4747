"""Images that lie otherwise are turned by quarters, and pixels with them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import ndimage

from processing.geometry.rotation import rotation_matrix
from processing.matching.block_matching import (
    BlockMatching,
    match_block,
    quarter_rotations,
    rotated_px,
)
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


def test_obliques_of_opposite_flights_that_look_alike_are_tied_through_the_ground() -> None:
    """Ahead of one flight and behind the other: the image is upside down and at another
    position."""
    random = np.random.default_rng(3)
    texture = ndimage.gaussian_filter(random.normal(size=(900, 900)), 1.5)
    coefficients = ndimage.spline_filter(texture / texture.std() * 500.0 + 5000.0)
    image = VirtualImage(320, 240, 7.2, 51.0, 1)
    tilt = math.radians(45.0)
    ahead = rotation_matrix(tilt, 0.0, 0.0)
    behind = rotation_matrix(tilt, 0.02, 0.0) @ rotation_matrix(0.0, 0.0, math.pi)
    place = np.array([[0.0, 0.0, 1000.0], [10.0, -14.0, 1003.0], [0.0, 0.0, 1000.0]])
    rotations = np.stack([ahead, behind, rotation_matrix(-tilt, 0.0, 0.0)])
    c, r = np.meshgrid(np.arange(image.width_px), np.arange(image.height_px))
    px = np.stack([c.ravel(), r.ravel()], axis=1).astype(float)

    def ground_of(k: int, at: np.ndarray) -> np.ndarray:
        xy = (at - np.array([319, 239]) / 2) * [0.0072, -0.0072]
        ray = np.column_stack([xy, np.full(len(xy), -51.0)]) @ rotations[k].T
        return place[k] - ray * (place[k, 2] / ray[:, 2])[:, None]

    def look(k: int) -> np.ndarray:
        ground = ground_of(k, px)
        at = [450.0 - (ground[:, 1] - 1000.0) / 0.15, 450.0 + ground[:, 0] / 0.15]
        light = ndimage.map_coordinates(coefficients, at, order=3, prefilter=False, mode="wrap")
        return light.reshape(240, 320).astype(np.float32)

    tied = match_block(look, image, place, rotations, 0.5, BlockMatching(cells=(10, 8)))
    assert set(tied.tried) == {(0, 1)}, "the third looks the other way"
    assert tied.matched[0, 1] > 20
    one, other = tied.image == 0, tied.image == 1
    at = {int(p): xy for p, xy in zip(tied.point[one], tied.px[one], strict=True)}
    seen = (ground_of(0, np.array([at[int(p)] for p in tied.point[other]])) - place[1]) @ rotations[
        1
    ]
    true = np.array([319, 239]) / 2 + seen[:, :2] * [-51.0, 51.0] / seen[:, 2:] / 0.0072
    error = tied.px[other] - true
    assert float(np.sqrt(np.mean(error**2))) < 0.04
    assert float(np.abs(error.mean(axis=0)).max()) < 0.01


@pytest.mark.parametrize(("degrees", "quarters"), [(3, 0), (93, 1), (178, 2), (-88, 3)])
def test_the_other_way_and_crosswise_follow_from_the_rotations(degrees, quarters) -> None:
    here = rotation_matrix(0.01, -0.02, 0.3)
    there = rotation_matrix(-0.015, 0.01, 0.3 + math.radians(degrees))
    assert quarter_rotations(here, there) == quarters
