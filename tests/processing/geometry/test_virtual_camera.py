"""Four converging heads and the virtual camera between them, by exact geometry and drawn points."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.geometry.conditions import Conditions
from processing.geometry.placement import nominal_placements, vip_mm_from_raw
from processing.geometry.rotation import rotation_matrix
from processing.geometry.topology import corners, counts, overlaps
from processing.geometry.virtual_camera import GroundPlane, ground_plane, head_parallax_px
from processing.matching.tie_points import PAN_TO_COLOUR
from processing.mosaic.fixed_mosaic import fixed_mosaic
from processing.mosaic.free_mosaic import Mosaic, free_mosaic
from processing.mosaic.model import placement_at
from processing.mosaic.mounting import check_platform, platform_figures, verified_mosaic
from processing.mosaic.pan_only import pan_only_mosaic
from processing.quality.evaluation import evaluate
from processing.quality.figures import QualityFigures
from processing.quality.figures.stitching import PlatformFigures
from processing.quality.report import Flag
from processing.rig import Rig, find_rig
from tests.processing.synthetic import Truth, make_truth, tie_points_of

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def rig() -> Rig:
    return find_rig("dmc-mini")


def drawn(rig: Rig, seed: int, *, rotation_px: float = 1.0) -> tuple[Truth, Mosaic, Mosaic]:
    rng = np.random.default_rng(seed)
    truth = make_truth(rig, rng, layer_px=rotation_px)
    points = tie_points_of(truth, rng, without_kind=PAN_TO_COLOUR)
    return truth, pan_only_mosaic(rig, truth.start, points), free_mosaic(rig, truth.start, points)


def test_full_and_mini_have_the_same_topology() -> None:
    for name in ("dmc", "dmc-mini"):
        rig = find_rig(name)
        pairs = {(o.sensor_a, o.sensor_b) for o in overlaps(rig)}
        assert pairs == {("P1", "P2"), ("P3", "P4"), ("P1", "P3"), ("P2", "P4")}
        assert [corner.sensors for corner in corners(rig)] == [("P1", "P2", "P3", "P4")]
        strips = [min(o.rectangle.width_mm, o.rectangle.height_mm) for o in overlaps(rig)]
        assert min(strips) / 0.012 >= 128


def test_the_virtual_camera_stands_in_the_middle_of_the_four(rig: Rig) -> None:
    places = np.array([cone.position_mm for cone in rig.pan_cones])
    assert rig.master_cone is None and rig.has_virtual_camera
    assert rig.image_position_mm == pytest.approx(places.mean(axis=0))


def test_twelve_angles_are_sought_and_nine_can_be_determined(rig: Rig) -> None:
    _, mosaic, _ = drawn(rig, 1)
    assert len(mosaic.parameter_names) == 12 and mosaic.constraints == 3
    assert mosaic.rank == 9 and mosaic.constrained_rank == 12
    assert mosaic.redundancy == mosaic.observations - 12 + 3
    for axis in ("rotation_x", "rotation_y", "rotation_z"):
        total = sum(mosaic.value(f"{cone.name}.{axis}") for cone in rig.pan_cones)
        assert total == pytest.approx(0.0, abs=1e-15)


def test_green_adds_its_layer_to_the_angles(rig: Rig) -> None:
    rng = np.random.default_rng(2)
    truth = make_truth(rig, rng)
    mosaic = free_mosaic(rig, truth.start, tie_points_of(truth, rng))
    table = counts(rig)
    assert (table.parameters, table.constraints, table.unknowns) == (20, 3, 17)
    assert len(mosaic.parameter_names) == 20 and mosaic.rank == 17
    assert mosaic.constrained_rank == 20 and not mosaic.undetermined


def test_a_ray_meets_the_plane_where_a_drawing_states_it_does() -> None:
    """Ray by ray with points in space, against the homography the pixels are fetched by."""
    rig = find_rig("dmc")
    up = np.array([0.03, -0.05, 1.0])
    up /= np.linalg.norm(up)
    height_mm = 500e3
    plane = GroundPlane(height_mm * 1e-3, (float(up[0]), float(up[1]), float(up[2])))
    placements = nominal_placements(rig, {}, {}, ground=plane)
    for cone in rig.pan_cones:
        lens = dataclasses.replace(cone.lens, k1=0.0, k2=0.0, p1=0.0, p2=0.0)
        bare = dataclasses.replace(cone, lens=lens)
        sensor = cone.sensors[0]
        placement = dataclasses.replace(placements[sensor.name], cone=bare)
        raw = np.array([[0.0, 0.0], [sensor.width_px - 1.0, 100.0], [3000.0, 4000.0]])
        u = (raw - [(sensor.width_px - 1) / 2, (sensor.height_px - 1) / 2]) * [0.012, -0.012]
        c, s = math.cos(sensor.rotation_rad), math.sin(sensor.rotation_rad)
        x = sensor.x_mm + c * u[:, 0] - s * u[:, 1]
        y = sensor.y_mm + s * u[:, 0] + c * u[:, 1]
        rays = np.stack([x, y, np.full(3, -cone.lens.f_mm)], axis=1)
        rays = rays @ rotation_matrix(*cone.rotation_rad).T
        forward, right, _ = np.subtract(cone.position_mm, rig.image_position_mm)
        origin = np.array([right, forward, 0.0])
        reach = (-height_mm - origin @ up) / (rays @ up)
        ground = origin + rays * reach[:, None]
        seen = 120.0 * ground[:, :2] / -ground[:, 2:]
        start = dataclasses.replace(placement, similarity=placements[sensor.name].similarity)
        found = vip_mm_from_raw(start, raw)
        assert np.abs(found - seen).max() < 1e-4 * 0.012 + 5e-7 * np.abs(seen).max()


def test_level_flight_at_a_kilometre_moves_a_head_by_the_parallax_of_its_base() -> None:
    rig = find_rig("dmc")
    conditions = Conditions(height_above_ground_m=1000.0)
    plane = ground_plane(rig, conditions)
    assert plane == GroundPlane(1000.0, (0.0, 0.0, 1.0))
    middle = np.array([[3583.5, 2047.5]])
    far = vip_mm_from_raw(nominal_placements(rig, {}, {})["P1"], middle)
    near = vip_mm_from_raw(nominal_placements(rig, {}, {}, ground=plane)["P1"], middle)
    moved_px = (near - far)[0] / 0.012
    assert moved_px == pytest.approx([0.425, -0.425], abs=0.001)
    assert head_parallax_px(rig, conditions, 0.01) == pytest.approx(0.85 * math.sqrt(2) * 0.01)


def test_without_a_height_the_projection_centres_count_as_one(rig: Rig) -> None:
    assert ground_plane(rig, Conditions()) is None
    assert ground_plane(find_rig("ultracam-x"), Conditions(height_above_ground_m=500.0)) is None


def test_errors_of_the_nine_angles_are_as_large_as_stated(rig: Rig) -> None:
    squares, inside, worst, ranks = 0.0, [], 0.0, 0
    for seed in range(24):
        truth, mosaic, _ = drawn(rig, 100 + seed)
        error = mosaic.values - truth.values[:12]
        values, vectors = np.linalg.eigh(mosaic.covariance)
        known = values > 1e-6 * values[-1]
        squares += float(np.sum((vectors[:, known].T @ error) ** 2 / values[known]))
        ranks += int(known.sum())
        normalised = np.abs(error) / np.sqrt(np.diag(mosaic.covariance))
        inside.append(normalised < 3.0)
        worst = max(worst, float(normalised.max()))
    assert ranks == 9 * 24
    assert 0.7 < squares / ranks < 1.35
    assert np.mean(inside) > 0.98 and worst < 5.0


def with_rotated_heads(rig: Rig, rotations_rad: Array) -> Truth:
    """A platform whose heads are turned about x, y, z of the virtual image, (4, 3), and no more."""
    truth = make_truth(rig, np.random.default_rng(1), layer_px=0.0)
    values = truth.values.copy()
    for name, rotation in zip("1234", rotations_rad, strict=True):
        first = truth.model.mountings[name]
        values[first : first + 3] = rotation
    placements = {n: placement_at(truth.model, p, values) for n, p in truth.start.items()}
    return dataclasses.replace(truth, values=values, placements=placements)


def test_a_platform_as_calibrated_has_not_expired_and_a_rotated_head_has(rig: Rig) -> None:
    rng = np.random.default_rng(9)
    for _ in range(20):
        healthy = with_rotated_heads(rig, rng.normal(0.0, 20e-6, (4, 3)))
        points = tie_points_of(healthy, rng, without_kind=PAN_TO_COLOUR)
        check = check_platform(rig, free_mosaic(rig, healthy.start, points), points, {})
        assert check is not None and check.degrees_of_freedom == 9 and not check.is_expired
        assert not evaluate(QualityFigures(*platform_figures(check))).flags
    rotations = np.zeros((4, 3))
    rotations[1, 1] = 200e-6
    moved = with_rotated_heads(rig, rotations)
    points = tie_points_of(moved, rng, without_kind=PAN_TO_COLOUR)
    check = check_platform(rig, free_mosaic(rig, moved.start, points), points, {})
    assert check is not None and check.is_expired and check.farthest.cone == "2"
    # 200 urad at 120 mm are 2 px; a quarter of it goes into the mean of the four.
    figures = QualityFigures(*platform_figures(check))
    assert figures.of(PlatformFigures).platform_shift_px == pytest.approx(1.5, abs=0.08)
    report = evaluate(figures)
    assert report.flags == Flag.CALIBRATION_EXPIRED and "Head 2" in report.findings[0].sentence


def test_shifts_that_are_left_become_increments_of_the_angles(rig: Rig) -> None:
    """From angles that were never adjusted, verification alone comes most of the way."""
    rng = np.random.default_rng(4)
    rotations = rng.normal(0.0, 50e-6, (4, 3))
    rotations[:, 2] = 0.0
    truth = with_rotated_heads(rig, rotations)
    points = tie_points_of(truth, rng, sigma_pp_px=0.02, without_kind=PAN_TO_COLOUR)
    held = fixed_mosaic(rig, truth.start, points)
    loose = dataclasses.replace(held, outliers=np.zeros_like(held.outliers))
    verified = verified_mosaic(rig, loose, points)
    before, after = (float(np.sqrt(np.mean(m.residuals_px**2))) for m in (loose, verified))
    assert after < 0.1 * before
    done = verified_mosaic(rig, free_mosaic(rig, truth.start, points), points)
    check = check_platform(rig, done, points, {})
    assert check is not None
    assert max(math.hypot(*head.residual_px) for head in check.heads) < 0.02


def test_a_head_without_tie_points_stays_where_it_was_calibrated(rig: Rig) -> None:
    rng = np.random.default_rng(5)
    truth = make_truth(rig, rng)
    points = tie_points_of(truth, rng, without=("P4", "G"))
    mosaic = free_mosaic(rig, truth.start, points)
    assert {name.split(".")[0] for name in mosaic.undetermined} == {"4", "G"}
    assert all(mosaic.value(f"4.{axis}") == 0.0 for axis in ("rotation_x", "rotation_z"))
    check = check_platform(rig, mosaic, points, {})
    assert check is not None and [head.cone for head in check.heads] == ["1", "2", "3"]
