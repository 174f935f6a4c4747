"""What counts as texture of a window: detail above noise, in every direction."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from processing.matching.texture import has_texture
from processing.radiometry.level1 import level1_counts_per_dn
from processing.rig import find_rig

pytestmark = pytest.mark.trust

SENSOR = find_rig("ultracam-x-mini").sensors[0]
SIZE = 61
MIDDLE = np.array([[SIZE // 2, SIZE // 2]])
LEVEL_DN = 600.0


def is_texture(ground_dn: Any, *, window_px: int = 31) -> bool:
    """Whether ground of this signal, with the noise of the sensor, counts as texture."""
    random = np.random.default_rng(8)
    electrons = ground_dn * SENSOR.electrons_per_dn
    noise_dn = np.sqrt(electrons + SENSOR.read_noise_e**2) / SENSOR.electrons_per_dn
    seen = ground_dn + random.normal(0.0, 1.0, ground_dn.shape) * noise_dn
    frame = np.rint(seen * level1_counts_per_dn(SENSOR.bits)).astype(np.uint16)
    return bool(has_texture(frame, SENSOR, MIDDLE, window_px)[0])


def edge(degrees: float, step_dn: float) -> Any:
    """Ground that is brighter beyond a line through the middle, as a lens leaves it."""
    columns, rows = np.meshgrid(np.arange(SIZE) - SIZE // 2, np.arange(SIZE) - SIZE // 2)
    way = np.radians(degrees)
    return LEVEL_DN + 0.5 * step_dn * np.tanh(columns * np.cos(way) + rows * np.sin(way))


def ground(contrast_dn: float) -> Any:
    smooth = gaussian_filter(np.random.default_rng(9).normal(0.0, 1.0, (SIZE, SIZE)), 1.0)
    return LEVEL_DN + contrast_dn * smooth / smooth.std()


def test_ground_with_detail_is_texture_and_noise_is_none() -> None:
    assert is_texture(ground(60.0)) and is_texture(ground(30.0))
    # Differences of 3.9 and of 2.3 times those of noise, along all directions alike.
    assert is_texture(ground(12.0)) and not is_texture(ground(8.0))
    assert not is_texture(ground(0.0))


@pytest.mark.parametrize("degrees", [0.0, 20.0, 45.0, 90.0, 135.0])
def test_a_single_edge_matches_anywhere_along_itself_and_is_none(degrees: float) -> None:
    assert not is_texture(edge(degrees, 250.0))
    assert is_texture(edge(degrees, 250.0) + edge(degrees + 70.0, 250.0) - LEVEL_DN)


def test_at_the_border_a_window_is_cut_and_one_outside_is_none() -> None:
    frame = np.rint(ground(60.0) * level1_counts_per_dn(SENSOR.bits)).astype(np.uint16)
    at = np.array([[0, 0], [SIZE - 1, SIZE - 1], [-40, -40]])
    assert has_texture(frame, SENSOR, at, 31).tolist() == [True, True, False]
