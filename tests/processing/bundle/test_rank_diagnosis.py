"""What cannot be determined is named, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from processing.bundle.adjust import AdjustmentSettings, adjust
from processing.bundle.network import CameraModel, HeadMounting
from processing.bundle.rank_diagnosis import RankDefectError
from tests.processing.bundle.simulated_networks import aerial, rotation_of


def _without_control(**more):
    simulated = aerial(control=0, **more)
    return simulated, simulated.network


def test_a_block_without_control_is_missing_seven_datum_parameters() -> None:
    _, network = _without_control()
    with pytest.raises(RankDefectError) as caught:
        adjust(network)
    sentences = [defect.sentence for defect in caught.value.rank_defects]
    assert len(sentences) == 7
    for what in (
        "position in X", "position in Y", "height", "tilt about X", "tilt about Y",
        "rotation about Z", "scale",
    ):  # fmt: skip
        assert any(s.startswith(what) for s in sentences), what


def test_a_free_network_is_adjusted_with_the_shortest_correction() -> None:
    simulated, network = _without_control(sigma_mm=1e-3)
    result = adjust(network, AdjustmentSettings(minimum_norm=True))
    assert len(result.rank_defects) == 7
    assert result.sigma0 == pytest.approx(1.0, abs=0.2)
    controlled = adjust(
        aerial(sigma_mm=1e-3, control=0).network, AdjustmentSettings(minimum_norm=True)
    )
    assert controlled.sigma0 == pytest.approx(result.sigma0, rel=1e-9)
    assert np.isfinite(simulated.points).all()


def test_a_free_network_that_has_full_rank_is_the_controlled_one() -> None:
    network = aerial(sigma_mm=1e-3).network
    plain, free = adjust(network), adjust(network, AdjustmentSettings(minimum_norm=True))
    assert free.rank_defects == ()
    assert free.redundancy == plain.redundancy
    assert np.abs(free.state.station - plain.state.station).max() < 1e-7
    assert np.allclose(free.cofactor, plain.cofactor, rtol=1e-6, atol=1e-15)


def test_one_height_control_point_too_few_leaves_one_tilt() -> None:
    simulated = aerial(control=0, lines=1, along=5)
    sigma = simulated.network.points.sigma_m.copy()
    sigma[:2] = 0.02
    network = replace(simulated.network, points=replace(simulated.network.points, sigma_m=sigma))
    with pytest.raises(RankDefectError) as caught:
        adjust(network)
    assert len(caught.value.rank_defects) == 1
    shares = dict(caught.value.rank_defects[0].shares)
    assert any("station" in phrase for phrase in shares)
    sentence = caught.value.rank_defects[0].sentence
    assert "of the whole block about a line through its control cannot be determined" in sentence


def test_principal_distance_and_height_over_flat_ground_are_named_together() -> None:
    free = CameraModel("c", 70.0, free=frozenset({"df"}))
    simulated = aerial(
        cameras=(free,), relief_m=0.0, control=60, control_sigma_m=1e-9, disturb=0.0, tilt_rad=0.0
    )
    network = replace(
        simulated.network,
        points=replace(simulated.network.points, xyz_m=simulated.points, sigma_m=np.zeros((60, 3))),
        attitudes=replace(simulated.network.attitudes, fixed=np.ones(8, dtype=bool)),
    )
    with pytest.raises(RankDefectError) as caught:
        adjust(network)
    assert len(caught.value.rank_defects) == 1
    sentence = caught.value.rank_defects[0].sentence
    assert "df of camera c" in sentence
    assert "Z of 8 stations" in sentence


def test_a_parameter_that_nothing_depends_on_is_named_alone() -> None:
    heads = (
        HeadMounting("nadir", np.eye(3), np.zeros(3)),
        HeadMounting("blind", rotation_of(3.0, 0.0, 0.0), np.zeros(3), rotation_free=True),
    )
    network = aerial(heads=heads).network
    with pytest.raises(RankDefectError) as caught:
        adjust(network)
    assert len(caught.value.rank_defects) == 3
    assert all("head rotation blind" in d.sentence for d in caught.value.rank_defects)
    assert all("no observation depends on it" in d.sentence for d in caught.value.rank_defects)


def test_rig_rotation_and_a_free_nadir_head_are_one_too_many() -> None:
    heads = (
        HeadMounting("a", np.eye(3), np.zeros(3), rotation_free=True),
        HeadMounting("b", rotation_of(0.4, 0.0, 0.0), np.zeros(3), rotation_free=True),
    )
    network = aerial(heads=heads, lines=3, along=4, points=90).network
    with pytest.raises(RankDefectError) as caught:
        adjust(network)
    assert len(caught.value.rank_defects) == 3
    assert all("attitude" in d.sentence for d in caught.value.rank_defects)
    assert any("head rotation" in d.sentence for d in caught.value.rank_defects)
