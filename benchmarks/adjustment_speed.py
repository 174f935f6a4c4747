"""`python -m benchmarks.adjustment_speed`: CPU time and memory of one adjustment of a large block.

Crosswise overlapping lines, 80 % along and 60 % across, of a camera of 100 mm with square images.
Observations have normal errors of 0.3 px, starting values errors of 1 m and 1 mrad. The datum is
that of control points, or free.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import time
from dataclasses import replace
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from daemon.cli.benchmark.measurement import machine
from processing.bundle.adjust import AdjustmentSettings, adjust
from processing.bundle.free_datum import FreeDatum
from processing.bundle.network import (
    Attitudes,
    CameraModel,
    ImagePoints,
    Images,
    Network,
    Points,
    Stations,
)
from processing.geometry.rotation import rotations_from_vectors

Array = NDArray[np.float64]

F_MM: Final = 100.0
HALF_MM: Final = 50.0
PIXEL_MM: Final = 5e-3
NOISE_PX: Final = 0.3
HEIGHT_M: Final = 1000.0
BASE_M: Final = 200.0
DISTANCE_M: Final = 400.0


def block_of(images: int, image_points: int, seed: int = 1) -> Network:
    """A block of about that many image points."""
    random = np.random.default_rng(seed)
    along = max(2, math.ceil(math.sqrt(images * DISTANCE_M / BASE_M)))
    index = np.arange(images)
    place = np.stack(
        [BASE_M * (index % along), DISTANCE_M * (index // along), np.full(images, HEIGHT_M)], axis=1
    )
    station = place + random.normal(0.0, 5.0, place.shape)
    rotation = rotations_from_vectors(random.normal(0.0, 0.02, (images, 3)))
    half = HALF_MM / F_MM * HEIGHT_M
    low, high = place.min(axis=0)[:2] - half, place.max(axis=0)[:2] + half
    density = image_points / (images * (2.0 * half) ** 2)
    count = round(density * float(np.prod(high - low)))
    ground = np.column_stack([random.uniform(low, high, (count, 2)), random.uniform(0, 80, count)])
    image, point, xy = [], [], []
    for k in range(images):
        near = np.flatnonzero((np.abs(ground[:, :2] - station[k, :2]) < 1.2 * half).all(axis=1))
        ray = (ground[near] - station[k]) @ rotation[k]
        seen = -F_MM * ray[:, :2] / ray[:, 2:]
        own = (np.abs(seen) < HALF_MM).all(axis=1)
        image.append(np.full(int(own.sum()), k))
        point.append(near[own])
        xy.append(seen[own] + random.normal(0.0, NOISE_PX * PIXEL_MM, (int(own.sum()), 2)))
    images_of, points_of = np.concatenate(image), np.concatenate(point)
    often = np.bincount(points_of, minlength=count) >= 2
    taken = often[points_of]
    names = tuple(f"i{k}" for k in range(images))
    none = np.zeros(images, dtype=bool)
    sigma = np.full((count, 3), np.nan)
    control = np.flatnonzero(often)[:: max(1, count // 40)]
    sigma[control] = 0.02
    start = ground + random.normal(0.0, 1.0, ground.shape)
    start[control] = ground[control] + random.normal(0.0, 0.02, (len(control), 3))
    turned = rotations_from_vectors(random.normal(0.0, 1e-3, (images, 3)))
    measured = np.concatenate(xy)[taken]
    return Network(
        cameras=(CameraModel("c", F_MM, pixel_mm=PIXEL_MM),),
        stations=Stations(names, station + random.normal(0.0, 1.0, station.shape), none),
        attitudes=Attitudes(names, rotation @ turned, none),
        images=Images(names, index, index, np.zeros_like(index), np.full_like(index, -1)),
        points=Points(
            tuple(f"p{k}" for k in range(count)), start, sigma, np.zeros(count, dtype=bool)
        ),
        image_points=ImagePoints(
            images_of[taken],
            points_of[taken],
            measured,
            np.full(measured.shape, NOISE_PX * PIXEL_MM),
        ),
    )


def measured(network: Network, datum: str) -> dict[str, Any]:
    """One adjustment with all covariances."""
    settings = AdjustmentSettings()
    if datum != "control":
        nothing = np.full_like(network.points.sigma_m, np.nan)
        network = replace(network, points=replace(network.points, sigma_m=nothing))
        settings = AdjustmentSettings(minimum_norm=True, free_datum=cast(FreeDatum, datum))
    begun, cpu = time.perf_counter(), time.process_time()
    result = adjust(network, settings)
    return {
        "datum": datum,
        "images": len(network.images.names),
        "image_points": len(network.image_points.image),
        "object_points": len(network.points.names) - int(result.left_out.sum()),
        "unknowns": result.unknowns,
        "iterations": len(result.iterations) - 1,
        "sigma0": round(result.sigma0, 4),
        "cpu_s": round(time.process_time() - cpu, 1),
        "seconds": round(time.perf_counter() - begun, 1),
        "peak_mib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.adjustment_speed", description=__doc__
    )
    parser.add_argument("--images", type=int, default=500, help="Exposures (default: 500).")
    parser.add_argument(
        "--image-points", type=int, default=100_000, help="About so many (default: 100000)."
    )
    parser.add_argument(
        "--datum",
        choices=("control", "unknowns", "points", "stations", "all", "dependent"),
        nargs="+",
        default=("control",),
        help="Datum of each adjustment; memory is the largest so far (default: control).",
    )
    options = parser.parse_args()
    network = block_of(options.images, options.image_points)
    print(json.dumps({"machine": machine()}), flush=True)
    for datum in options.datum:
        print(json.dumps(measured(network, datum)), flush=True)


if __name__ == "__main__":
    main()
