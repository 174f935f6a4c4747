"""Cars on the motorways of a scene; they move between the exposures of the cones.

A cone that fires 80 mm of flight later sees a car at 30 m/s some centimetres further on. The road
under them is painted in `ground_types`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sim_hw.world import spline
from sim_hw.world.ground_types import motorways_px
from sim_hw.world.scene import COLOURS, PAN_MIX, Scene, SceneSettings
from sim_hw.world.seeding import random_stream

LANES = 8
LANE_M = 3.75
SPACING_M = 28.0
LENGTH_M, WIDTH_M = 4.6, 1.8
SPEED_MPS = (24.0, 34.0)
ROAD = 0.10
"""Radiance of the asphalt that cars hide."""
EDGE_PX = 64


@dataclass(frozen=True)
class Car:
    """A car: its middle in scene samples at time zero, samples per second down the rows, colour."""

    column: float
    row: float
    rows_per_s: float
    radiance: Mapping[str, float]


def cars_of(settings: SceneSettings) -> tuple[Car, ...]:
    """The cars of a scene: on the left motorway all fly along, on the right all come against."""
    random = random_stream(settings.seed, "traffic")
    spacing = SPACING_M / settings.sample_m
    found = []
    for sign, middle in zip((-1.0, 1.0), motorways_px(settings.width_px), strict=True):
        for lane in range(LANES):
            column = middle + (lane - (LANES - 1) / 2) * LANE_M / settings.sample_m
            speed = sign * random.uniform(*SPEED_MPS) / settings.sample_m
            row = random.uniform(0.0, spacing)
            while row < settings.height_px:
                paint = float(random.choice([0.03, 0.2, 0.5, 0.9]))
                tint = random.uniform(0.7, 1.3, len(COLOURS))
                radiance = {b: paint * float(t) for b, t in zip(COLOURS, tint, strict=True)}
                radiance["pan"] = sum(radiance[b] * PAN_MIX[b] for b in COLOURS)
                found.append(Car(column + random.normal(0, 1), row, speed, radiance))
                row += spacing * random.uniform(0.5, 1.5)
    return tuple(found)


def scene_with(cars: Sequence[Car], scene: Scene, t_s: float, bands: Sequence[str]) -> Scene:
    """The scene with every car where it is at an instant, in the `bands` that are looked at."""
    driven = {name: _with(cars, scene, name, t_s) for name in bands}
    return replace(scene, bands={**scene.bands, **driven})


def _with(cars: Sequence[Car], scene: Scene, band: str, t_s: float) -> NDArray[np.uint16]:
    settings, step = scene.settings, scene.step(band)
    out = np.array(scene.bands[band])
    blur = settings.psf_px * (1 if band == "pan" else settings.colour_ratio)
    half = (WIDTH_M / settings.sample_m / 2, LENGTH_M / settings.sample_m / 2)
    rows, columns = out.shape
    for car in cars:
        row = car.row + car.rows_per_s * t_s
        first_c, across = _profile(car.column, half[0], blur, step)
        first_r, along = _profile(row, half[1], blur, step)
        if first_c < 0 or first_r < 0:
            continue
        if first_c + len(across) > columns or first_r + len(along) > rows:
            continue
        part = out[first_r : first_r + len(along), first_c : first_c + len(across)]
        contrast = (car.radiance[band] - ROAD) * spline.STORED_UNIT
        part[...] = np.clip(part + contrast * np.outer(along, across) + 0.5, 0, 65535)
    return out


def _profile(middle: float, half: float, blur: float, step: int) -> tuple[int, NDArray[np.float64]]:
    """Coefficients of a box along one axis, seen through the lens, and the first one's index."""
    first = (int(middle - half) - EDGE_PX) // step * step
    samples = first + np.arange(round(2 * half) + 2 * EDGE_PX + step)
    covered = np.clip(half + 0.5 - np.abs(samples - middle), 0.0, 1.0)
    if step == 1:
        return first, np.convolve(covered, spline.coefficient_kernel(blur), mode="same")
    reach = int(np.ceil(4 * blur))
    lens = np.exp(-0.5 * (np.arange(-reach, reach + 1) / blur) ** 2)
    soft = np.convolve(covered, lens / lens.sum(), mode="same")[::step]
    return first // step, np.convolve(soft, spline.coefficient_kernel(0.0), mode="same")
