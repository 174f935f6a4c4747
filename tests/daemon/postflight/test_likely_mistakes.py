"""What explains a bad block is named: attitudes, principal distance, control, separate blocks."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.postflight.adjustment.likely_mistakes import control_sentences, likely_mistakes
from daemon.postflight.adjustment.project import CheckPoints
from daemon.postflight.adjustment.project_file import AdjustSection, CameraSection, ProjectFile
from daemon.postflight.adjustment.project_writer import write_project
from daemon.postflight.adjustment.separate_blocks import separate_blocks
from processing.bundle.adjust import adjust
from processing.bundle.network import (
    Attitudes,
    Distances,
    ImagePoints,
    Images,
    Network,
    Points,
    Stations,
)
from processing.bundle.rank_diagnosis import RankDefectError
from processing.geometry.rotation import rotation_matrix
from tests.processing.bundle.simulated_networks import aerial

HALF = np.pi


@pytest.fixture(scope="module")
def block() -> Network:
    """Eight images of 40 points, 1 um, starting values 1 m and 1 mrad off."""
    return aerial(seed=3, sigma_mm=1e-3, points=40).network


def _turned(block: Network, angles: tuple[float, float, float], images: list[int]) -> Network:
    rotation = block.attitudes.rotation.copy()
    rotation[images] = rotation[images] @ rotation_matrix(*angles)
    return replace(block, attitudes=replace(block.attitudes, rotation=rotation))


@pytest.mark.parametrize(
    ("angles", "words"),
    [
        ((0.0, 0.0, HALF), "180 degrees about the camera's z axis"),
        ((HALF, 0.0, 0.0), "180 degrees about the camera's x axis"),
        ((0.0, HALF, 0.0), "180 degrees about the camera's y axis"),
        ((0.0, 0.0, HALF / 2), "by -90 degrees about the camera's z axis"),
    ],
)
def test_turned_attitudes_are_named_for_the_block_and_for_one_image(block, angles, words) -> None:
    (whole,) = likely_mistakes(_turned(block, angles, list(range(8))), None)
    assert whole.startswith("the attitudes are turned") and words in whole
    (one,) = likely_mistakes(_turned(block, angles, [2]), None)
    assert one.startswith("the attitude of image 2-0 is turned") and words in one


def test_inverse_attitudes_are_named() -> None:
    block = aerial(seed=3, sigma_mm=1e-3, points=40, tilt_rad=0.3).network
    rotation = np.swapaxes(block.attitudes.rotation, 1, 2)
    wrong = replace(block, attitudes=replace(block.attitudes, rotation=rotation))
    (sentence,) = likely_mistakes(wrong, None)
    assert "camera to object is right" in sentence


@pytest.mark.parametrize("factor", [5.0, 0.2, 1.4])
def test_a_wrong_principal_distance_is_named_with_the_estimated_one(block, factor) -> None:
    camera = replace(block.cameras[0], f_mm=70.0 * factor)
    (sentence,) = likely_mistakes(replace(block, cameras=(camera,)), 50.0)
    found = re.match(r"the principal distance is wrong: estimated, it is ([\d.]+) mm", sentence)
    # This block determines it to 0.13 mm.
    assert found and float(found.group(1)) == pytest.approx(70.0, abs=0.4)
    assert f"(f_mm {70.0 * factor:g})" in sentence


def test_exchanged_control_points_are_named(block) -> None:
    xyz = block.points.xyz_m.copy()
    xyz[[0, 3]] = xyz[[3, 0]]
    wrong = replace(block, points=replace(block.points, xyz_m=xyz))
    (sentence,) = likely_mistakes(wrong, 1000.0)
    assert "p0 by " in sentence and "p3 by " in sentence and "exchanged" in sentence
    assert "p1 by " not in sentence


def test_a_control_point_20_m_off_is_named(block) -> None:
    xyz = block.points.xyz_m.copy()
    xyz[4, 0] += 20.0
    wrong = replace(block, points=replace(block.points, xyz_m=xyz))
    (sentence,) = likely_mistakes(wrong, 50.0)
    assert "but p4 by " in sentence and "exchanged" not in sentence


@pytest.fixture(scope="module")
def with_positions() -> Network:
    """The block with antenna positions of 5 cm and a distance."""
    simulated = aerial(seed=3, sigma_mm=1e-3, points=40, gnss_sigma_m=0.05)
    length = float(np.linalg.norm(simulated.points[10] - simulated.points[11]))
    distances = Distances(np.array([10]), np.array([11]), np.array([length]), np.array([0.01]))
    return replace(simulated.network, distances=distances)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda xyz: xyz + np.array([0.0, 0.0, 47.0]), "ellipsoidal heights"),
        (lambda xyz: xyz[:, [1, 0, 2]], "X and Y exchanged"),
        (lambda xyz: xyz / 0.3048, "unit another one"),
    ],
)
def test_antenna_positions_that_contradict_are_named_with_their_offset(
    with_positions, change, words
) -> None:
    gnss = with_positions.gnss
    wrong = replace(with_positions, gnss=replace(gnss, position_m=change(gnss.position_m)))
    (sentence,) = likely_mistakes(wrong, 100.0)
    assert sentence.startswith("antenna positions contradict") and words in sentence
    if "ellipsoidal" in words:
        assert ", 47 m off in X, Y, Z" in sentence


def test_a_distance_that_contradicts_is_named_with_the_adjusted_one(with_positions) -> None:
    given = with_positions.distances
    wrong = replace(with_positions, distances=replace(given, distance_m=10.0 * given.distance_m))
    (sentence,) = likely_mistakes(wrong, 300.0)
    length = float(given.distance_m[0])
    assert "p10 to p11 is given as" in sentence
    assert float(sentence.split("adjusted to ")[1].split()[0]) == pytest.approx(length, abs=0.3)


def test_a_good_block_has_no_likely_mistake(block) -> None:
    assert likely_mistakes(block, 1.0) == []


def _with_second(block: Network, *, control: bool) -> Network:
    """The block and a copy of it 1 km away, without a common object point."""
    both = np.concatenate
    aside = np.array([1000.0, 0.0, 0.0])
    stations, attitudes, images, points = (
        block.stations, block.attitudes, block.images, block.points
    )  # fmt: skip
    n, p, table = len(stations.names), len(points.names), block.image_points
    sigma = points.sigma_m if control else np.full_like(points.sigma_m, np.nan)

    def named(names: tuple[str, ...]) -> tuple[str, ...]:
        return (*names, *(f"B{name}" for name in names))

    return replace(
        block,
        stations=Stations(
            named(stations.names),
            both([stations.position_m, stations.position_m + aside]),
            np.tile(stations.fixed, 2),
        ),
        attitudes=Attitudes(
            named(attitudes.names),
            both([attitudes.rotation] * 2),
            np.tile(attitudes.fixed, 2),
        ),
        images=Images(
            named(images.names),
            both([images.station, images.station + n]),
            both([images.attitude, images.attitude + n]),
            np.tile(images.camera, 2),
            np.tile(images.head, 2),
        ),
        points=Points(
            named(points.names),
            both([points.xyz_m, points.xyz_m + aside]),
            both([points.sigma_m, sigma]),
            np.tile(points.at_infinity, 2),
        ),
        image_points=ImagePoints(
            both([table.image, table.image + n]),
            both([table.point, table.point + p]),
            np.tile(table.xy_mm, (2, 1)),
            np.tile(table.sigma_mm, (2, 1)),
        ),
    )


def test_a_block_that_no_point_connects_is_one_sentence(block) -> None:
    network = _with_second(block, control=False)
    assert [len(group) for group in separate_blocks(network)] == [8, 8]
    assert [len(group) for group in separate_blocks(block)] == [8]
    with pytest.raises(RankDefectError) as caught:
        adjust(network)
    (sentence,) = control_sentences(network, caught.value.rank_defects)
    assert sentence.startswith("8 of 16 images (B0-0, B1-0,")
    assert "no object point in common" in sentence


def _report(folder: Path, network: Network) -> dict[str, list[str]]:
    nothing = np.zeros((0, 3))
    file = ProjectFile(
        format=1, name="b", adjust=AdjustSection(), camera=(CameraSection(name="c", f_mm=70.0),)
    )
    write_project(folder, file, network, CheckPoints((), nothing, nothing))
    outcome = CliRunner().invoke(app, ["adjust", str(folder), "--json"])
    assert outcome.exit_code == 0, outcome.output
    report: dict[str, list[str]] = json.loads(outcome.stdout)
    return report


def test_two_blocks_with_control_are_adjusted_with_a_caution(block, tmp_path) -> None:
    (caution,) = _report(tmp_path / "b", _with_second(block, control=True))["cautions"]
    assert "2 blocks that no object point connects (8, 8 images)" in caution


def test_images_at_one_place_are_a_caution_with_the_points_left_out(block, tmp_path) -> None:
    station = block.stations.position_m.copy()
    station[:] = station[0]
    network = replace(block, stations=replace(block.stations, position_m=station))
    (caution,) = _report(tmp_path / "b", network)["cautions"]
    assert caution.startswith("31 of 39 object points in two or more images are left out")


def test_exposures_without_image_points_need_no_starting_value(block, tmp_path) -> None:
    table = block.image_points
    own = table.image < 4
    station, rotation = block.stations.position_m.copy(), block.attitudes.rotation.copy()
    station[4:], rotation[4:] = np.nan, np.nan
    network = replace(
        block,
        stations=replace(block.stations, position_m=station),
        attitudes=replace(block.attitudes, rotation=rotation),
        image_points=ImagePoints(
            table.image[own], table.point[own], table.xy_mm[own], table.sigma_mm[own]
        ),
    )
    report = _report(tmp_path / "b", network)
    assert report["images"] == 4
