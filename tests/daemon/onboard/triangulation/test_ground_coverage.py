"""Areas that a flown block covers, against the true camera over the true terrain."""

from __future__ import annotations

import numpy as np
import pytest

from daemon.mission.layout import Mission
from daemon.onboard.triangulation.ground_coverage import coverage_of
from daemon.onboard.triangulation.live_record import write_live
from daemon.onboard.triangulation.mission_triangulation import MissionTriangulation
from daemon.orientation.exterior_orientation import sealed_exposures
from processing.geometry.rotation import rotations_from_vectors
from sim_hw.world import true_camera

EXPOSURES = (1, 2, 3, 4)
SAMPLES = 12_000


@pytest.fixture(scope="module")
def done(flown) -> MissionTriangulation:
    folder = Mission.open(flown.mission)
    result = MissionTriangulation(folder)
    read = sealed_exposures(folder).results
    for number in EXPOSURES:
        result.add(read[number])
    result.land()
    return result


def test_areas_are_those_of_the_true_camera(flown, done) -> None:
    random, world = np.random.default_rng(1), flown.world
    poses = [flown.flight.pose(flown.marks[number - 1]) for number in EXPOSURES]
    middle = np.array([pose.position_enu_m[:2] for pose in poses])
    low, high = middle.min(axis=0) - 300.0, middle.max(axis=0) + 300.0
    xy = random.uniform(low, high, (SAMPLES, 2))
    ground = np.column_stack([xy, world.terrain.height_m(xy[:, 0], xy[:, 1])])
    seen = np.zeros(SAMPLES, int)
    for pose in poses:
        column, row = true_camera.ideal_pixels(ground, world.rig, pose)
        image = world.image
        seen += (np.abs(column - (image.width_px - 1) / 2) < image.width_px / 2) & (
            np.abs(row - (image.height_px - 1) / 2) < image.height_px / 2
        )
    area = float(np.prod(high - low))
    found = coverage_of(done.live)
    for least, value in enumerate((found.once_m2, found.twice_m2, found.thrice_m2), 1):
        assert value == pytest.approx(area * (seen >= least).mean(), rel=0.04)
    assert found.left_out == 0
    write_live(done)
    page = (done.folder / "report.html").read_text()
    assert f"{found.once_m2 / 1e6:.3f} km" in page


def test_an_image_that_looks_at_the_horizon_does_not_count(done) -> None:
    before, live = coverage_of(done.live), done.live
    kept = live.orientations[0]
    turn = rotations_from_vectors(np.array([[np.radians(75.0), 0.0, 0.0]]))[0]
    live.orientations[0] = type(kept)(
        kept.image, kept.position_m, kept.rotation @ turn, kept.covariance, kept.source, kept.ties
    )
    try:
        found = coverage_of(live)
    finally:
        live.orientations[0] = kept
    assert found.left_out == 1 and found.once_m2 < before.once_m2


def test_there_is_no_coverage_before_an_adjustment(flown) -> None:
    folder = Mission.open(flown.mission)
    result = MissionTriangulation(folder)
    result.add(sealed_exposures(folder).results[1])
    assert coverage_of(result.live) is None
