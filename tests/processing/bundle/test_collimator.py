"""A head before a collimator: known directions, one rotation for every series."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from processing.bundle.adjust import Adjustment, adjust
from processing.bundle.adjustment_results import parameters_of
from processing.bundle.network import (
    Attitudes,
    CameraModel,
    ImagePoints,
    Images,
    Network,
    Points,
    Stations,
)
from processing.bundle.rank_diagnosis import RankDefectError
from tests.processing.bundle.simulated_networks import measured_from_ideal, rotation_of

TRUE = np.array([0.02, -0.015, 0.03, 4e-7, -3e-11, 0.0, 3e-7, -2e-7, 2e-6, -1e-6])
FREE = frozenset({"dx0", "dy0", "df", "k1", "k2", "p1", "p2", "b1", "b2"})
PITCH_MM = 0.012


def series(seed: int, *, count: int = 4, sigma_mm: float = PITCH_MM / 20.0) -> Network:
    """Targets over the field of a 7168 x 4096 head of 120 mm, seen in `count` orientations."""
    random = np.random.default_rng(seed)
    camera = CameraModel("head", 120.0, interior=TRUE, free=FREE)
    x, y = np.meshgrid(np.linspace(-0.33, 0.33, 13), np.linspace(-0.19, 0.19, 9))
    directions = np.column_stack([x.ravel(), y.ravel(), -np.ones(x.size)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    image, point, xy, rotations, starts = [], [], [], [], []
    for k in range(count):
        rotation = rotation_of(*random.normal(0.0, 0.01, 2), k * np.pi / 2.0)
        rotations.append(rotation)
        starts.append(rotation @ rotation_of(*random.normal(0.0, 2e-3, 3)))
        seen = directions @ rotation
        for p, s in enumerate(seen):
            ideal = -120.0 * s[:2] / s[2]
            if abs(ideal[0]) < 3584 * PITCH_MM and abs(ideal[1]) < 2048 * PITCH_MM:
                image.append(k)
                point.append(p)
                xy.append(measured_from_ideal(camera, ideal) + random.normal(0.0, sigma_mm, 2))
    index = np.arange(count)
    return Network(
        cameras=(replace(camera, interior=np.zeros(10)),),
        stations=Stations(("collimator",), np.zeros((1, 3)), np.ones(1, bool)),
        attitudes=Attitudes(
            tuple(f"series {k}" for k in index), np.array(starts), np.zeros(count, bool)
        ),
        images=Images(
            tuple(f"s{k}" for k in index),
            np.zeros(count, np.int64),
            index,
            np.zeros(count, np.int64),
            np.full(count, -1),
        ),
        points=Points(
            tuple(f"t{k}" for k in range(len(directions))),
            directions,
            np.zeros((len(directions), 3)),
            np.ones(len(directions), bool),
        ),
        image_points=ImagePoints(
            np.array(image), np.array(point), np.array(xy), np.full((len(xy), 2), sigma_mm)
        ),
    )


def errors(result: Adjustment) -> np.ndarray:
    """Errors of the parameters in their own covariance: the squared length over their number."""
    columns = result.layout.interior[0]
    free = np.flatnonzero(columns >= 0)
    covariance = result.cofactor[np.ix_(columns[free], columns[free])]
    error = result.state.interior[0][free] - TRUE[free]
    return np.array([float(error @ np.linalg.solve(covariance, error)), float(len(free))])


def test_each_series_adds_three_unknowns_and_the_parameters_come_back_honestly() -> None:
    total = np.zeros(2)
    for seed in range(12):
        result = adjust(series(seed))
        assert result.unknowns == len(FREE) + 3 * 4
        assert result.sigma0 == pytest.approx(1.0, abs=0.12)
        total += errors(result)
    # 108 degrees of freedom: 99.9 % lie between 67 and 161.
    assert 67.0 < total[0] < 161.0
    assert total[1] == 108.0


def test_more_series_make_the_principal_point_surer() -> None:
    def sigma(count: int) -> float:
        found = parameters_of(adjust(series(1, count=count)))
        return next(p.sigma for p in found if p.name == "dx0")

    assert sigma(4) < 0.8 * sigma(1)


def test_directions_say_nothing_of_where_the_head_stands() -> None:
    network = series(2, count=1)
    free = replace(network, stations=replace(network.stations, fixed=np.zeros(1, bool)))
    with pytest.raises(RankDefectError) as caught:
        adjust(free)
    sentences = [d.sentence for d in caught.value.rank_defects]
    assert len(sentences) == 3
    assert [s.split(" of ")[0] for s in sentences] == ["position in X", "position in Y", "height"]
