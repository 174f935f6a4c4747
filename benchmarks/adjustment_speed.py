"""`python -m benchmarks.adjustment_speed`: CPU time and memory of one adjustment of a large block.

Crosswise overlapping lines, 80 % along and 60 % across, of a camera of 100 mm with square images.
Observations have normal errors of 0.3 px, starting values errors of 1 m and 1 mrad. The datum is
that of control points, or free. `--peer` adjusts the block around a building of `blunder_search`
with three held points, here and by Ceres as pycolmap calls it (SPARSE_SCHUR, one thread, C++
residuals), from the same starting values. `--lines` adds antenna positions with shift and drift of
every line and a free interior orientation, and `--robust` Huber weights before the adjustment;
`--dense` adjusts once more with the dense reduced matrix and compares.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from benchmarks.blunder_search import LARGE, around_building
from daemon.cli.benchmark.measurement import machine
from processing.bundle.adjust import AdjustmentSettings, adjust
from processing.bundle.free_datum import FreeDatum
from processing.bundle.network import (
    Attitudes,
    CameraModel,
    Gnss,
    ImagePoints,
    Images,
    Network,
    Points,
    Stations,
)
from processing.bundle.normal_equations import MAX_COLUMNS
from processing.geometry.rotation import rotations_from_vectors

Array = NDArray[np.float64]

F_MM: Final = 100.0
HALF_MM: Final = 50.0
PIXEL_MM: Final = 5e-3
NOISE_PX: Final = 0.3
HEIGHT_M: Final = 1000.0
BASE_M: Final = 200.0
DISTANCE_M: Final = 400.0


def block_of(images: int, image_points: int, seed: int = 1) -> tuple[Network, Array]:
    """A block of about that many image points, and its true projection centres."""
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
    from_x = np.argsort(ground[:, 0])
    by_x = ground[from_x, 0]
    image, point, xy = [], [], []
    for k in range(images):
        low_x, high_x = np.searchsorted(by_x, station[k, 0] + np.array([-1.2, 1.2]) * half)
        near = np.sort(from_x[low_x:high_x])
        near = near[np.abs(ground[near, 1] - station[k, 1]) < 1.2 * half]
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
    network = Network(
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
    return network, station


def with_lines(network: Network, truth_m: Array, seed: int = 2) -> Network:
    """Antenna positions of 5 and 8 cm with shift and drift of every line; free interior."""
    random = np.random.default_rng(seed)
    n = len(truth_m)
    line = np.unique(np.round(truth_m[:, 1] / DISTANCE_M), return_inverse=True)[1].astype(np.int64)
    time_s = 3.0 * np.arange(n, dtype=np.float64)
    sigma = np.tile([0.05, 0.05, 0.08], (n, 1))
    lines = int(line.max()) + 1
    shift, drift = random.normal(0.0, 0.2, (lines, 3)), random.normal(0.0, 1e-4, (lines, 3))
    since = time_s - (np.bincount(line, time_s) / np.bincount(line))[line]
    position = truth_m + shift[line] + drift[line] * since[:, None] + random.normal(0.0, sigma)
    camera = replace(
        network.cameras[0], free=frozenset({"dx0", "dy0", "df", "k1", "k2", "p1", "p2"})
    )
    gnss = Gnss(
        station=np.arange(n),
        attitude=np.arange(n),
        position_m=position,
        sigma_m=sigma,
        lever_m=np.zeros((n, 3)),
        line=line,
        time_s=time_s,
        lines=tuple(f"line{k}" for k in range(lines)),
        drift="linear",
    )
    return replace(network, cameras=(camera,), gnss=gnss)


def difference(network: Network, settings: AdjustmentSettings) -> dict[str, Any]:
    """Largest differences between results of the matrix in blocks and of the dense one."""
    dense = adjust(network, replace(settings, dense_columns=MAX_COLUMNS))
    blocks = adjust(network, replace(settings, dense_columns=0))
    own = dense.layout.station[dense.layout.station[:, 0] >= 0]
    sigma = np.sqrt(dense.cofactors.diagonal())
    moved = (blocks.state.station - dense.state.station)[dense.layout.station[:, 0] >= 0]
    points = np.isfinite(dense.point_cofactor).all(axis=(1, 2))
    spread = np.sqrt(np.einsum("pii->pi", dense.point_cofactor[points]))
    other = np.sqrt(np.einsum("pii->pi", blocks.point_cofactor[points]))
    return {
        "columns": dense.layout.columns,
        "sigma0": abs(blocks.sigma0 - dense.sigma0),
        "stations_in_sigmas": float(np.abs(moved / sigma[own]).max()),
        "sigmas_relative": float(np.abs(np.sqrt(blocks.cofactors.diagonal()) / sigma - 1.0).max()),
        "point_sigmas_relative": float(np.abs(other / spread - 1.0).max()),
        "redundancy_numbers": float(
            np.abs(blocks.redundancy_number - dense.redundancy_number).max()
        ),
    }


def measured(
    network: Network, datum: str, settings: AdjustmentSettings | None = None
) -> dict[str, Any]:
    """One adjustment with all covariances."""
    settings = settings or AdjustmentSettings()
    if datum != "control":
        nothing = np.full_like(network.points.sigma_m, np.nan)
        network = replace(network, points=replace(network.points, sigma_m=nothing))
        settings = replace(settings, minimum_norm=True, free_datum=cast(FreeDatum, datum))
    begun, cpu = time.perf_counter(), time.process_time()
    result = adjust(network, settings)
    return {
        "datum": datum,
        "images": len(network.images.names),
        "image_points": len(network.image_points.image),
        "object_points": len(network.points.names) - int(result.left_out.sum()),
        "unknowns": result.unknowns,
        "columns": result.layout.columns,
        "blocks": result.layout.order.blocks if result.layout.order else 1,
        "iterations": len(result.iterations) - 1,
        "sigma0": round(result.sigma0, 4),
        "cpu_s": round(time.process_time() - cpu, 1),
        "seconds": round(time.perf_counter() - begun, 1),
        "peak_mib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0),
    }


def building(seed: int = 4) -> Network:
    """128,000 image points of 60 images around a building, three held points, normal errors."""
    random = np.random.default_rng(seed)
    network = around_building(points=LARGE).network
    table, points = network.image_points, network.points
    rays = np.bincount(table.point, minlength=len(points.names))
    held = np.flatnonzero(rays >= 4)[[0, 700, 1400]]
    start = points.xyz_m + random.normal(0.0, 0.02, points.xyz_m.shape)
    start[held] = points.xyz_m[held]
    sigma = np.full_like(points.sigma_m, np.nan)
    sigma[held] = 0.0
    stations, attitudes = network.stations, network.attitudes
    turned = rotations_from_vectors(random.normal(0.0, 1e-3, (len(stations.names), 3)))
    moved = stations.position_m + random.normal(0.0, 0.02, stations.position_m.shape)
    noise = random.normal(0.0, NOISE_PX * PIXEL_MM, table.xy_mm.shape)
    return replace(
        network,
        stations=replace(stations, position_m=moved),
        attitudes=replace(attitudes, rotation=attitudes.rotation @ turned),
        points=replace(points, xyz_m=start, sigma_m=sigma),
        image_points=replace(table, xy_mm=table.xy_mm + noise),
    )


def compared(network: Network) -> list[dict[str, Any]]:
    """The same block here and by Ceres: CPU time to convergence, and of covariances in addition."""
    at: dict[str, float] = {}

    def note(what: str, _number: int, _squares: float) -> None:
        at.setdefault(what, time.process_time())

    begun = time.process_time()
    result = adjust(network, progress=note)
    rows = result.equations
    own = rows.group < 2
    squares = float(((result.residual[own] * rows.sigma[own]) ** 2).sum()) / PIXEL_MM**2
    here = {
        "program": "here",
        "image_points": len(network.image_points.image),
        "iterations": len(result.iterations) - 1,
        "squares_px2": squares,
        "cpu_s": round(at["covariances"] - begun, 2),
        "cpu_s_with_covariances": round(time.process_time() - begun, 2),
    }
    return [here, *(_by_ceres(network, tolerance) for tolerance in (1e-6, 1e-8))]


def _by_ceres(network: Network, tolerance: float) -> dict[str, Any]:
    import pycolmap

    with tempfile.TemporaryDirectory() as folder:
        _write_colmap(Path(folder), network)
        block = pycolmap.Reconstruction(folder)
    config = pycolmap.BundleAdjustmentConfig()
    for image in block.images:
        config.add_image(image)
    config.set_constant_cam_intrinsics(1)
    for point in np.flatnonzero((network.points.sigma_m == 0.0).all(axis=1)):
        config.add_constant_point(int(point) + 1)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    ceres = options.ceres
    ceres.auto_select_solver_type = False
    solver = ceres.solver_options
    solver.linear_solver_type = type(solver.linear_solver_type).SPARSE_SCHUR
    solver.num_threads, solver.max_num_iterations = 1, 50
    solver.function_tolerance, solver.gradient_tolerance = tolerance, 1e-14
    begun = time.process_time()
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, block)
    summary = adjuster.solve()
    converged = time.process_time()
    pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), block, adjuster)
    found = summary.ceres_summary
    return {
        "program": f"pycolmap {pycolmap.__version__}",
        "function_tolerance": tolerance,
        "iterations": found.num_successful_steps,
        "squares_px2": 2.0 * found.final_cost,
        "cpu_s": round(converged - begun, 2),
        "cpu_s_with_covariances": round(time.process_time() - begun, 2),
    }


def _write_colmap(folder: Path, network: Network) -> None:
    """The network as a text model: y of its images points down, z forward."""
    from scipy.spatial.transform import Rotation

    camera, table = network.cameras[0], network.image_points
    f, middle = camera.f_mm / PIXEL_MM, 5000.0
    (folder / "cameras.txt").write_text(f"1 PINHOLE 10000 10000 {f!r} {f!r} {middle} {middle}\n")
    pixel = middle + table.xy_mm / PIXEL_MM * np.array([1.0, -1.0])
    rotation = np.diag([1.0, -1.0, -1.0]) @ network.attitudes.rotation.transpose(0, 2, 1)
    shift = -np.einsum("nij,nj->ni", rotation, network.stations.position_m)
    tracks: list[list[str]] = [[] for _ in network.points.names]
    with (folder / "images.txt").open("w") as file:
        for k, name in enumerate(network.images.names):
            x, y, z, w = Rotation.from_matrix(rotation[k]).as_quat()
            pose = " ".join(repr(float(v)) for v in (w, x, y, z, *shift[k]))
            own = np.flatnonzero(table.image == k)
            seen = [f"{pixel[m, 0]:.9f} {pixel[m, 1]:.9f} {table.point[m] + 1}" for m in own]
            file.write(f"{k + 1} {pose} 1 {name}\n{' '.join(seen)}\n")
            for index, m in enumerate(own):
                tracks[table.point[m]].append(f"{k + 1} {index}")
    with (folder / "points3D.txt").open("w") as file:
        for k, track in enumerate(tracks):
            if track:
                place = " ".join(repr(float(v)) for v in network.points.xyz_m[k])
                file.write(f"{k + 1} {place} 0 0 0 0 {' '.join(track)}\n")


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
    parser.add_argument("--lines", action="store_true", help="GNSS lines and a free camera.")
    parser.add_argument("--robust", action="store_true", help="Huber weights first.")
    parser.add_argument("--dense", action="store_true", help="Comparison with a dense matrix.")
    parser.add_argument("--peer", action="store_true", help="Comparison with Ceres.")
    options = parser.parse_args()
    print(json.dumps({"machine": machine()}), flush=True)
    if options.peer:
        for found in compared(building()):
            print(json.dumps(found), flush=True)
        return
    network, truth_m = block_of(options.images, options.image_points)
    if options.lines:
        network = with_lines(network, truth_m)
    settings = AdjustmentSettings(robust=options.robust)
    for datum in options.datum:
        print(json.dumps(measured(network, datum, settings)), flush=True)
    if options.dense:
        print(json.dumps(difference(network, settings)), flush=True)


if __name__ == "__main__":
    main()
