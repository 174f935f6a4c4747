"""Windows of a frame lie where its mapping puts them."""

from __future__ import annotations

import numpy as np
import pytest

from processing.geometry.placement import nominal_placements, raw_from_vip_mm, vip_mm_from_px
from processing.quality.common_windows import _inside
from processing.rig import find_rig


@pytest.mark.parametrize("name", ["ultracam-x", "ultracam-l", "dmc", "ultracam-x-mini", "dmc-mini"])
def test_the_polynomial_of_a_frame_is_its_mapping_to_a_third_of_a_pixel(name: str) -> None:
    rig = find_rig(name)
    assert rig.virtual_image is not None
    x = np.linspace(0.0, rig.virtual_image.width_px - 1.0, 57)
    y = np.linspace(0.0, rig.virtual_image.height_px - 1.0, 37)
    grid = np.stack([part.ravel() for part in np.meshgrid(x, y)], axis=1)
    vip_mm = vip_mm_from_px(rig.virtual_image, grid)
    placements = nominal_placements(rig, {}, {})
    for sensor in rig.sensors:
        at, inside = _inside(placements[sensor.name], vip_mm, 24)
        assert len(at) > 100
        assert np.abs(at - raw_from_vip_mm(placements[sensor.name], vip_mm[inside])).max() < 0.33
