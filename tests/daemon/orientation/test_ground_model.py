"""Height above the terrain by a height model: what the virtual image of converging heads gains."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest

from daemon.configuration.model import ConfigurationError, MountSection, PlanSection
from daemon.mission.exposure import Exposure, NavigationRecord
from daemon.onboard.preflight.service_file import load
from daemon.orientation.ground_model import GroundModel, ground_of
from daemon.products.exposure_conditions import conditions_of
from processing.geometry.conditions import Conditions
from processing.geometry.placement import nominal_placements, vip_mm_from_raw
from processing.geometry.virtual_camera import ground_plane
from processing.quality.report import Flag
from processing.rig import Rig, find_rig
from sim_hw.world.true_camera import BODY_FROM_CAMERA, true_camera

CRS = "EPSG:32633"
LATITUDE, LONGITUDE, HEIGHT_M = 47.07, 15.44, 1395.0
PLANNED_M, TERRAIN_M, SLOPE = 395.0, 545.0, 0.05
"""A hillside that rises to the north, its middle 150 m above what was planned."""


@pytest.fixture
def model(tmp_path: Path) -> Path:
    to_grid = pyproj.Transformer.from_crs("EPSG:4979", CRS, always_xy=True)
    east, north, _ = to_grid.transform(LONGITUDE, LATITUDE, HEIGHT_M)
    cells, cell = 60, 50.0
    rows = TERRAIN_M + SLOPE * ((cells - 1) / 2.0 - np.arange(cells)) * cell
    corner = f"xllcorner {east - cells * cell / 2}\nyllcorner {north - cells * cell / 2}\n"
    text = f"ncols {cells}\nnrows {cells}\n{corner}cellsize {cell}\n"
    path = tmp_path / "hill.asc"
    path.write_text(text + "\n".join(" ".join([f"{row:.3f}"] * cells) for row in rows))
    return path


def flown(**changed: object) -> NavigationRecord:
    there = NavigationRecord(
        receiver="gnss",
        gps_ns=0,
        method="interpolated",
        latitude_deg=LATITUDE,
        longitude_deg=LONGITUDE,
        height_m=HEIGHT_M,
        horizontal_sigma_m=0.02,
        vertical_sigma_m=0.03,
        velocity_ned_mps=(60.0, 0.0, 0.0),
        speed_sigma_mps=0.01,
        roll_rad=0.0,
        pitch_rad=0.0,
        heading_rad=0.0,
    )
    return replace(there, **changed)


def ground(rig: Rig, model: Path) -> GroundModel:
    plan = PlanSection(ground_height_m=PLANNED_M, elevation=model, elevation_crs=CRS)
    found = ground_of(rig, MountSection(), plan)
    assert found is not None
    return found


def seam_px(rig: Rig, height_m: float) -> float:
    """By how much two heads disagree in the virtual image about points of the true ground, RMS."""
    camera = true_camera(rig, 1, displaced_px={})
    conditions = Conditions(height_above_ground_m=height_m, roll_rad=0.0, pitch_rad=0.0)
    places = nominal_placements(rig, {}, {}, ground=ground_plane(rig, conditions))
    known = HEIGHT_M - TERRAIN_M
    errors = []
    for cone in rig.pan_cones:
        sensor = cone.sensors[0]
        c, r = (np.linspace(30, n - 31, 12) for n in (sensor.width_px, sensor.height_px))
        columns, rows = (axis.ravel() for axis in np.meshgrid(c, r))
        exact = replace(
            camera,
            place_error_mm=dict.fromkeys(camera.place_error_mm, (0.0, 0.0)),
            mounting_error_rad=dict.fromkeys(camera.mounting_error_rad, (0.0, 0.0, 0.0)),
        )
        level = {"sensor_c": sensor.calibration_c, "cone_c": cone.calibration_c}
        rays = exact.directions(cone, sensor, columns, rows, **level)
        # Camera axes are right, forward, up; bodies forward, right, down.
        stood = np.subtract(cone.position_mm, rig.image_position_mm) * 1e-3 @ BODY_FROM_CAMERA
        points = stood + rays * (-(known + stood[2]) / rays[:, 2])[:, None]
        image = rig.virtual_image
        assert image is not None
        ideal = -image.f_mm * points[:, :2] / points[:, 2:]
        put = vip_mm_from_raw(places[sensor.name], np.stack([columns, rows], axis=1))
        errors.append((put - ideal) / image.pitch_mm)
    every = np.concatenate(errors)
    return float(np.sqrt(np.mean(np.sum(every**2, axis=1))))


def test_the_height_is_that_above_the_mean_of_what_the_image_shows(model: Path) -> None:
    rig = find_rig("dmc-mini")
    level = ground(rig, model).height_above_m(flown())
    assert level == pytest.approx(HEIGHT_M - TERRAIN_M, abs=0.5)
    # Pitched up by five degrees it looks 75 m farther north, where the ground is higher.
    ahead = ground(rig, model).height_above_m(flown(pitch_rad=math.radians(5.0)))
    assert level - ahead == pytest.approx(SLOPE * 850.0 * math.tan(math.radians(5.0)), rel=0.2)


def test_beyond_the_model_and_without_attitude_it_is_not_queried(model: Path) -> None:
    known = ground(find_rig("dmc-mini"), model)
    assert known.height_above_m(flown(latitude_deg=48.0)) is None
    assert known.height_above_m(flown(roll_rad=None)) is None


def test_the_heads_agree_over_a_hill_the_plan_does_not_know(model: Path) -> None:
    rig = find_rig("dmc-mini")
    planned, by_model = HEIGHT_M - PLANNED_M, ground(rig, model).height_above_m(flown())
    assert by_model is not None
    # 60 mm from the middle at f 120 mm, 12 um: 0.6 px / (1/850 - 1/1000 m) of it.
    assert seam_px(rig, planned) == pytest.approx(0.6 * (1000 / 850 - 1), rel=0.2)
    assert seam_px(rig, by_model) < 0.002


def test_the_record_the_pipeline_reads_takes_the_models_height(model: Path) -> None:
    rig = find_rig("dmc-mini")
    plan = PlanSection(ground_height_m=PLANNED_M, elevation=model, elevation_crs=CRS)
    exposure = Exposure(1, navigation=flown())
    known = conditions_of(exposure, rig, plan, Flag(0), ground=ground(rig, model))
    assert known.height_above_ground_m == pytest.approx(HEIGHT_M - TERRAIN_M, abs=0.5)
    assert conditions_of(exposure, rig, plan, Flag(0)).height_above_ground_m == 1000.0


def test_a_model_without_its_system_and_one_that_is_not_there_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="elevation_crs"):
        PlanSection(elevation=tmp_path / "hill.asc")
    (tmp_path / "service.toml").write_text('[plan]\nelevation = "gone.asc"\nelevation_crs = "x"\n')
    with pytest.raises(ConfigurationError, match=r"plan.elevation is 'gone.asc'"):
        load(tmp_path / "service.toml")
