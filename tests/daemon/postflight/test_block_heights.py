"""The plan's height model predicts matches: its heights in the local frame of a block."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from daemon.orientation.georeference import Georeference
from daemon.orientation.local_frame import LocalFrame
from daemon.planning.relief import TerrainRelief
from daemon.postflight.triangulation import block_heights, matching_work
from daemon.postflight.triangulation.block_heights import heights_of, local_heights
from processing.geometry.rotation import rotation_matrix
from processing.geometry.terrain_rays import HeightModel
from processing.matching.block_matching import BlockMatching
from processing.rig import VirtualImage

FRAME = LocalFrame(47.0, 15.4)
GROUND_M = 400.0


@pytest.fixture(scope="module")
def relief() -> TerrainRelief:
    """A slope of 10 % to the east and 5 % to the south about the frame, in UTM zone 33."""
    system = Georeference("EPSG:32633")
    middle = system.place(47.0, 15.4, GROUND_M)
    side = np.arange(-6000.0, 6001.0, 50.0)
    heights = GROUND_M + 0.1 * side[None, :] + 0.05 * side[:, None]
    model = HeightModel(heights, middle.east_m - 6000.0, middle.north_m + 6000.0, 50.0, -50.0)
    return TerrainRelief(model, system, GROUND_M)


def test_heights_of_the_model_are_those_of_the_local_frame(relief) -> None:
    random = np.random.default_rng(2)
    places = np.column_stack([random.uniform(-3000, 3000, (40, 2)), np.zeros(40)])
    local = local_heights(relief, FRAME, places)
    for east, north, _ in places:
        height = float(local.at(np.array([[east, north]]))[0])
        ((latitude, longitude, above),) = FRAME.to_geodetic(np.array([[east, north, height]]))
        there = relief.system.place(float(latitude), float(longitude), float(above))
        model = float(relief.model.at(np.array([[there.east_m, there.north_m]]))[0])
        assert there.height_m == pytest.approx(model, abs=0.2)


def test_ground_beyond_the_model_is_that_of_the_plan(relief) -> None:
    local = local_heights(relief, FRAME, np.array([[-9000.0, 0.0], [9000.0, 0.0]]))
    height = float(local.at(np.array([[8500.0, 0.0]]))[0])
    ((_, _, above),) = FRAME.to_geodetic(np.array([[8500.0, 0.0, height]]))
    assert above == pytest.approx(GROUND_M, abs=0.5)
    assert len(local.height_m[0]) <= 600


def test_matching_works_with_the_heights_under_its_images(relief, monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(block_heights, "mount_of", lambda _mission: (None, None))
    monkeypatch.setattr(block_heights, "read_relief", lambda _plan: (relief, None))
    eo = SimpleNamespace(exposure=1, is_virtual=True, cone="")
    mission = SimpleNamespace(path=tmp_path, id="m")
    image = VirtualImage(1000, 800, 5.0, 50.0, 1)
    rotation = np.stack([np.eye(3), rotation_matrix(0.0, 0.7, 0.0)])
    station = np.array([[0.0, 0.0, 1400.0], [500.0, 0.0, 1400.0]])
    block = SimpleNamespace(
        mission=mission, oriented=(eo, eo), image=image, station_m=station, rotation=rotation,
        ground_m=GROUND_M, frame=FRAME,
    )  # fmt: skip
    heights = matching_work._work(block, BlockMatching()).heights
    assert heights is not None
    corners = [(-50.0, -40.0), (50.0, 40.0), (-340.0, 40.0), (-450.0, -40.0)]
    assert np.isfinite(heights.at(np.array(corners))).all()
    monkeypatch.setattr(block_heights, "read_relief", lambda _plan: (None, None))
    assert heights_of(block) is None
