"""What supports weak tie points counts for what it is worth, neither more nor less."""

from __future__ import annotations

import numpy as np
import pytest

from processing.mosaic.free import free_mosaic, vip_precision_px
from processing.mosaic.support import SupportSettings, supported_mosaic
from processing.mosaic.validity import judge_master
from processing.rig import find_rig
from tests.processing.synthetic import make_truth, tie_points_of

MINI = find_rig("ultracam-x-mini")


@pytest.mark.parametrize("noise", [1.0, 0.2])
def test_an_image_without_its_master_cone_lies_as_surely_as_the_platform_says(noise: float) -> None:
    """Three cones, each turned against the master by its own error: their mean places the image.

    How well points are matched says nothing of it.
    """
    rng = np.random.default_rng(3)
    truth = make_truth(MINI, rng, sensor_px=0.02, layer_px=0.1)
    masters = tuple(sensor.name for sensor in MINI.master_sensors)
    points = tie_points_of(
        truth, rng, without=masters, sigma_pp_px=0.1 * noise, sigma_pc_px=0.3 * noise
    )
    read = dict.fromkeys(MINI.probes, 20.0)
    mosaic = free_mosaic(MINI, truth.start, points)
    judged = judge_master(MINI, mosaic, read)
    image = supported_mosaic(MINI, truth.start, points, mosaic, judged, read)
    sensor = MINI.sensor("SU30")
    middle = np.array([[(sensor.width_px - 1) / 2, (sensor.height_px - 1) / 2]])
    cone = MINI.cone_of("SU30")
    turned_px = SupportSettings().rotation_rad * cone.lens.f_mm / sensor.pitch_mm
    stated = vip_precision_px(image, "SU30", middle)[0]
    assert stated == pytest.approx(np.full(2, turned_px / np.sqrt(3.0)), rel=0.1)
