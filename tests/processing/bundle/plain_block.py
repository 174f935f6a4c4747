"""A small aerial block from formulas of its own: nothing of the package computes its truth."""

from __future__ import annotations

import numpy as np

from processing.bundle.network import (
    Attitudes,
    CameraModel,
    ImagePoints,
    Images,
    Network,
    Points,
    Stations,
)

F_MM, PIXEL_MM, HEIGHT_M = 50.0, 0.005, 500.0
HALF_MM = (15.0, 10.0)


def axes(omega: float, phi: float, kappa: float) -> np.ndarray:
    (so, sp, sk), (co, cp, ck) = np.sin([omega, phi, kappa]), np.cos([omega, phi, kappa])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, co, -so], [0.0, so, co]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_z = np.array([[ck, -sk, 0.0], [sk, ck, 0.0], [0.0, 0.0, 1.0]])
    return about_x @ about_y @ about_z


def plain_block(seed: int, *, points: int = 60, relief_m: float = 0.0) -> Network:
    """Two lines of four nearly vertical images, 0.3 px; starts 2 m and 0.1 deg off, f is free.

    Seven control points, 1 cm. Formulas are those of collinearity,
    written here again.
    """
    random = np.random.default_rng(seed)
    line = np.repeat([0, 1], 4)
    place = np.column_stack([180.0 * line, 70.0 * np.tile(np.arange(4.0), 2), np.full(8, HEIGHT_M)])
    place += random.normal(0.0, 5.0, place.shape)
    angles = random.normal(0.0, 0.02, (8, 3)) + np.pi * line[:, None] * np.array([0.0, 0.0, 1.0])
    ground = random.uniform((-120.0, -80.0, 0.0), (300.0, 290.0, relief_m), (points, 3))
    image, point, xy = [], [], []
    for k in range(8):
        ray = (ground - place[k]) @ axes(*angles[k])
        seen = -F_MM * ray[:, :2] / ray[:, 2:]
        rows = np.flatnonzero((np.abs(seen) < HALF_MM).all(axis=1))
        image.append(np.full(len(rows), k))
        point.append(rows)
        xy.append(seen[rows] + random.normal(0.0, 0.3 * PIXEL_MM, (len(rows), 2)))
    images, seen_points = np.concatenate(image), np.concatenate(point)
    sigma = np.full((points, 3), np.nan)
    places = np.array(
        [(-60, -30), (240, -30), (240, 240), (-60, 240), (90, 100), (90, -30), (90, 240)]
    )
    count = np.bincount(seen_points, minlength=points)
    away = np.linalg.norm(ground[:, None, :2] - places, axis=2) + 1e4 * (count < 2)[:, None]
    control = np.unique(away.argmin(axis=0))
    sigma[control] = 0.01
    start = place + random.normal(0.0, 2.0, place.shape)
    off = np.radians(random.normal(0.0, 0.1, (8, 3)))
    names = tuple(f"i{k}" for k in range(8))
    every, none = np.arange(8), np.zeros(8, bool)
    return Network(
        cameras=(CameraModel("c", F_MM, free=frozenset({"df"}), pixel_mm=PIXEL_MM),),
        stations=Stations(names, start, none),
        attitudes=Attitudes(names, np.array([axes(*a) for a in angles + off]), none),
        images=Images(names, every, every, np.zeros(8, np.int64), np.full(8, -1)),
        points=Points(
            tuple(f"p{k}" for k in range(points)),
            ground + np.nan_to_num(sigma) * random.normal(0.0, 1.0, ground.shape),
            sigma,
            np.zeros(points, bool),
        ),
        image_points=ImagePoints(
            images, seen_points, np.concatenate(xy), np.full((len(images), 2), 0.3 * PIXEL_MM)
        ),
    )
