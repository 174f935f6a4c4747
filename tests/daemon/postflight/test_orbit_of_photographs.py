"""Photographs around a place: what a held principal point does to f, what positions of a small
circle fix, and that it is stated."""

from __future__ import annotations

import numpy as np
import pytest

from daemon.postflight.triangulation.ground_control import no_control
from daemon.postflight.triangulation.held_interior import FreePrincipalPoint, free_principal_point
from daemon.postflight.triangulation.photograph_block import PhotographBlock
from daemon.postflight.triangulation.photograph_cautions import (
    _camera_cautions,
    photograph_cautions,
)
from daemon.postflight.triangulation.photograph_project import (
    adjusted_photographs,
    photographs_section,
)
from processing.bundle.adjust import Adjustment, AdjustmentSettings, adjust
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
from tests.daemon.postflight.photograph_scene import F_PX as SCENE_F_PX
from tests.daemon.postflight.photograph_scene import _block as scene_block
from tests.daemon.postflight.photograph_scene import is_inside, projected, scene

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


RADIUS_M, ABOVE_M = 25.0, 22.0


def around(seed: int, *, scale: float = 1.0) -> tuple[PhotographBlock, np.ndarray]:
    """Eight photographs on a circle that look at its middle, as matching gives them; the points.

    `scale` enlarges the place and the circle, not the errors of the positions (1.5, 1.5, 2.5 m).
    """
    random = np.random.default_rng(seed)
    xyz = np.column_stack([random.uniform(-9, 9, (250, 2)), random.uniform(-2, 3, 250)])
    station, rotation = [], []
    for k in range(8):
        angle = 0.25 * np.pi * k
        centre = np.array([RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle), ABOVE_M])
        centre += random.normal(0.0, 0.5, 3)
        back = centre / np.linalg.norm(centre)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        station.append(centre)
        rotation.append(np.column_stack([right, np.cross(back, right), back]))
    seen = [projected(*pose, xyz) for pose in zip(station, rotation, strict=True)]
    rows = [(k, p) for k in range(8) for p in np.flatnonzero(is_inside(seen[k])).tolist()]
    count = np.bincount([p for _, p in rows], minlength=250)
    rows = [(k, p) for k, p in rows if count[p] >= 3]
    used, point = np.unique([p for _, p in rows], return_inverse=True)
    px = np.array([seen[k][p] for k, p in rows]) + random.normal(0.0, 0.1, (len(rows), 2))
    place = scale * np.array(station)
    position = place + random.normal(0.0, 1.0, place.shape) * POSITIONS_M
    found = scene_block(
        np.array([k for k, _ in rows]), point.astype(np.int64), px, scale * xyz[used], place,
        np.array(rotation), position, SCENE_F_PX,
    )  # fmt: skip
    return found, scale * xyz[used]


def section_of(found: PhotographBlock) -> tuple[dict, np.ndarray, Adjustment]:
    """The section of the report without control, the adjusted points, and the adjustment."""
    _, result, _ = adjusted_photographs(
        found, no_control(), position_sigma_m=POSITIONS_M, reject_beyond=4.0
    )
    return photographs_section(found, no_control(), result), result.state.points, result


def test_a_small_circle_hardly_fixes_tilt_and_scale_and_it_is_stated() -> None:
    """Errors over 12 circles have the stated size: ratio of lengths, and slope of the ground."""
    scales, slopes, stated = [], [], []
    for seed in range(12):
        found, truth = around(seed)
        section, points, result = section_of(found)
        assert not result.excluded.gnss.any(), "no position is wrong"
        one, other = points - points.mean(axis=0), truth - truth.mean(axis=0)
        scales.append(100.0 * (np.linalg.norm(one) / np.linalg.norm(other) - 1.0))
        fitted = np.linalg.lstsq(other, one, rcond=None)[0]
        slopes += np.degrees(fitted[:2, 2]).tolist()
        stated.append([section["scale_sigma_percent"], section["roll_sigma_deg"]])
        assert not section["positions_on_a_line"]
        assert section["off_nadir_deg"] == pytest.approx(48.6, abs=3.0)
    sigma = np.sqrt(np.mean(np.square(stated), axis=0))
    assert 0.6 < np.sqrt(np.mean(np.square(scales))) / sigma[0] < 1.6
    assert 0.6 < np.sqrt(np.mean(np.square(slopes))) / sigma[1] < 1.6
    cautions = photograph_cautions(section)
    for words in (
        "heights fix the tilt of the block to", "fix the scale of the block to",
        "degrees off the vertical (median), as around an object",
    ):  # fmt: skip
        assert len([one for one in cautions if words in one]) == 1, words
    assert not [one for one in cautions if "on one line" in one]
    with_control = photograph_cautions({**section, "control_points": 3})
    assert not [one for one in with_control if "tilt of" in one or "scale of" in one]


def test_a_wide_circle_and_vertical_photographs_have_no_such_caution() -> None:
    section, _, _ = section_of(around(1, scale=8.0)[0])
    cautions = photograph_cautions(section)
    assert not [one for one in cautions if "tilt of" in one or "scale of" in one]
    assert [one for one in cautions if "off the vertical" in one]
    section, _, _ = section_of(scene()[0])
    assert section["off_nadir_deg"] < 10.0
    assert not [one for one in photograph_cautions(section) if "off the vertical" in one]
