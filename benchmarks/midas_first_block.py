"""`python -m benchmarks.midas_first_block`: the first block of Jacobsen (2008), simulated.

Wide-angle aerial photographs (f 153 mm, 1:4600, 20 um) and three oblique digital cameras (84.3,
169.5 and 169.8 mm, about 50 degrees off the vertical), 13 control points (2 cm, 7 cm), no direct
orientation, 6 % blunders. The paper's numbers of photographs, its oblique frames (here those of its
second block) and flying heights are not published; those here are assumptions, and cameras are
calibrated. Oblique matches
are points of two to four images; after the adjustment points with equal coordinates are joined.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.cli.benchmark.measurement import machine
from processing.bundle.adjust import Adjustment, AdjustmentSettings, adjust
from processing.bundle.adjustment_results import control_residuals
from processing.bundle.network import (
    Attitudes,
    CameraModel,
    ImagePoints,
    Images,
    Network,
    Points,
    Stations,
)
from processing.bundle.point_joining import joined_points
from processing.bundle.starting_values import starting_values
from processing.geometry.rotation import rotation_matrix

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

PHOTO_F_MM: Final = 153.0
PHOTO_HALF_MM: Final = 115.0
SCALE: Final = 4600.0
SIGMA_MM: Final = 0.020
CONTROL: Final = 13
CONTROL_M: Final = (0.02, 0.07)
OBLIQUE_F_MM: Final = (84.3, 169.5, 169.8)
OBLIQUE_HALF_MM: Final = (17.97, 11.98)
OBLIQUE_PIXEL_MM: Final = 7.2e-3
TILT_DEG: Final = 50.0
BLUNDERS: Final = 0.06
LINES: Final = 3
ALONG: Final = 5
STATIONS: Final = 4
FIRST_OBLIQUE: Final = LINES * ALONG
POINTS: Final = 1200
EVERYWHERE: Final = 60
"""Tie points in the middle that are measured in all images."""
SETTINGS: Final = AdjustmentSettings(robust=True, weight_function="danish", significance=0.05)


@dataclass(frozen=True)
class FirstBlock:
    """The network with matches apart; true places (points, 3), ground point of each point, and
    which image points are blunders."""

    network: Network
    truth_m: Array
    ground: Indices
    is_blunder: NDArray[np.bool_]


def simulated(seed: int) -> FirstBlock:
    """Fly the block once."""
    random = np.random.default_rng(seed)
    height = PHOTO_F_MM * SCALE / 1000.0
    side = 2.0 * PHOTO_HALF_MM * SCALE / 1000.0
    base, across = 0.4 * side, 0.7 * side
    station, rotation, camera = [], [], []
    for line in range(LINES):
        for k in range(ALONG):
            place = np.array([k * base, line * across, height])
            station.append(place + random.normal(0.0, 10.0, 3))
            tilt = np.radians(random.normal(0.0, 2.0, 3))
            rotation.append(rotation_matrix(tilt[0], tilt[1], tilt[2] + np.pi * (line % 2)))
            camera.append(0)
    extent = np.array([(ALONG - 1) * base, (LINES - 1) * across])
    # Oblique views of the middle from all sides, near enough to overlap each other.
    for head in range(3):
        for k in range(STATIONS):
            azimuth = 2.0 * np.pi * (k + head / 3.0) / STATIONS
            reach = height * np.tan(np.radians(TILT_DEG))
            aim = extent / 2.0 + random.normal(0.0, 40.0, 2)
            foot = aim - reach * np.array([np.sin(azimuth), np.cos(azimuth)])
            station.append(np.array([*foot, height]) + random.normal(0.0, 10.0, 3))
            turned = rotation_matrix(0.0, 0.0, -azimuth)
            tilted = rotation_matrix(np.radians(TILT_DEG + random.normal(0.0, 2.0)), 0.0, 0.0)
            rotation.append(turned @ tilted)
            camera.append(1 + head)
    stations, rotations, cameras = np.array(station), np.array(rotation), np.array(camera)
    ground = _ground(random, extent, side)
    image, point, xy = [], [], []
    f = np.array([PHOTO_F_MM, *OBLIQUE_F_MM])
    half = np.array([[PHOTO_HALF_MM] * 2, *[OBLIQUE_HALF_MM] * 3])
    for k in range(len(stations)):
        seen = (ground - stations[k]) @ rotations[k]
        ideal = -f[cameras[k]] * seen[:, :2] / seen[:, 2:]
        inside = (seen[:, 2] < 0.0) & (np.abs(ideal) < 0.97 * half[cameras[k]]).all(axis=1)
        rows = np.flatnonzero(inside)
        image.append(np.full(len(rows), k))
        point.append(rows)
        sigma = SIGMA_MM if cameras[k] == 0 else OBLIQUE_PIXEL_MM
        xy.append(ideal[rows] + random.normal(0.0, sigma, (len(rows), 2)))
    return _with_matches(
        random, ground, (stations, cameras), np.concatenate(image), np.concatenate(point),
        np.concatenate(xy),
    )  # fmt: skip


def _ground(random: np.random.Generator, extent: Array, side: float) -> Array:
    """Control over the block first, then tie points, a third of them in the oblique views."""
    low, high = np.full(2, -0.45 * side), extent + 0.45 * side
    spread = random.uniform(low, high, (POINTS, 2))
    middle = extent / 2.0 + random.normal(0.0, 60.0, (POINTS // 3, 2))
    spread[-len(middle) :] = middle
    grid = np.stack(np.meshgrid(*(np.linspace(0.05, 0.95, n) for n in (4, 3))), axis=-1)
    spread[: CONTROL - 1] = low + grid.reshape(-1, 2) * (high - low)
    spread[CONTROL - 1] = extent / 2.0
    relief = 15.0 * np.sin(spread[:, 0] / 170.0) + 10.0 * np.sin(spread[:, 1] / 120.0)
    return np.column_stack([spread, relief + random.uniform(0.0, 12.0, POINTS)])


def _with_matches(
    random: np.random.Generator,
    ground: Array,
    exposures: tuple[Array, Indices],
    image: Indices,
    of_ground: Indices,
    xy_mm: Array,
) -> FirstBlock:
    """Tie points: one of the photographs, and one of each two to four neighbouring oblique images.

    Control and some points that are measured in all images connect the two.
    """
    stations, cameras = exposures
    point = np.full(len(image), -1)
    names: list[str] = []
    owner: list[int] = []
    for k in range(len(ground)):
        rows = np.flatnonzero(of_ground == k)
        groups = [rows]
        if CONTROL <= k < len(ground) - EVERYWHERE:
            oblique = rows[cameras[image[rows]] > 0]
            # By azimuth: neighbours look alike.
            order = np.argsort((image[oblique] - FIRST_OBLIQUE) % STATIONS, kind="stable")
            size = int(random.integers(2, 5))
            cuts = np.arange(size, len(oblique) - 1, size)
            groups = [rows[cameras[image[rows]] == 0], *np.split(oblique[order], cuts)]
        for part, own in enumerate(groups):
            if len(own) >= 2:
                point[own] = len(names)
                names.append(f"{k}" if part == 0 else f"{k}.{part}")
                owner.append(k)
    taken = point >= 0
    image, point, xy_mm = image[taken], point[taken], xy_mm[taken]
    is_blunder = random.random(len(image)) < BLUNDERS
    is_blunder &= np.array(owner)[point] >= CONTROL
    pixel = np.where(cameras[image] == 0, SIGMA_MM, OBLIQUE_PIXEL_MM)
    off = random.uniform(10.0, 100.0, len(image)) * pixel
    angle = random.uniform(0.0, 2.0 * np.pi, len(image))
    xy_mm = xy_mm + (is_blunder * off)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    n, truth = len(stations), ground[owner]
    known = np.array(owner) < CONTROL
    sigma, xyz = np.full(truth.shape, np.nan), np.full(truth.shape, np.nan)
    spread = np.array([CONTROL_M[0], CONTROL_M[0], CONTROL_M[1]])
    sigma[known] = spread
    xyz[known] = truth[known] + random.normal(0.0, spread, (int(known.sum()), 3))
    exposure = tuple(f"e{k}" for k in range(n))
    index = np.arange(n)
    models = [CameraModel("photo", PHOTO_F_MM, pixel_mm=SIGMA_MM)]
    models += [
        CameraModel(f"oblique{k}", f, pixel_mm=OBLIQUE_PIXEL_MM) for k, f in enumerate(OBLIQUE_F_MM)
    ]
    network = Network(
        cameras=tuple(models),
        stations=Stations(exposure, np.full((n, 3), np.nan), np.zeros(n, bool)),
        attitudes=Attitudes(exposure, np.full((n, 3, 3), np.nan), np.zeros(n, bool)),
        images=Images(exposure, index, index, cameras, np.full(n, -1)),
        points=Points(tuple(names), xyz, sigma, np.zeros(len(names), bool)),
        image_points=ImagePoints(image, point, xy_mm, np.stack([pixel, pixel], axis=1)),
    )
    return FirstBlock(network, truth, np.array(owner), is_blunder)


def run_block(seed: int) -> dict[str, Any]:
    """Orient, adjust, join and adjust again."""
    block = simulated(seed)
    apart = adjust(starting_values(block.network), SETTINGS)
    network, joined = joined_points(
        apart.network, apart.state.points, apart.point_cofactor * apart.sigma0**2
    )
    together = adjust(network, SETTINGS)
    number = {name: k for k, name in enumerate(block.network.points.names)}
    kept = np.array([number[name] for name in network.points.names])
    table, before = network.image_points, block.network.image_points
    wrong = block.ground[before.point] != block.ground[kept[table.point]]
    possible = len(block.ground) - len(np.unique(block.ground))
    return {
        "images": len(block.network.images.names),
        "image_points": len(before.image),
        "blunders": int(block.is_blunder.sum()),
        "points_apart": len(block.ground),
        "points_joined": joined,
        "points_to_join": possible,
        "image_points_of_another_point": int(wrong.sum()),
        "apart": _figures(apart, block, np.arange(len(block.ground))),
        "joined": _figures(together, block, kept),
    }


def _figures(result: Adjustment, block: FirstBlock, kept: Indices) -> dict[str, Any]:
    good = ~result.left_out & np.isfinite(result.point_cofactor).all(axis=(1, 2))
    good &= block.ground[kept] >= CONTROL
    error = (result.state.points - block.truth_m[kept])[good]
    sigma = result.sigma0 * np.sqrt(np.einsum("pii->pi", result.point_cofactor[good]))
    rays = np.bincount(result.network.image_points.point[result.weight > 0.0], minlength=len(good))
    found = result.rejected & block.is_blunder
    return {
        "sigma0_um": result.sigma0 * SIGMA_MM * 1e3,
        "control_rms_m": [float(v) for v in control_residuals(result).rms_m],
        "images_most": int(rays.max()),
        "rays_mean": float(rays[good].mean()),
        "blunders_left_out": int(found.sum()),
        "others_left_out": int((result.rejected & ~block.is_blunder).sum()),
        "median_error_m": [float(v) for v in np.median(np.abs(error), axis=0)],
        "median_sigma_m": [float(v) for v in np.median(sigma, axis=0)],
        "normalised_squares_median": float(np.median((error / sigma) ** 2) / 0.4549),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.midas_first_block", description=__doc__
    )
    parser.add_argument("--seeds", type=int, default=5, help="Blocks (default: 5).")
    options = parser.parse_args()
    print(json.dumps({"machine": machine()}), flush=True)
    for seed in range(1, options.seeds + 1):
        print(json.dumps({"seed": seed} | run_block(seed)), flush=True)


if __name__ == "__main__":
    main()
