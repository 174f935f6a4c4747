"""Patterns of stitching from an exposure's record into a block and its project."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from daemon.mission.layout import Mission
from daemon.postflight.adjustment.csv_tables import ProjectError
from daemon.postflight.adjustment.project import CheckPoints, read_project
from daemon.postflight.adjustment.project_file import CameraSection, ProjectFile
from daemon.postflight.adjustment.project_writer import write_project
from daemon.postflight.triangulation.stitching_of_exposures import stitching_patterns_of
from processing.bundle.adjust import adjust
from processing.bundle.frame_patterns import FramePatterns
from processing.bundle.initial_values import completed
from processing.mosaic.stitching_patterns import PATTERNS_KEY, patterns_json
from tests.processing.bundle.simulated_networks import PARTS, aerial

NO_CHECKS = CheckPoints((), np.zeros((0, 3)), np.zeros((0, 3)))


def _patterns(count: int) -> FramePatterns:
    coefficients = np.random.default_rng(count).normal(0.0, 1e-3, (count, 2, 6, 2))
    return FramePatterns(PARTS, coefficients, 30.0, 0.995)


def test_a_project_holds_patterns_and_adjusts_the_same(tmp_path: Path) -> None:
    block = aerial(sigma_mm=1e-3)
    images = len(block.network.images.names)
    patterns = tuple(None if k == 1 else _patterns(1 + k % 2) for k in range(images))
    network = replace(block.network, patterns=patterns)
    file = ProjectFile(format=1, name="p", camera=(CameraSection(name="c", f_mm=70.0),))
    write_project(tmp_path / "p", file, network, NO_CHECKS)
    back = read_project(tmp_path / "p" / "project.toml")
    plain, read = adjust(network), adjust(completed(back.network), back.settings)
    assert read.sigma0 == pytest.approx(plain.sigma0, rel=1e-5)
    assert [u.name for u in read.layout.unknowns] == [u.name for u in plain.layout.unknowns]
    for content, cause in (
        ({"images": {"nowhere": {}}}, "nowhere"),
        ({"images": {block.network.images.names[0]: {"parts": []}}}, "coefficients"),
        ([], "syntopic triangulate"),
    ):
        (tmp_path / "p/patterns.json").write_text(json.dumps(content))
        with pytest.raises(ProjectError, match=cause):
            read_project(tmp_path / "p" / "project.toml")


def test_patterns_of_exposures_are_those_of_their_records(tmp_path: Path) -> None:
    mission = Mission(tmp_path, "m")
    records = {
        1: {PATTERNS_KEY: patterns_json(_patterns(3))},
        2: {"format": 1},
        3: {PATTERNS_KEY: patterns_json(_patterns(9))},
    }
    for number, record in records.items():
        mission.level2(number).mkdir(parents=True)
        (mission.level2(number) / "mosaic.json").write_text(json.dumps(record))
    mission.level2(4).mkdir(parents=True)
    (mission.level2(4) / "mosaic.json").write_text("{")
    oriented = tuple(
        SimpleNamespace(exposure=number, is_virtual=number != 6) for number in (1, 2, 3, 4, 5, 6)
    )
    found = stitching_patterns_of(mission, oriented)
    assert [None if one is None else one.count for one in found] == [3, *[None] * 5]
    assert found[0].coefficients == pytest.approx(_patterns(3).coefficients, rel=1e-6)
    # Without any, a block has no such unknowns.
    assert stitching_patterns_of(mission, oriented[1:]) == ()
