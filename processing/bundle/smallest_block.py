"""An adjustment of two images, which calls every compiled kernel of this package."""

from __future__ import annotations

import numpy as np

from processing.bundle.adjust import adjust
from processing.bundle.network import (
    Attitudes,
    CameraModel,
    ImagePoints,
    Images,
    Network,
    Points,
    Stations,
)


def adjust_smallest_block() -> float:
    """Adjust two images of a square of control points.

    Returns:
        sigma0; zero but for rounding.

    Example:
        >>> adjust_smallest_block() < 1e-6
        True
    """
    names = ("a", "b")
    station = np.array([[-2.0, 0.0, 10.0], [2.0, 0.0, 10.0]])
    corner = np.array([[x, y, x * y / 9.0] for x in (-3.0, 0.0, 3.0) for y in (-3.0, 0.0, 3.0)])
    index = np.arange(2)
    image, point = np.repeat(index, len(corner)), np.tile(np.arange(len(corner)), 2)
    ray = corner[point] - station[image]
    none = np.zeros(2, dtype=bool)
    network = Network(
        cameras=(CameraModel("c", 10.0),),
        stations=Stations(names, station, none),
        attitudes=Attitudes(names, np.tile(np.eye(3), (2, 1, 1)), none),
        images=Images(names, index, index, np.zeros_like(index), np.full_like(index, -1)),
        points=Points(
            tuple(f"p{k}" for k in range(len(corner))),
            corner,
            np.full(corner.shape, 0.01),
            np.zeros(len(corner), dtype=bool),
        ),
        image_points=ImagePoints(
            image, point, -10.0 * ray[:, :2] / ray[:, 2:], np.full((len(image), 2), 1e-3)
        ),
    )
    return adjust(network).sigma0
