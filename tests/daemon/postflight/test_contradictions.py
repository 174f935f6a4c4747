"""A wrong orientation, control point, unit or blunder is named, and what its correction gives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daemon.postflight.adjustment.cautions import cautions_of
from daemon.postflight.adjustment.contradictions import (
    contradicting_control,
    contradicting_orientations,
    planted_blunders,
)
from daemon.postflight.adjustment.given_projections import degrees_for_metres, turned_attitudes
from daemon.postflight.adjustment.likely_mistakes import control_sentences, likely_mistakes
from processing.bundle.adjust import AdjustmentSettings, adjust
from processing.bundle.adjustment_results import PointDifferences, check_point_differences
from processing.bundle.network import ImagePoints, Network
from processing.bundle.rank_diagnosis import RankDefectError
from tests.processing.bundle.plain_block import axes, plain_block


def _held(network: Network) -> Network:
    (camera,) = network.cameras
    return replace(network, cameras=(replace(camera, free=frozenset()),))


@pytest.fixture(scope="module")
def block() -> Network:
    """Eight images of 160 points on 40 m of relief, seven control points."""
    return _held(plain_block(3, points=160, relief_m=40.0))


def _control(block: Network) -> np.ndarray:
    return np.flatnonzero(np.isfinite(block.points.sigma_m).all(axis=1))


def _with_control(block: Network, change: np.ndarray) -> Network:
    xyz = block.points.xyz_m.copy()
    xyz[_control(block)] += change
    return replace(block, points=replace(block.points, xyz_m=xyz))


def test_a_good_block_has_neither_contradictions_nor_cautions(block) -> None:
    result = adjust(block)
    nothing = check_point_differences(result, (), np.zeros((0, 3)), np.zeros((0, 3)))
    assert cautions_of(result, nothing) == []
    assert contradicting_orientations(block, 1.0) == []
    assert contradicting_control(block, None) == []
    assert planted_blunders(block, None) == []


def test_exchanged_images_are_named_with_their_distance(block) -> None:
    order = np.arange(8)
    order[[1, 5]] = 5, 1
    wrong = replace(
        block,
        stations=replace(block.stations, position_m=block.stations.position_m[order]),
        attitudes=replace(block.attitudes, rotation=block.attitudes.rotation[order]),
    )
    (sentence,) = contradicting_orientations(wrong, None)
    assert "i1 is 18" in sentence or "i5 is 18" in sentence or "i1 is 19" in sentence
    assert "are exchanged" in sentence and "leave them empty" in sentence
    assert "i0 " not in sentence


def test_positions_of_another_frame_are_one_sentence(block) -> None:
    moved = block.stations.position_m + np.array([300.0, 0.0, 200.0])
    wrong = replace(block, stations=replace(block.stations, position_m=moved))
    (sentence,) = contradicting_orientations(wrong, None)
    assert "half of the positions are 36" in sentence


def test_exchanged_control_points_without_orientation_are_named(block) -> None:
    known = _control(block)
    change = np.zeros((len(known), 3))
    change[0] = block.points.xyz_m[known[1]] - block.points.xyz_m[known[0]]
    change[1] = -change[0]
    (sentence,) = contradicting_control(_with_control(block, change), None)
    names = [block.points.names[k] for k in known]
    assert f"{names[0]} and {names[1]} are exchanged" in sentence or (
        f"{names[1]} and {names[0]} are exchanged" in sentence
    )
    assert names[2] not in sentence.split("(X, Y, Z")[0].split(": ")[1].replace(",", " ").split()


def test_a_control_point_off_is_named_with_its_error(block) -> None:
    known = _control(block)
    change = np.zeros((len(known), 3))
    change[2] = 20.0, -7.0, 3.0
    (sentence,) = contradicting_control(_with_control(block, change), None)
    own = sentence.split(": ")[1]
    assert own.startswith(f"{block.points.names[known[2]]} is off by ")
    x, y, z = (float(v) for v in own.split("off by ")[1].split(" m")[0].split(","))
    assert (x, y, z) == pytest.approx((20.0, -7.0, 3.0), abs=0.6)


def test_blunders_are_named_by_point_and_image(block) -> None:
    table = block.image_points
    xy = table.xy_mm.copy()
    rays = np.bincount(table.point, minlength=len(block.points.names))
    row = int(np.flatnonzero((rays[table.point] >= 4) & (table.image == 2))[3])
    xy[row, 0] += 0.25
    wrong = replace(block, image_points=replace(table, xy_mm=xy))
    (sentence,) = planted_blunders(wrong, None)
    assert f"without point {block.points.names[table.point[row]]} in image i2 sigma0" in sentence
    result = adjust(wrong)
    nothing = PointDifferences((), np.zeros((0, 3)), np.zeros((0, 3)), np.nan)
    cautions = " ".join(cautions_of(result, nothing))
    assert f"x of {block.points.names[table.point[row]]} in i2" in cautions
    tested = adjust(wrong, AdjustmentSettings(significance=0.05))
    assert cautions_of(tested, nothing) == []


@pytest.mark.parametrize(("factor", "words"), [(np.pi / 180.0, "radians"), (200.0 / 180.0, "gons")])
def test_angles_of_another_unit_are_named(block, factor, words) -> None:
    angles = np.array([[0.01, -0.02, 0.7 + 0.3 * k] for k in range(8)])
    kappa = angles[:, 2]
    network = replace(
        block,
        attitudes=replace(block.attitudes, rotation=np.array([axes(*a) for a in angles])),
    )
    # Image coordinates as these attitudes give them.
    table, images = network.image_points, network.images
    place = network.stations.position_m[images.station[table.image]]
    turned = network.attitudes.rotation[images.attitude[table.image]]
    ray = np.einsum("nji,nj->ni", turned, network.points.xyz_m[table.point] - place)
    xy = -50.0 * ray[:, :2] / ray[:, 2:]
    network = replace(network, image_points=replace(table, xy_mm=xy))
    read = np.array([axes(*(factor * a)) for a in angles])
    wrong = replace(network, attitudes=replace(network.attitudes, rotation=read))
    assert turned_attitudes(network) == [] and kappa.max() < 3.0
    (sentence,) = turned_attitudes(wrong)
    assert f"the attitudes are in {words}; degrees are right" in sentence


def test_geographic_degrees_are_named_and_a_facade_is_not(block) -> None:
    known = _control(block)
    xyz = block.points.xyz_m.copy()
    xyz[known, :2] = np.array([15.0, 47.0]) + xyz[known, :2] * 1e-5
    xyz[known, 2] += 400.0
    (sentence,) = degrees_for_metres(replace(block, points=replace(block.points, xyz_m=xyz)))[:1]
    assert "of the control points" in sentence and "degrees of longitude and latitude" in sentence
    xyz[known, :2] = np.linspace(0.0, 0.5, len(known))[:, None]
    xyz[known, 2] = np.linspace(0.0, 20.0, len(known))
    assert degrees_for_metres(replace(block, points=replace(block.points, xyz_m=xyz))) == []


def test_exposures_at_one_place_are_not_explained_by_units(block) -> None:
    position = np.tile(block.stations.position_m[0], (8, 1))
    position += np.random.default_rng(1).normal(0.0, 1e-3, position.shape)
    wrong = replace(block, stations=replace(block.stations, position_m=position))
    assert not any("feet" in one or "unit" in one for one in likely_mistakes(wrong, None))


def test_check_points_of_another_unit_are_a_caution(block) -> None:
    result = adjust(block)
    several = np.flatnonzero(~result.left_out)[60:64]
    names = [block.points.names[k] for k in several]
    right = result.state.points[several]
    small = np.full((4, 3), 1e-3)
    assert cautions_of(result, check_point_differences(result, names, right, small)) == []
    wrong = check_point_differences(result, names, right * 1000.0, small)
    (sentence,) = cautions_of(result, wrong)
    assert sentence.startswith("check points are off by more than predicted")
    # A single one at 30 of its standard deviations.
    moved = right.copy()
    moved[2, 1] += 30.0 * wrong.sigma_m[2, 1]
    (sentence,) = cautions_of(result, check_point_differences(result, names, moved, small))
    assert f"most {names[2]}: " in sentence and "in Y" in sentence


def test_control_on_one_line_is_named_and_nearly_so_a_caution(block) -> None:
    known = _control(block)
    sigma = block.points.sigma_m.copy()
    sigma[known[2:]] = np.nan
    two = replace(block, points=replace(block.points, sigma_m=sigma))
    with pytest.raises(RankDefectError) as error:
        adjust(two)
    (defect,) = error.value.rank_defects
    assert "a rotation of the whole block about a line through its control" in defect.sentence
    # Held to 60 m only by a third point.
    sigma[known[2]] = 60.0
    result = adjust(replace(block, points=replace(block.points, sigma_m=sigma)))
    nothing = PointDifferences((), np.zeros((0, 3)), np.zeros((0, 3)), np.nan)
    found = cautions_of(result, nothing)
    assert any("of 8 images are hardly determined" in one for one in found)


def test_control_without_image_points_is_one_sentence(block) -> None:
    known = np.isin(block.image_points.point, _control(block))
    table = block.image_points
    left = ImagePoints(
        table.image[~known], table.point[~known], table.xy_mm[~known], table.sigma_mm[~known]
    )
    network = replace(block, image_points=left)
    with pytest.raises(RankDefectError) as error:
        adjust(network)
    (sentence,) = control_sentences(network, error.value.rank_defects)
    assert sentence.startswith("none of the 7 control points (p")


def test_an_image_of_two_points_is_named(block) -> None:
    table = block.image_points
    rows = np.flatnonzero(table.image == 3)
    left = np.setdiff1d(np.arange(len(table.image)), rows[2:])
    few = ImagePoints(table.image[left], table.point[left], table.xy_mm[left], table.sigma_mm[left])
    network = replace(block, image_points=few)
    with pytest.raises(RankDefectError) as error:
        adjust(network)
    (sentence,) = control_sentences(network, error.value.rank_defects)
    assert sentence.startswith("1 images have less than three image points (i3), ")


def test_the_page_of_formats_lists_what_is_named() -> None:
    text = (Path(__file__).parents[3] / "docs/reference/formats.md").read_text("utf-8")
    for words in ("radians or gons", "exchanged images", "degrees of longitude and latitude"):
        assert words in text
