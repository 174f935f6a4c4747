"""Photographs around a place: what a held principal point does to f, and that it is stated."""

from __future__ import annotations

import numpy as np
import pytest

from daemon.postflight.triangulation.held_interior import FreePrincipalPoint, free_principal_point
from daemon.postflight.triangulation.photograph_cautions import _camera_cautions
from processing.bundle.adjust import AdjustmentSettings, adjust
from processing.bundle.camera_model import perspective_mm
from processing.bundle.network import (
    INTERIOR,
    Attitudes,
    CameraModel,
    Gnss,
    ImagePoints,
    Images,
    Network,
    Points,
    Stations,
)

SIZE = np.array([4000.0, 3000.0])
F_PX, PITCH_MM, NOISE_PX = 3300.0, 0.002, 0.5
POSITIONS_M = (1.5, 1.5, 2.5)
PHOTOGRAPHS, POINTS = 12, 90


def orbit(point_px: tuple[float, float], *, are_turned: bool) -> Network:
    """Photographs on one circle that look at its middle; every second one turned by 90 degrees.

    The camera's principal point is `point_px` (columns, rows) from the middle.
    """
    random = np.random.default_rng(1)
    xyz = np.column_stack([random.uniform(-30, 30, (POINTS, 2)), random.uniform(-6, 9, POINTS)])
    station, rotation, seen = [], [], []
    for k in range(PHOTOGRAPHS):
        angle = 2.0 * np.pi * k / PHOTOGRAPHS
        centre = np.array([60.0 * np.cos(angle), 60.0 * np.sin(angle), 40.0])
        centre += random.normal(0.0, 1.0, 3)
        back = centre - random.normal(0.0, 1.5, 3)
        back /= np.linalg.norm(back)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        turn = np.column_stack([right, np.cross(back, right), back])
        if are_turned and k % 2:
            turn = turn @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        x, y, z = ((xyz - centre) @ turn).T
        px = np.column_stack([point_px[0] - F_PX * x / z, -point_px[1] - F_PX * y / z])
        station.append(centre)
        rotation.append(turn)
        inside = np.flatnonzero((np.abs(px) < SIZE / 2 - 5).all(axis=1))
        seen += [(k, p, *px[p]) for p in inside.tolist()]
    image, point = (np.array([row[k] for row in seen], np.int64) for k in (0, 1))
    xy_px = np.array([row[2:] for row in seen]) + random.normal(0.0, NOISE_PX, (len(seen), 2))
    names, every = tuple(f"p{k}" for k in range(PHOTOGRAPHS)), np.arange(PHOTOGRAPHS)
    place = np.array(station)
    position = place + random.normal(0.0, 1.0, place.shape) * POSITIONS_M
    camera = CameraModel(
        "C", F_PX * PITCH_MM, pixel_mm=PITCH_MM, free=frozenset({"df", "k1", "k2", "p1", "p2"})
    )
    return Network(
        cameras=(camera,),
        stations=Stations(names, place, np.zeros(PHOTOGRAPHS, bool)),
        attitudes=Attitudes(names, np.array(rotation), np.zeros(PHOTOGRAPHS, bool)),
        images=Images(names, every, every, 0 * every, 0 * every - 1),
        points=Points(
            tuple(f"t{k}" for k in range(POINTS)), xyz, np.full((POINTS, 3), np.nan),
            np.zeros(POINTS, bool),
        ),
        image_points=ImagePoints(
            image, point, xy_px * PITCH_MM, np.full((len(seen), 2), NOISE_PX * PITCH_MM)
        ),
        gnss=Gnss(
            every, every, position, np.tile(POSITIONS_M, (PHOTOGRAPHS, 1)),
            np.zeros((PHOTOGRAPHS, 3)), 0 * every - 1, np.zeros(PHOTOGRAPHS),
        ),
    )  # fmt: skip


def adjusted(
    point_px: tuple[float, float], *, are_turned: bool
) -> tuple[float, float, FreePrincipalPoint]:
    """The error of f and its standard deviation with a held point, px; the free adjustment."""
    result = adjust(
        orbit(point_px, are_turned=are_turned), AdjustmentSettings(variance_components=True)
    )
    f_px = perspective_mm(result.network.cameras[0], result.state.interior[0])[0] / PITCH_MM
    column = result.layout.interior[0][INTERIOR.index("df")]
    sigma_px = result.sigma0 * float(np.sqrt(result.cofactor[column, column])) / PITCH_MM
    (free,) = free_principal_point(result, longer_side_px=[4000]) or ()
    return f_px - F_PX, sigma_px, free


def test_one_circle_does_not_separate_f_from_the_principal_point_and_it_is_stated() -> None:
    error_px, sigma_px, free = adjusted((0.0, 20.0), are_turned=False)
    assert abs(error_px) > 10.0 * sigma_px, "the standard deviation with a held point is no limit"
    assert free.widens(sigma_px)
    assert abs(error_px + free.change_px) < 4.0 * free.f_sigma_px, "that with a free one is"
    assert free.point_px[1] == pytest.approx(20.0, abs=4.0 * free.point_sigma_px[1])
    section = {
        "camera": "C", "f_sigma_px": sigma_px, "f_px": F_PX, "f_exif_px": F_PX, "photographs": 12,
        "principal_point_free": vars(free), "f_depends_on_principal_point": False,
        "f_hardly_separated_from_point": True,
    }  # fmt: skip
    (caution,) = _camera_cautions(section, is_only=True)
    assert f"with an estimated one it is {free.f_sigma_px:.2f} px" in caution
    section["f_hardly_separated_from_point"] = False
    assert _camera_cautions(section, is_only=True) == []


def test_photographs_turned_by_90_degrees_separate_them() -> None:
    error_px, sigma_px, free = adjusted((0.0, 0.0), are_turned=True)
    assert abs(error_px) < 4.0 * sigma_px and not free.widens(sigma_px)
    error_px, sigma_px, free = adjusted((0.0, 20.0), are_turned=True)
    assert free.contradicts(sigma_px) or abs(error_px) < 4.0 * sigma_px
