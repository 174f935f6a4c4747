"""Windows of a frame lie where its mapping puts them."""

from __future__ import annotations

import numpy as np
import pytest

from processing.geometry.placement import (
    nominal_placements,
    raw_from_vip_mm,
    vip_mm_from_px,
    vip_mm_from_raw,
)
from processing.quality.common_windows import _inside
from processing.radiometry.level1 import exposed_rows
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


@pytest.mark.parametrize("shifts", [0, 12])
def test_windows_lie_whole_in_the_exposed_rows_and_none_of_these_is_left_out(shifts: int) -> None:
    rig, half_px = find_rig("ultracam-x-mini"), 24
    for sensor in rig.sensors:
        placement = nominal_placements(rig, {}, {sensor.name: shifts})[sensor.name]
        first, last = exposed_rows(sensor, shifts)
        columns = np.linspace(-2.0, sensor.width_px + 1.0, 87)
        rows = np.linspace(-2.0, sensor.height_px + 1.0, 71)
        raw = np.stack([part.ravel() for part in np.meshgrid(columns, rows)], axis=1)
        at, inside = _inside(placement, vip_mm_from_raw(placement, raw), half_px)
        assert (at > (half_px, first + half_px)).all()
        assert (at < (sensor.width_px - half_px - 1, last - half_px)).all()
        margin_px = half_px + 2  # the polynomial and the end of a window
        whole = (np.abs(raw - (sensor.width_px / 2, 0)) < sensor.width_px / 2 - margin_px)[:, 0]
        whole &= (raw[:, 1] > first + margin_px) & (raw[:, 1] < last - margin_px)
        assert inside[whole].all()
