"""`python -m benchmarks.rendered_block`: what matching reaches in a block of rendered frames.

The emulator renders overlapping exposures of one line or several, the pipeline makes stitched
images of them, tie points are matched between all images by correlation and least squares, and the
block is adjusted: the image residuals are those of matching and stitching, not of a random
generator.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks.rendered import (
    RenderedExposure,
    flight_and_mark,
    process,
    radiometry_of,
    world_settings,
)
from daemon.cli.benchmark.measurement import machine
from processing.bundle.adjust import Adjustment, AdjustmentSettings, adjust
from processing.bundle.adjustment_results import check_point_differences, image_residuals_mm
from processing.bundle.frame_patterns import FramePatterns
from processing.bundle.initial_values import intersect
from processing.bundle.network import (
    Attitudes,
    CameraModel,
    Gnss,
    ImagePoints,
    Images,
    MeasuredAttitudes,
    Network,
    Points,
    Stations,
)
from processing.bundle.self_calibration import SETS, SetName, parts_of, with_self_calibration
from processing.geometry.rotation import rotations_from_vectors
from processing.matching.block_matching import BlockTiePoints, image_mm, match_block, rays_of
from processing.mosaic.stitching_patterns import stitching_patterns
from processing.pipelines.stitched import Pipeline, PipelineSettings
from sim_hw.world import snapshots, true_camera
from sim_hw.world.post_processed_trajectory import marks_of_lines
from sim_hw.world.scene import open_scene
from sim_hw.world.snapshots import RigElectronics
from sim_hw.world.world import World

Array = NDArray[np.float64]

GNSS_M = 0.05
INERTIAL_RAD = 8e-5
SURVEY_M = 0.02
CONTROL = 12
JOINT_EVERY = 5
"""Of the check points, one in so many enters the joint covariance."""


@dataclass(frozen=True)
class RenderedBlock:
    """Stitched images (H, W) float32, NaN without data; where the ideal camera truly stood; the
    patterns that stitching may have left in each image."""

    world: World
    images: list[NDArray[np.float32]]
    station: Array
    rotation: Array
    patterns: tuple[FramePatterns, ...]


def rendered_block(rig: str, frames: int, lines: int, seed: int, scenes: Path) -> RenderedBlock:
    """Fly lines there and back, expose and stitch."""
    world = World(world_settings(rig, seed, exposures=frames))
    scene = open_scene(world.scene_settings, scenes)
    heads = RigElectronics(world, seed=seed)
    pipeline = Pipeline(world.rig, radiometry_of(heads), PipelineSettings(geometry=False))
    images, station, rotation, patterns = [], [], [], []
    master = world.rig.cone(world.rig.master_cone)
    flight, first_ns = flight_and_mark(world, 0)
    for k, mark_ns in enumerate(marks_of_lines(world, flight, first_ns, frames, lines)):
        exposure = RenderedExposure(world, flight, snapshots.take(world, scene, flight, mark_ns))
        product = process(pipeline, heads, exposure, seed=seed * 1000 + k)
        pan = product.pan
        images.append(np.where(pan == 0, np.nan, pan).astype(np.float32))
        patterns.append(stitching_patterns(world.rig, product.mosaic))
        pose = flight.pose(mark_ns)
        station.append(true_camera.projection_centre_m(master, pose))
        rotation.append(pose.enu_from_body @ true_camera.BODY_FROM_CAMERA)
    return RenderedBlock(world, images, np.array(station), np.array(rotation), tuple(patterns))


def match_images(block: RenderedBlock, station: Array, rotation: Array) -> BlockTiePoints:
    """Tie points of all images, predicted by navigation and level ground."""
    return match_block(lambda k: block.images[k], block.world.image, station, rotation, 0.0)


def simulate_navigation(block: RenderedBlock, seed: int) -> tuple[Array, Array]:
    """Projection centres and rotations as receiver and inertial unit have them."""
    random = np.random.default_rng([seed, 3])
    n = len(block.station)
    station = block.station + random.normal(0.0, GNSS_M, (n, 3))
    return station, block.rotation @ rotations_from_vectors(
        random.normal(0.0, INERTIAL_RAD, (n, 3))
    )


def evaluate(
    block: RenderedBlock, seed: int, found: BlockTiePoints, name: SetName, *, patterns: bool = False
) -> dict[str, Any]:
    """Adjust with a set of additional parameters, or patterns of stitching, and hold against the
    truth."""
    random = np.random.default_rng([seed, 4])
    image, n = block.world.image, len(block.station)
    rig = block.world.rig
    gnss, inertial = simulate_navigation(block, seed)
    # An image point's first row is that of the image whose feature was matched.
    _, source = np.unique(found.point, return_index=True)
    truth = np.array(
        [
            block.world.terrain.intersect(
                block.station[h], rays_of(image, block.rotation[h], px[None])[0]
            )
            for h, px in zip(found.image[source], found.px[source], strict=True)
        ]
    )
    xy = image_mm(image, found.px)
    ray = np.column_stack([xy, np.full(len(xy), -image.f_mm)])
    directions = np.einsum("nij,nj->ni", inertial[found.image], ray)
    xyz, _ = intersect(len(truth), found.point, gnss[found.image], directions)
    sigma = np.full((len(truth), 3), np.nan)
    rays = np.bincount(found.point, minlength=len(truth))
    several = np.flatnonzero(rays == 3)
    control = several[np.linspace(0, len(several) - 1, CONTROL).astype(int)]
    sigma[control] = SURVEY_M
    xyz[control] = truth[control] + random.normal(0.0, SURVEY_M, (CONTROL, 3))
    xyz = np.where(np.isfinite(xyz), xyz, truth)
    names = tuple(f"e{k + 1}" for k in range(n))
    index = np.arange(n)
    network = Network(
        cameras=(
            with_self_calibration(
                CameraModel("stitched", image.f_mm, pixel_mm=image.pitch_mm),
                name,
                parts_of(rig),
                master_cone=rig.master_cone,
            ),
        ),
        stations=Stations(names, gnss, np.zeros(n, bool)),
        attitudes=Attitudes(names, inertial, np.zeros(n, bool)),
        images=Images(names, index, index, np.zeros(n, np.int64), np.full(n, -1)),
        points=Points(
            tuple(f"p{k}" for k in range(len(truth))), xyz, sigma, np.zeros(len(truth), bool)
        ),
        image_points=ImagePoints(found.image, found.point, xy, np.full(xy.shape, 0.7e-3)),
        gnss=Gnss(
            station=index,
            attitude=index,
            position_m=gnss,
            sigma_m=np.full((n, 3), GNSS_M),
            lever_m=np.zeros((n, 3)),
            line=np.full(n, -1),
            time_s=np.zeros(n),
        ),
        measured_attitudes=MeasuredAttitudes(index, inertial, np.full((n, 3), INERTIAL_RAD)),
        patterns=block.patterns if patterns else (),
    )
    checks = np.setdiff1d(np.flatnonzero(rays >= 3), control)
    retained = checks[::JOINT_EVERY]
    begun = time.perf_counter()
    result = adjust(
        network,
        AdjustmentSettings(
            robust=True,
            reject_beyond=4.0,
            variance_components=True,
            retained=tuple(network.points.names[k] for k in retained),
        ),
    )
    adjusting_s = time.perf_counter() - begun
    residual = image_residuals_mm(result)
    good = np.isfinite(residual).all(axis=1)
    rms_um = np.sqrt(np.mean(residual[good] ** 2, axis=0)) * 1e3
    table = {g.name: g for g in result.groups}
    joint = joint_heights(result, retained[~result.left_out[retained]], truth)
    against = check_point_differences(
        result,
        [network.points.names[k] for k in checks],
        truth[checks],
        np.zeros((len(checks), 3)),
    )
    return {
        "frames": n,
        "pixels": [image.width_px, image.height_px],
        "image_points": int(good.sum()),
        "object_points": int((~result.left_out).sum()),
        "rejected": int(result.rejected.sum()),
        "adjusting_s": adjusting_s,
        "residual_rms_um": [float(v) for v in rms_um],
        "image_sigma_um": [
            0.7 * float(np.sqrt(table[name].factor)) for name in ("image x", "image y")
        ],
        "image_sigma_px": [
            0.7e-3 / image.pitch_mm * float(np.sqrt(table[name].factor))
            for name in ("image x", "image y")
        ],
        "sigma0": result.sigma0,
        "redundancy": result.redundancy,
        "checks": len(against.names),
        "check_rms_m": [float(v) for v in against.rms_m],
        "check_predicted_m": [float(v) for v in against.predicted_m],
        "check_squares": against.squares,
        "joint_height_squares": joint[0],
        "joint_heights": joint[1],
    }


def joint_heights(result: Adjustment, points: NDArray[np.int64], truth: Array) -> tuple[float, int]:
    """Squares of errors in height in their joint covariance, and their number.

    In plan a point is where its first image shows it, which has noise of its own: heights only.
    """
    columns = result.layout.retained_points[points, 2]
    error = (result.state.points - truth)[points, 2]
    covariance = result.sigma0**2 * result.cofactor[np.ix_(columns, columns)]
    return float(error @ np.linalg.solve(covariance, error)), len(points)


def compare_patterns(rig: str, frames: int, lines: int, first: int, blocks: int) -> None:
    """Print heights of several blocks without and with the patterns of stitching."""
    total = {False: [0.0, 0], True: [0.0, 0]}
    for seed in range(first, first + blocks):
        with tempfile.TemporaryDirectory(prefix="syntopic-bench-") as folder:
            block = rendered_block(rig, frames, lines, seed, Path(folder))
        found = match_images(block, *simulate_navigation(block, seed))
        for patterns in (False, True):
            f = evaluate(block, seed, found, "none", patterns=patterns)
            total[patterns][0] += f["joint_height_squares"]
            total[patterns][1] += f["joint_heights"]
            rms = " ".join(f"{v * 100:.2f}" for v in f["check_rms_m"])
            predicted = " ".join(f"{v * 100:.2f}" for v in f["check_predicted_m"])
            ratio = f["joint_height_squares"] / f["joint_heights"]
            print(
                f"block {seed} {'with' if patterns else 'without'} patterns: against truth {rms} "
                f"cm, predicted {predicted} cm, squares {f['check_squares']:.2f}, joint heights "
                f"{ratio:.2f}; {f['adjusting_s']:.1f} s",
                flush=True,
            )
    for patterns, (squares, count) in total.items():
        low, high = (float(chi2.ppf(q, count)) / count for q in (0.0005, 0.9995))
        print(
            f"{'with' if patterns else 'without'} patterns: joint heights {squares / count:.2f} "
            f"({low:.2f} to {high:.2f} holds 99.9 %)"
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.rendered_block", description=__doc__
    )
    add = parser.add_argument
    add("--rig", default="ultracam-l-mini")
    add("--frames", type=int, default=20, help="of each line")
    add("--lines", type=int, default=1, help="there and back, 30 %% apart in overlap")
    add("--seed", type=int, default=1)
    add("--blocks", type=int, help="blocks with and without patterns of stitching")
    add("--scenes", type=Path, default=None, help="folder where scenes are kept")
    add("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    if options.blocks is not None:
        compare_patterns(options.rig, options.frames, options.lines, options.seed, options.blocks)
        return
    with tempfile.TemporaryDirectory(prefix="syntopic-bench-") as folder:
        block = rendered_block(
            options.rig,
            options.frames,
            options.lines,
            options.seed,
            options.scenes or Path(folder),
        )
        found = match_images(block, *simulate_navigation(block, options.seed))
        sets = {name: evaluate(block, options.seed, found, name) for name in SETS}
    if options.json:
        print(json.dumps({"machine": machine(), "rig": options.rig, "sets": sets}))
        return
    f = sets["none"]
    print(
        f"{options.rig}, {f['frames']} rendered frames of {f['pixels'][0]} x {f['pixels'][1]}: "
        f"{f['image_points']} image points, {f['object_points']} object points, {f['checks']} of "
        "them with three rays compared with the truth"
    )
    for name, f in sets.items():
        rms = " ".join(f"{v * 100:.2f}" for v in f["check_rms_m"])
        predicted = " ".join(f"{v * 100:.2f}" for v in f["check_predicted_m"])
        print(
            f"{name:13} residuals {f['residual_rms_um'][0]:.3f} {f['residual_rms_um'][1]:.3f} um, "
            f"sigma of an image coordinate {f['image_sigma_um'][0]:.3f} "
            f"{f['image_sigma_um'][1]:.3f} um = {f['image_sigma_px'][0]:.4f} "
            f"{f['image_sigma_px'][1]:.4f} px, {f['rejected']} left out; against truth {rms} cm, "
            f"predicted {predicted} cm, squares {f['check_squares']:.2f}; {f['adjusting_s']:.1f} s"
        )


if __name__ == "__main__":
    main()
