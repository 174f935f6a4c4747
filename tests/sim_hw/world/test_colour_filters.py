"""A head behind a colour filter array: each pixel has the light of its own filter, and no TDI."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from processing.rig import shipped_rigs
from sim_hw.world import rendering
from sim_hw.world.rendering import ExposureParameters, filter_of
from sim_hw.world.scene import open_scene
from sim_hw.world.world import World, WorldSettings

EPOCH = 1_400_000_000_000_000_000


def world_of(rig: str) -> World:
    return World(
        WorldSettings(rig_file=str(shipped_rigs()[rig]), seed=3, epoch_gps_ns=EPOCH, dc_k=5.0)
    )


@pytest.mark.parametrize(
    ("array", "expected"),
    [
        ("RGGB", [["red", "green"], ["green", "blue"]]),
        ("BGGR", [["blue", "green"], ["green", "red"]]),
        ("GRBG", [["green", "red"], ["blue", "green"]]),
        ("GBRG", [["green", "blue"], ["red", "green"]]),
    ],
)
def test_the_four_letters_are_read_row_by_row(array: str, expected: list[list[str]]) -> None:
    found = [[filter_of(array, column=c, row=r) for c in (4, 5)] for r in (2, 3)]
    assert found == expected


def test_each_pixel_has_the_light_a_head_of_its_band_alone_would_have(tmp_path: Path) -> None:
    world = world_of("ultracam-l-mini")
    scene = open_scene(replace(world.scene_settings, width_px=900, height_px=700), tmp_path)
    assert scene.step("green") == 1
    flight = world.flight.beginning_first_line_at(1100.0)
    cone, sensor = world.rig.cone("RGB"), world.rig.sensor("RGB")
    look = ExposureParameters(
        EPOCH + 20_000_000_000, world.plan.exposure_time_us["RGB"], tdi_shifts=0
    )
    mosaic = rendering.light_on_sensor(world, scene, flight, cone, sensor, look)
    plain = replace(sensor, colour_filter_array="none")
    for band, rows, columns in (
        ("red", slice(0, None, 2), slice(0, None, 2)),
        ("green", slice(1, None, 2), slice(0, None, 2)),
        ("blue", slice(1, None, 2), slice(1, None, 2)),
    ):
        single_band = replace(cone, bands=(band,))
        light = rendering.light_on_sensor(world, scene, flight, single_band, plain, look)
        assert np.array_equal(mosaic[rows, columns], light[rows, columns])


@pytest.mark.parametrize("rig", ["ultracam-l", "ultracam-lp", "ultracam-l-mini"])
def test_a_bayer_head_is_planned_without_tdi_and_with_little_motion(rig: str) -> None:
    world = world_of(rig)
    plan, cone = world.plan, world.rig.cone("RGB")
    gsd_m = cone.sensors[0].pitch_um * 1e-3 * plan.height_above_ground_m / cone.lens.f_mm
    motion_px = plan.exposure_time_us["RGB"] * 1e-6 * plan.ground_speed_mps / gsd_m
    assert plan.tdi_shifts["RGB"] == 0 and 0.2 < motion_px < 0.501
    assert all(plan.tdi_shifts[name] >= 1 for name in ("0", "1", "N"))
