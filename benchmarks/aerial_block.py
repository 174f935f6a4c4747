"""`python -m benchmarks.aerial_block`: the UltraCam L block, adjusted at full count.

The emulator flies 296 frames in six lines and three cross strips and plants a systematic pattern
of 2 um; the block is adjusted with each set of additional parameters and compared with the truth.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from daemon.cli.benchmark.measurement import machine
from daemon.postflight.adjustment.adjustment_plots import ResidualPanel, pattern_svg
from processing.bundle.adjust import Adjustment, AdjustmentSettings, adjust
from processing.bundle.adjustment_results import (
    PointDifferences,
    ResidualPattern,
    check_point_differences,
    parameters_of,
    systematic_residuals,
)
from processing.bundle.camera_model import ideal_mm
from processing.bundle.initial_values import intersect
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
from processing.bundle.self_calibration import (
    SETS,
    SetName,
    parameter_count,
    parts_of,
    with_self_calibration,
)
from processing.rig import find_rig
from sim_hw.blocks.aerial import (
    AerialBlock,
    image_grid,
    residuals_after_orientation,
    simulate_block,
    small_plan,
    ultracam_l_plan,
)

Array = NDArray[np.float64]

CELLS = (14, 10)


@dataclass(frozen=True)
class AdjustedBlock:
    """One adjustment of a block, compared with the truth."""

    name: SetName
    result: Adjustment | None
    figures: dict[str, Any]
    checks: PointDifferences
    pattern: ResidualPattern


def network_of(block: AerialBlock, name: SetName) -> Network:
    """What an aerotriangulation is given of a block: measurements, control, navigation."""
    plan, n = block.plan, len(block.names)
    rig = find_rig(plan.rig)
    camera = with_self_calibration(
        CameraModel("stitched", plan.frame.f_mm, pixel_mm=plan.frame.pixel_mm),
        name,
        parts_of(rig),
        master_cone=rig.master_cone,
    )
    lever = np.tile(np.array(plan.lever_m), (n, 1))
    start = block.antenna_m - np.einsum("nij,nj->ni", block.start_rotation, lever)
    ray = np.column_stack([block.xy_mm, np.full(len(block.xy_mm), -plan.frame.f_mm)])
    direction = np.einsum("nij,nj->ni", block.start_rotation[block.image], ray)
    points = len(block.true_points)
    xyz, _ = intersect(points, block.point, start[block.image], direction)
    # A point that no two images see takes no part, wherever it is put.
    xyz = np.where(np.isfinite(xyz), xyz, 0.0)
    sigma = np.full((points, 3), np.nan)
    xyz[: plan.control] = block.survey_m[: plan.control]
    sigma[: plan.control] = plan.errors.survey_m
    index = np.arange(n)
    e = plan.errors
    return Network(
        cameras=(camera,),
        stations=Stations(block.names, start, np.zeros(n, bool)),
        attitudes=Attitudes(block.names, block.start_rotation, np.zeros(n, bool)),
        images=Images(block.names, index, index, np.zeros(n, np.int64), np.full(n, -1)),
        points=Points(tuple(f"p{k}" for k in range(points)), xyz, sigma, np.zeros(points, bool)),
        image_points=ImagePoints(
            block.image, block.point, block.xy_mm, np.full(block.xy_mm.shape, e.image_mm)
        ),
        gnss=Gnss(
            station=index,
            attitude=index,
            position_m=block.antenna_m,
            sigma_m=np.tile([e.gnss_m[0], e.gnss_m[0], e.gnss_m[1]], (n, 1)),
            lever_m=lever,
            line=block.strip,
            time_s=block.time_s,
            lines=tuple(s.name for s in plan.strips),
            drift="linear",
        ),
    )


def evaluate(block: AerialBlock, name: SetName) -> AdjustedBlock:
    """Adjust a block with a set of additional parameters and hold it against the truth."""
    begun, cpu = time.perf_counter(), time.process_time()
    network = network_of(block, name)
    result = adjust(network, AdjustmentSettings())
    seconds, cpu = time.perf_counter() - begun, time.process_time() - cpu
    plan = block.plan
    rows = slice(plan.control, plan.control + plan.checks)
    checks = check_point_differences(
        result,
        network.points.names[rows],
        block.survey_m[rows],
        np.full((plan.checks, 3), plan.errors.survey_m),
    )
    camera = network.cameras[0]
    places = image_grid(plan.frame, 30, 20)
    corrected = ideal_mm(camera, result.state.interior[0], result.state.terms[0], places)
    # Measured is ideal plus pattern; the correction should be its opposite.
    left = residuals_after_orientation(
        plan.frame, places, corrected - places + block.pattern.at(places)
    )
    seen = systematic_residuals(result, 0, CELLS)
    pixel_m = plan.frame.pixel_mm * plan.strips[0].height_m / plan.frame.f_mm
    n = 3 * len(checks.names)
    low, high = (float(stats.chi2.ppf(level, n)) / n for level in (0.0005, 0.9995))
    used = result.weight > 0.0
    used &= ~result.left_out[block.point]
    per_image = np.bincount(block.image[used], minlength=len(block.names))
    true_error = result.state.points[rows] - block.true_points[rows]
    figures = {
        "parameters": parameter_count(camera),
        "dispensable": sum(p.is_insignificant for p in parameters_of(result)),
        "seconds": seconds,
        "cpu_s": cpu,
        "iterations": len(result.iterations) - 1,
        "images": len(block.names),
        "image_points": int(used.sum()),
        "least_points_per_image": int(per_image.min()),
        "object_points": int((~result.left_out).sum()),
        "observations": result.observations,
        "unknowns": result.unknowns,
        "redundancy": result.redundancy,
        "sigma0": result.sigma0,
        "sigma0_um": result.sigma0 * plan.errors.image_mm * 1e3,
        "checks": len(checks.names),
        "check_rms_m": [float(v) for v in checks.rms_m],
        "check_predicted_m": [float(v) for v in checks.predicted_m],
        "check_rms_px": [float(v) / pixel_m for v in checks.rms_m],
        "check_plan_px": float(np.sqrt(np.mean(checks.difference_m[:, :2] ** 2))) / pixel_m,
        "check_squares": checks.squares,
        "check_squares_bounds": [low, high],
        "true_rms_m": [float(v) for v in np.sqrt(np.mean(true_error**2, axis=0))],
        "left_rms_um": float(np.sqrt(np.mean(np.sum(left**2, axis=1)))) * 1e3,
        "left_max_um": float(np.hypot(*left.T).max()) * 1e3,
        "residual_pattern_rms_um": float(np.sqrt(np.mean(np.sum(seen.mean_mm**2, axis=1)))) * 1e3,
        "residual_pattern_max_um": float(np.hypot(*seen.mean_mm.T).max()) * 1e3,
    }
    return AdjustedBlock(name, result, figures, checks, seen)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.aerial_block", description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--small", action="store_true", help="30 frames instead of 296")
    parser.add_argument("--set", choices=SETS, default=None, help="one set only")
    parser.add_argument("--drawing", type=Path, default=None, help="where to draw fig. 10 (SVG)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    block = simulate_block(small_plan() if options.small else ultracam_l_plan(), options.seed)
    found: list[AdjustedBlock] = []
    for name in SETS if options.set is None else (options.set,):
        # The adjusted network itself is let go: memory is that of one adjustment.
        found.append(replace(evaluate(block, name), result=None))
        if not options.json:
            _print(found[-1], first=len(found) == 1)
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    if options.drawing is not None:
        shown = [j for j in found if j.name in ("radial", "sensors-full")] or found
        options.drawing.parent.mkdir(parents=True, exist_ok=True)
        options.drawing.write_text(_drawn(block, shown))
    if options.json:
        content = {
            "machine": machine(),
            "peak_mib": peak_mib,
            "sets": {j.name: j.figures for j in found},
        }
        print(json.dumps(content))
    else:
        print(f"peak resident memory of the process {peak_mib:.0f} MiB")


def _print(j: AdjustedBlock, *, first: bool) -> None:
    f = j.figures
    if first:
        print(
            f"{f['images']} images, {f['image_points']} image points (at least "
            f"{f['least_points_per_image']} in each), {f['object_points']} object points, "
            f"{f['checks']} check points"
        )
    rms = " ".join(f"{v * 100:.2f}" for v in f["check_rms_m"])
    predicted = " ".join(f"{v * 100:.2f}" for v in f["check_predicted_m"])
    print(
        f"{j.name:13} {f['parameters']:3} parameters: sigma0 {f['sigma0_um']:.4f} um "
        f"(redundancy {f['redundancy']}); checks RMS {rms} cm, predicted {predicted} cm, "
        f"plan {f['check_plan_px']:.3f} px, height {f['check_rms_px'][2]:.3f} px, squares "
        f"{f['check_squares']:.2f} ({f['check_squares_bounds'][0]:.2f} to "
        f"{f['check_squares_bounds'][1]:.2f}); pattern left {f['left_rms_um']:.3f} um RMS, "
        f"{f['left_max_um']:.3f} um at most; seen in residuals "
        f"{f['residual_pattern_max_um']:.3f} um at most; {f['seconds']:.1f} s "
        f"({f['cpu_s']:.1f} s CPU), {f['iterations']} iterations"
    )


def _drawn(block: AerialBlock, panels: Sequence[AdjustedBlock]) -> str:
    frame = block.plan.frame
    half = (frame.half_width_mm, frame.half_height_mm)
    return pattern_svg(
        [
            ResidualPanel(
                f"{j.name}, {j.figures['parameters']} parameters: at most "
                f"{j.figures['residual_pattern_max_um']:.2f} um",
                j.pattern,
                half,
            )
            for j in panels
        ],
        f"Systematic image residuals after bundle adjustment, {len(block.names)} frames",
    )


if __name__ == "__main__":
    main()
