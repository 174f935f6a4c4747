"""The emulated ground: mild relief as a sum of long waves about a mean height of zero.

Heights in metres above the plane up = 0 of the local system of `flight`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_hw.world.seeding import random_stream

Array = NDArray[np.float64]

TERMS = 6
SHORTEST_WAVE = 0.3
"""Shortest wave of the relief in flying heights: long enough to be smooth between grid points."""
ITERATIONS = 6


@dataclass(frozen=True)
class Terrain:
    """Waves: height = sum a sin(kx east + ky north + phase)."""

    amplitude_m: Array
    wave_east: Array
    wave_north: Array
    phase: Array

    def height_m(self, east_m: Array, north_m: Array) -> Array:
        """Height at points of any shape."""
        height = np.zeros(np.broadcast(east_m, north_m).shape)
        for a, kx, ky, phase in zip(
            self.amplitude_m, self.wave_east, self.wave_north, self.phase, strict=True
        ):
            height += a * np.sin(kx * east_m + ky * north_m + phase)
        return height

    def intersect(self, origin_m: Array, direction: Array) -> Array:
        """Ground points of rays.

        Args:
            origin_m: start of the rays, shape (3,).
            direction: any length, shape (..., 3), pointing down.

        Returns:
            Points east, north, up, shape (..., 3).
        """
        east, north, up = (direction[..., i] for i in range(3))
        height = np.zeros(up.shape)
        x = y = height
        # A fixed point: contracts by slope times tangent of the off-nadir angle, about 0.01 here.
        for _ in range(ITERATIONS):
            reach = (height - origin_m[2]) / up
            x = origin_m[0] + reach * east
            y = origin_m[1] + reach * north
            height = self.height_m(x, y)
        reach = (height - origin_m[2]) / up
        return np.stack([origin_m[0] + reach * east, origin_m[1] + reach * north, height], axis=-1)


def mild_relief(seed: int, *, flying_height_m: float, relative_relief: float) -> Terrain:
    """Relief that stays within `relative_relief` (dh / h) of the flying height, up and down."""
    random = random_stream(seed, "terrain")
    length = (
        flying_height_m * np.geomspace(SHORTEST_WAVE, 1.2, TERMS) * random.uniform(1, 1.2, TERMS)
    )
    bearing = random.uniform(0, 2 * math.pi, TERMS)
    share = random.uniform(0.5, 1.0, TERMS) * length
    amplitude = relative_relief * flying_height_m * share / share.sum()
    return Terrain(
        amplitude_m=amplitude,
        wave_east=2 * math.pi / length * np.sin(bearing),
        wave_north=2 * math.pi / length * np.cos(bearing),
        phase=random.uniform(0, 2 * math.pi, TERMS),
    )
