"""A principal distance over flat ground: steps that follow the curved valley of its heights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from processing.bundle import gauss_newton
from processing.bundle.adjust import adjust
from processing.bundle.adjustment_results import parameters_of
from processing.bundle.network import (
    Attitudes,
    CameraModel,
    ImagePoints,
    Images,
    Network,
    NetworkError,
    Points,
    Stations,
)

F_MM, PIXEL_MM, HEIGHT_M = 50.0, 0.005, 500.0
HALF_MM = (15.0, 10.0)


def _axes(omega: float, phi: float, kappa: float) -> np.ndarray:
    (so, sp, sk), (co, cp, ck) = np.sin([omega, phi, kappa]), np.cos([omega, phi, kappa])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, co, -so], [0.0, so, co]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_z = np.array([[ck, -sk, 0.0], [sk, ck, 0.0], [0.0, 0.0, 1.0]])
    return about_x @ about_y @ about_z


def flat_block(seed: int) -> Network:
    """Two lines of four nearly vertical images of a plane, 0.3 px; starts 2 m and 0.1 deg off."""
    random = np.random.default_rng(seed)
    line = np.repeat([0, 1], 4)
    place = np.column_stack([180.0 * line, 70.0 * np.tile(np.arange(4.0), 2), np.full(8, HEIGHT_M)])
    place += random.normal(0.0, 5.0, place.shape)
    angles = random.normal(0.0, 0.02, (8, 3)) + np.pi * line[:, None] * np.array([0.0, 0.0, 1.0])
    ground = np.zeros((60, 3))
    ground[:, :2] = random.uniform((-120.0, -80.0), (300.0, 290.0), (60, 2))
    image, point, xy = [], [], []
    for k in range(8):
        ray = (ground - place[k]) @ _axes(*angles[k])
        seen = -F_MM * ray[:, :2] / ray[:, 2:]
        rows = np.flatnonzero((np.abs(seen) < HALF_MM).all(axis=1))
        image.append(np.full(len(rows), k))
        point.append(rows)
        xy.append(seen[rows] + random.normal(0.0, 0.3 * PIXEL_MM, (len(rows), 2)))
    images, points = np.concatenate(image), np.concatenate(point)
    sigma = np.full((60, 3), np.nan)
    corners = np.array([(-60.0, -30.0), (240.0, -30.0), (240.0, 240.0), (-60.0, 240.0)])
    count = np.bincount(points, minlength=60)
    away = np.linalg.norm(ground[:, None, :2] - corners, axis=2) + 1e4 * (count < 2)[:, None]
    control = np.unique(away.argmin(axis=0))
    sigma[control] = 0.01
    start = place + random.normal(0.0, 2.0, place.shape)
    off = np.radians(random.normal(0.0, 0.1, (8, 3)))
    names = tuple(f"i{k}" for k in range(8))
    every, none = np.arange(8), np.zeros(8, bool)
    return Network(
        cameras=(CameraModel("c", F_MM, free=frozenset({"df"}), pixel_mm=PIXEL_MM),),
        stations=Stations(names, start, none),
        attitudes=Attitudes(names, np.array([_axes(*a) for a in angles + off]), none),
        images=Images(names, every, every, np.zeros(8, np.int64), np.full(8, -1)),
        points=Points(
            tuple(f"p{k}" for k in range(60)),
            ground + np.nan_to_num(sigma) * random.normal(0.0, 1.0, ground.shape),
            sigma,
            np.zeros(60, bool),
        ),
        image_points=ImagePoints(
            images, points, np.concatenate(xy), np.full((len(images), 2), 0.3 * PIXEL_MM)
        ),
    )


SEEDS = range(1, 5)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_principal_distance_over_flat_ground_converges_to_the_truth(seed) -> None:
    result = adjust(flat_block(seed))
    assert result.sigma0 == pytest.approx(1.0, abs=0.2)
    (parameter,) = parameters_of(result)
    assert parameter.sigma is not None and parameter.sigma > 1.0
    assert abs(parameter.value) < 3.0 * parameter.sigma
    assert len(result.iterations) < 25


def test_straight_steps_alone_do_not_converge(monkeypatch) -> None:
    monkeypatch.setattr(gauss_newton, "_BENT_BELOW", 0.0)
    with pytest.raises(NetworkError, match="no convergence"):
        adjust(flat_block(1))


def test_a_block_without_a_valley_takes_the_steps_of_gauss_newton(monkeypatch) -> None:
    network = flat_block(1)
    held = replace(network, cameras=(replace(network.cameras[0], free=frozenset()),))
    bent = adjust(held).iterations
    monkeypatch.setattr(gauss_newton, "_BENT_BELOW", 0.0)
    assert adjust(held).iterations == bent
