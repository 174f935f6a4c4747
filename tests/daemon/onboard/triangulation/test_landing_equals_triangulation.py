"""The last adjustment in flight against `syntopic triangulate` with the same tie points."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from daemon.mission.layout import Mission
from daemon.onboard.triangulation.mission_triangulation import MissionTriangulation
from daemon.orientation.exterior_orientation import sealed_exposures
from daemon.postflight.triangulation.triangulation import (
    TriangulationSettings,
    block_of,
    project_of,
    weight_by_residuals,
)
from processing.bundle.adjust import Adjustment, adjust
from processing.bundle.camera_orientations import camera_orientations
from processing.bundle.frame_patterns import FramePatterns
from processing.bundle.initial_values import completed
from processing.bundle.self_calibration import parts_of
from processing.geometry.rotation import vectors_from_rotations
from processing.matching.block_matching import BlockTiePoints
from processing.mosaic.stitching_patterns import PATTERNS_KEY, patterns_json
from processing.rig import Rig, load_rig
from tests.daemon.flown_block import FlownBlock, write_navigation

WITHIN_SIGMAS = 0.1


def _landed(mission: Path) -> MissionTriangulation:
    folder = Mission.open(mission)
    done = MissionTriangulation(folder)
    read = sealed_exposures(folder).results
    for number in sorted(read):
        done.add(read[number])
    done.land()
    return done


def _tie_points(done: MissionTriangulation) -> BlockTiePoints:
    """All tie points of the last adjustment in flight, those it left out among them."""
    table = done.live.last.result.network.image_points
    image, pitch = done.live.image, done.live.image.pitch_mm
    middle = np.array([image.width_px - 1, image.height_px - 1]) / 2.0
    px = table.xy_mm / pitch * [1.0, -1.0] + middle
    return BlockTiePoints(table.image, table.point, px, int(table.point.max()) + 1, {}, {})


def _triangulated(
    flown: FlownBlock, mission: Path, tied: BlockTiePoints, *, patterns: bool = True
) -> tuple[Adjustment, object]:
    """As `syntopic triangulate` adjusts a block."""
    block = block_of(Mission.open(mission), trajectory_file=write_navigation(flown))
    settings = TriangulationSettings(patterns=patterns)
    project = weight_by_residuals(project_of(block, tied, settings), tied.points)
    return adjust(completed(project.network), project.settings), block.frame


def _largest_difference(done: MissionTriangulation, other: Adjustment, frame: object) -> float:
    """Of positions and attitudes, in standard deviations of the triangulation."""
    cameras = camera_orientations(other)
    sigma = np.sqrt(np.einsum("nii->ni", cameras.covariances()))
    between = done.frame.local_from_enu(frame.latitude_deg, frame.longitude_deg)
    largest = 0.0
    for k, one in enumerate(done.live.orientations):
        there = frame.to_geodetic(cameras.station_m[k : k + 1])
        step = one.position_m - done.frame.from_geodetic(*there.T)[0]
        turn = (between @ cameras.rotation[k]).T @ one.rotation
        error = np.concatenate([step, vectors_from_rotations(turn[None])[0]])
        largest = max(largest, float(np.abs(error / sigma[k]).max()))
    return largest


def test_landing_gives_what_the_triangulation_gives_from_the_same_tie_points(flown) -> None:
    done = _landed(flown.mission)
    other, frame = _triangulated(flown, flown.mission, _tie_points(done))
    assert _largest_difference(done, other, frame) < WITHIN_SIGMAS
    assert done.live.last.sigma0 == pytest.approx(other.sigma0, rel=0.02)
    own = np.sqrt(np.einsum("nii->ni", done.live.last.cameras.covariances()))
    there = np.sqrt(np.einsum("nii->ni", camera_orientations(other).covariances()))
    assert own == pytest.approx(there, rel=0.1)


def test_patterns_of_stitching_are_unknowns_in_flight_as_after_landing(flown, tmp_path) -> None:
    mission = tmp_path / "mission"
    shutil.copytree(flown.mission, mission)
    rig = load_rig(mission / "rig.toml")
    for number in Mission.open(mission).numbers():
        record = {PATTERNS_KEY: patterns_json(_patterns(rig, number))}
        (mission / f"L2/{number:06d}/mosaic.json").write_text(json.dumps(record))
    done = _landed(mission)
    layout = done.live.last.result.layout
    assert layout.pattern.shape[1] == 2
    tied = _tie_points(done)
    other, frame = _triangulated(flown, mission, tied)
    assert other.layout.columns == layout.columns
    assert _largest_difference(done, other, frame) < WITHIN_SIGMAS
    plain, _ = _triangulated(flown, mission, tied, patterns=False)
    assert _largest_difference(done, plain, frame) > WITHIN_SIGMAS


def _patterns(rig: Rig, seed: int) -> FramePatterns:
    parts = parts_of(rig)
    shape = np.random.default_rng(seed).normal(0.0, 2e-4, (2, len(parts), 6, 2))
    return FramePatterns(parts, shape, 5.0, 0.99)
