"""Frames for warming up: what all sensors see is one plane, pixel by pixel."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from processing.geometry.placement import nominal_placements, vip_mm_from_raw, vip_px_from_mm
from processing.pipelines import synthetic_frames
from processing.rig import find_rig

STEP_PX = 1 / 32
"""OpenCV takes pixels in such steps."""


@pytest.mark.parametrize("name", ["ultracam-x-mini", "dmc-mini"])
def test_every_sensor_sees_the_same_plane_in_its_nominal_placement(name: str) -> None:
    rig = find_rig(name)
    image = rig.virtual_image
    assert image is not None
    tile = synthetic_frames._tile()
    slope = max(np.abs(np.diff(tile, axis=axis)).max() for axis in (0, 1))
    frames, placements = synthetic_frames.synthetic_frames(rig), nominal_placements(rig, {}, {})
    draw = np.random.default_rng(3)
    for sensor in rig.sensors:
        columns = draw.integers(0, sensor.width_px, 2000)
        rows = draw.integers(0, sensor.height_px, 2000)
        mm = vip_mm_from_raw(placements[sensor.name], np.column_stack([columns, rows]) * 1.0)
        px = vip_px_from_mm(image, mm)
        expected = map_coordinates(tile, [px[:, 1], px[:, 0]], order=1, mode="grid-wrap")
        span = sensor.full_scale_dn - sensor.black_dn
        seen = (frames[sensor.name][rows, columns] - float(sensor.black_dn)) / span
        assert np.abs(seen - expected).max() < STEP_PX * slope + 2.0 / span, sensor.name
