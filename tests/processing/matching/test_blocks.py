"""Images that lie otherwise are turned by quarters, and pixels with them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from processing.geometry.rotation import rotation_matrix
from processing.matching.blocks import quarter_turns, turned_px


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_pixels_turn_with_their_image_and_back(quarters: int) -> None:
    image = np.arange(5 * 7).reshape(5, 7)
    turned = np.rot90(image, quarters)
    c, r = np.meshgrid(np.arange(7), np.arange(5))
    px = np.stack([c.ravel(), r.ravel()], axis=1).astype(float)
    at = turned_px(px, 7, 5, quarters).astype(int)
    assert (turned[at[:, 1], at[:, 0]] == image.ravel()).all()
    back = turned_px(at.astype(float), turned.shape[1], turned.shape[0], (4 - quarters) % 4)
    assert (back == px).all()


@pytest.mark.parametrize(("degrees", "quarters"), [(3, 0), (93, 1), (178, 2), (-88, 3)])
def test_the_other_way_and_crosswise_are_told_by_the_rotations(degrees, quarters) -> None:
    here = rotation_matrix(0.01, -0.02, 0.3)
    there = rotation_matrix(-0.015, 0.01, 0.3 + math.radians(degrees))
    assert quarter_turns(here, there) == quarters
