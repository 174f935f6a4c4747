"""Lever arms of the other sign, time offsets and other height systems are named as such."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from daemon.postflight.adjustment.cautions import cautions_of
from processing.bundle.adjust import adjust
from processing.bundle.adjustment_results import check_point_differences
from processing.bundle.network import Gnss, Network
from tests.processing.bundle.simulated_networks import aerial

LEVER = np.array([0.3, 0.1, 1.2])
ALONG = 5
PERIOD_S = 2.5
SPEED_MPS = 60.0


@pytest.fixture(scope="module")
def block() -> Network:
    """Three lines there and back at 60 m/s, antenna positions with a lever arm."""
    network = aerial(
        seed=5, lines=3, along=ALONG, points=150, sigma_mm=1e-3, gnss_sigma_m=0.05
    ).network
    given = network.gnss
    rotation = network.attitudes.rotation[given.attitude]
    moved = given.position_m + rotation @ LEVER - np.einsum("nij,nj->ni", rotation, given.lever_m)
    every = np.arange(len(moved))
    line, place = every // ALONG, every % ALONG
    flown = np.where(line % 2 == 0, place, ALONG - 1 - place)
    return replace(
        network,
        gnss=replace(
            given,
            position_m=moved,
            lever_m=np.tile(LEVER, (len(moved), 1)),
            line=line,
            time_s=100.0 * line + PERIOD_S * flown,
            lines=("a", "b", "c"),
        ),
    )


def antenna_sentences(network: Network) -> list[str]:
    result = adjust(network)
    nothing = np.zeros((0, 3))
    cautions = cautions_of(result, check_point_differences(result, [], nothing, nothing))
    return [one for one in cautions if one.startswith("antenna positions contradict")]


def with_gnss(block: Network, **changes: object) -> Network:
    gnss: Gnss = replace(block.gnss, **changes)
    return replace(block, gnss=gnss)


def test_a_good_block_names_no_effect(block) -> None:
    assert antenna_sentences(block) == []


def test_a_lever_arm_of_the_other_sign_is_named(block) -> None:
    (sentence,) = antenna_sentences(with_gnss(block, lever_m=-block.gnss.lever_m))
    assert "a lever arm of the other sign (it is off by +0.6" in sentence
    assert "+2.4" in sentence or "+2.3" in sentence
    assert "height system" not in sentence


def test_a_wrong_lever_arm_is_named_with_what_it_is_off_by(block) -> None:
    wrong = np.array([0.4, -0.5, 0.0])
    (sentence,) = antenna_sentences(with_gnss(block, lever_m=block.gnss.lever_m + wrong))
    listed = re.search(r"lever arm that is off by (\S+), (\S+), (\S+) m in the rig", sentence)
    assert listed is not None
    assert np.allclose([float(v) for v in listed.groups()], -wrong, atol=0.08)


@pytest.mark.parametrize("offset_ms", [20.0, -20.0])
def test_positions_of_another_instant_are_named_next_to_the_lever_arm_they_look_like(
    block, offset_ms
) -> None:
    ahead = np.where(block.gnss.line % 2 == 0, 1.0, -1.0) * SPEED_MPS * offset_ms * 1e-3
    moved = block.gnss.position_m + np.column_stack([ahead, 0 * ahead, 0 * ahead])
    (sentence,) = antenna_sentences(with_gnss(block, position_m=moved))
    found = float(sentence.split("positions of an instant ")[1].split(" ms")[0])
    assert found == pytest.approx(offset_ms, abs=2.0)
    assert "a lever arm that is off by" in sentence and "common shift" not in sentence


def test_control_of_another_height_system_is_named(block) -> None:
    points = block.points
    control = np.isfinite(points.sigma_m[:, 0])
    xyz = points.xyz_m + np.where(control[:, None], [0.0, 0.0, 0.5], 0.0)
    (sentence,) = antenna_sentences(replace(block, points=replace(points, xyz_m=xyz)))
    assert "a common shift of" in sentence and "-0.5" in sentence
    assert "another height system" in sentence


def test_blunders_are_no_antenna_effect(block) -> None:
    table = block.image_points
    xy = table.xy_mm.copy()
    xy[40] += 0.02
    assert antenna_sentences(replace(block, image_points=replace(table, xy_mm=xy))) == []
