"""A block on both sides of the antimeridian is one small map with addresses of the world."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from daemon.onboard.live_orthomosaic.delivery import bounds_of
from daemon.onboard.live_orthomosaic.live_orthomosaic import LiveOrthomosaic
from daemon.onboard.live_orthomosaic.map_ground import PlaneGround
from daemon.onboard.live_orthomosaic.map_layout import tile_file, world_tile
from daemon.onboard.live_orthomosaic.placed_image import FOOTPRINT_MAX_PX, corners_in_map
from daemon.onboard.live_orthomosaic.tile_files import TileFiles
from daemon.orientation.local_frame import LocalFrame
from processing.image.orthoimage.ground_resampling import ImagePose
from processing.rig import find_rig

HEIGHT_M = 1000.0
IMAGE = replace(find_rig("ultracam-l-mini").virtual_image, width_px=600, height_px=400)


def map_at(folder: Path, longitude_deg: float) -> tuple[LiveOrthomosaic, set]:
    """Five images in a line to the east, the third one over a longitude; published addresses."""
    frame = LocalFrame(47.0, longitude_deg)
    ground = PlaneGround(47.0, longitude_deg, 0.0)
    live = LiveOrthomosaic(TileFiles(folder, 0), IMAGE, frame, ground)
    pixels = np.random.default_rng(2).integers(5000, 9000, (IMAGE.height_px, IMAGE.width_px))
    width_m = HEIGHT_M * IMAGE.width_px * IMAGE.pitch_mm / IMAGE.f_mm
    published = set()
    for k in range(5):
        one = SimpleNamespace(
            image=SimpleNamespace(number=k + 1), source="window", rotation=np.eye(3),
            position_m=np.array([0.4 * width_m * (k - 2), 0.0, HEIGHT_M]),
        )  # fmt: skip
        published |= {tile.tile for tile in live.add(one, pixels.astype(np.uint16))}
    return live, published


@pytest.mark.parametrize("longitude_deg", [180.0, -179.999999, 179.999999])
def test_images_on_both_sides_make_one_map(tmp_path: Path, longitude_deg: float) -> None:
    usual, _ = map_at(tmp_path / "usual", 16.0)
    live, published = map_at(tmp_path / "there", longitude_deg)
    assert not live.not_placed and len(live.images) == 5
    columns = [tile[1] for tile in live.tiles]
    # Tiles are cut elsewhere: by one column more or less.
    assert abs(len(set(columns)) - len({tile[1] for tile in usual.tiles})) <= 1
    assert max(columns) - min(columns) == len(set(columns)) - 1
    count = 1 << live.zoom
    assert all(0 <= x < 1 << zoom for zoom, x, _ in published)
    finest = {x for zoom, x, _ in published if zoom == live.zoom}
    assert {0, count - 1} <= finest
    assert all(tile_file(live.files.folder, tile).exists() for tile in published)
    west, _, east, _ = bounds_of(live.tiles)
    assert (west, east) == (-180.0, 180.0)
    assert bounds_of(usual.tiles)[0] > 15.9


def test_addresses_begin_again_beyond_the_antimeridian() -> None:
    assert world_tile((3, 8, 2)) == (3, 0, 2) and world_tile((3, -1, 2)) == (3, 7, 2)
    assert world_tile((3, 7, 2)) == (3, 7, 2)


def test_a_plane_is_level_across_the_antimeridian() -> None:
    ground = PlaneGround(0.0, 179.9, 100.0, (0.0, 10.0))
    heights = ground.heights_m(np.zeros(3), np.array([179.9, -179.9, 180.1]))
    assert heights == pytest.approx([100.0, 102.0, 102.0])


def test_a_footprint_beyond_the_memory_is_not_placed() -> None:
    frame = LocalFrame(47.0, 10.0)
    pose = ImagePose(100.0, 0.01, 6000, 4000, np.array([0.0, 0.0, 1000.0]), np.eye(3))
    near = corners_in_map(pose, 0.0, frame, 18)
    assert near is not None and np.prod(np.ptp(near, axis=0)) < FOOTPRINT_MAX_PX
    high = replace(pose, centre_m=np.array([0.0, 0.0, 30_000.0]))
    assert corners_in_map(high, 0.0, frame, 20) is None
