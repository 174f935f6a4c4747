"""A cloud between camera and ground: bright, soft, and nearer than the ground.

Because it is nearer, cones at different positions see it shifted against the ground. Its
shadow is not emulated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_hw.world import spline
from sim_hw.world.ground_types import rough
from sim_hw.world.seeding import random_stream

Array = NDArray[np.float64]

SIDE = 2048
"""Samples of the fields; a cloud is surrounded by clear air to their edge."""
HEIGHT_FRACTION = 0.5
"""How high it hangs, as a share of the flying height."""
CLOUD_REFLECTANCE = 1.05
"""Radiance of a sunlit cloud against a landscape's white."""
TONE = 0.06
SOFTNESS = 0.25


@dataclass(frozen=True)
class Cloud:
    """Opacity and radiance as spline coefficients (rows, columns), over a plane at `height_m`.

    The middle of the fields lies `right_m`, `along_m` from where the first image of the line is
    centred; samples are `sample_m` apart.
    """

    height_m: float
    right_m: float
    along_m: float
    sample_m: float
    opacity: NDArray[np.uint16]
    radiance: NDArray[np.uint16]

    def positions(self, origin_m: Array, rays: Array, *, heading: float, along_m: float) -> Array:
        """Columns and rows in the fields where rays meet the cloud's plane, shape (..., 2).

        Args:
            origin_m: where the rays begin, east, north, up.
            rays: directions (..., 3), pointing down.
            heading: of the first line, radians.
            along_m: way of the line's first image centre from the local origin.
        """
        reach = (self.height_m - origin_m[2]) / rays[..., 2]
        east, north = (origin_m[i] + reach * rays[..., i] for i in (0, 1))
        right = east * math.cos(heading) - north * math.sin(heading) - self.right_m
        along = east * math.sin(heading) + north * math.cos(heading) - along_m - self.along_m
        middle = (SIDE - 1) / 2
        return np.stack([middle + right / self.sample_m, middle - along / self.sample_m], axis=-1)


def cloud_over(
    seed: int,
    *,
    place_m: tuple[float, float],
    size_m: tuple[float, float],
    flying_height_m: float,
    gsd_m: float,
) -> Cloud:
    """A cloud that hides a rectangle of ground from the camera.

    Args:
        place_m: middle of the rectangle, right and along of the first image's centre.
        size_m: across and along track.
    """
    random = random_stream(seed, "cloud")
    nearer = 1.0 - HEIGHT_FRACTION
    sample = gsd_m * 2.0
    r, c = np.mgrid[0:SIDE, 0:SIDE] - (SIDE - 1) / 2
    across, along = (nearer * size / 2 / sample for size in size_m)
    # Turbulent: amplitudes fall by the power of 11/6 down to eddies of a few metres.
    eddies = rough((SIDE, SIDE), random, exponent=11 / 6, waves_px=(6.0, 400.0))
    edge = 1.25 - np.maximum(np.abs(c) / across, np.abs(r) / along)
    opacity = np.clip((edge + 0.12 * eddies) / SOFTNESS, 0.0, 1.0) ** 2
    opacity[np.maximum(np.abs(c) / across, np.abs(r) / along) > 1.8] = 0.0
    tone = rough((SIDE, SIDE), random, exponent=11 / 6, waves_px=(6.0, 600.0))
    return Cloud(
        height_m=HEIGHT_FRACTION * flying_height_m,
        right_m=nearer * place_m[0],
        along_m=nearer * place_m[1],
        sample_m=sample,
        opacity=_coefficients(opacity),
        radiance=_coefficients(CLOUD_REFLECTANCE * (1.0 + TONE * tone)),
    )


def _coefficients(field: Array | NDArray[np.float32]) -> NDArray[np.uint16]:
    return spline.stored(spline.coefficients(field.astype(np.float32), 1.0))
