"""`python -m benchmarks.ultracam_platform`: cones turned against the master's, from whole flights.

Cameras whose mounting, places and drift are off their calibration within the tolerances of the rig
file, each flown there and back. Tie points are drawn where the emulator's true cones see the same
ground at their own instants, with noise and bias of matching; the turns that `syntopic calibrate
platform` finds are compared with the true ones. `--calibration` compares one from rendered frames
instead.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks import rendered
from benchmarks.stitching_samples import mosaic_settings, world_and_rig
from benchmarks.ultracam_l import tie_points
from daemon.cli.benchmark.measurement import machine
from processing.calibration.platform import (
    COLOUR_ROTATION_PX,
    COLOUR_SHIFT_PX,
    PlatformCalibration,
    calibrate_platform,
)
from processing.geometry.conditions import for_sensors
from processing.geometry.placement import nominal_placements
from processing.matching.tie_points import PAN_TO_COLOUR, TiePoints
from processing.mosaic.free_mosaic import free_mosaic
from processing.mosaic.stitch_record import StitchRecord, stitch_record
from processing.rig import Rig
from sim_hw.world.post_processed_trajectory import marks_of_lines
from sim_hw.world.snapshots import exposure_parameters_of, probe_readings
from sim_hw.world.true_camera import rotation_opk
from sim_hw.world.world import World

Array = NDArray[np.float64]

DC_K = 6.0
LINES = 2
POINTS_PER_OVERLAP, POINTS_PER_SENSOR = 60, 150


def fly_platform(name: str, seed: int, exposures: int) -> tuple[World, PlatformCalibration]:
    """One camera and what one flight of `exposures` on each line finds of it."""
    world, rig = world_and_rig(name, seed, dc_k=DC_K, exposures=exposures)
    flight, first_ns = rendered.flight_and_mark(world, 0)
    random = np.random.default_rng([seed, 13])
    settings = mosaic_settings(world)
    left = np.random.default_rng([seed, 17])
    bias = left.normal(0.0, (COLOUR_SHIFT_PX, COLOUR_SHIFT_PX, COLOUR_ROTATION_PX))
    records: list[StitchRecord] = []
    for mark_ns in marks_of_lines(world, flight, first_ns, exposures, LINES):
        looks = {cone.name: exposure_parameters_of(world, cone, mark_ns) for cone in rig.cones}
        probes = probe_readings(world, mark_ns, seed=seed * 1000 + len(records))
        start = nominal_placements(rig, probes, for_sensors(rig, world.plan.tdi_shifts))
        points = tie_points(
            world,
            flight,
            looks,
            start,
            random,
            per_overlap=POINTS_PER_OVERLAP,
            per_sensor=POINTS_PER_SENSOR,
        )
        points = biased(rig, points, bias)
        mosaic = free_mosaic(rig, start, points, settings=settings)
        height_m = world.plan.height_above_ground_m
        records.append(stitch_record(rig, mosaic, probes, probes, height_m=height_m))
    return world, calibrate_platform(rig, records)


def biased(rig: Rig, points: TiePoints, bias: Array) -> TiePoints:
    """P/C points with what matching leaves in every exposure alike: a shift (column, row) of the
    colour master's pixels, and a turn by so much at its corners."""
    green = rig.sensor(points.names[points.sensor_b[points.kind == PAN_TO_COLOUR][0]])
    size = np.array([green.width_px, green.height_px])
    arm = (points.raw_b - (size - 1) / 2.0) / (np.hypot(*size) / 2.0)
    off = bias[:2] + bias[2] * np.stack([-arm[:, 1], arm[:, 0]], axis=1)
    return replace(points, raw_b=points.raw_b + off * (points.kind == PAN_TO_COLOUR)[:, None])


def true_rotation(master_from_cone: Array, mounting_error_rad: tuple[float, float, float]) -> Array:
    """What the emulator turned a cone by, about the axes of the virtual image, (3,) rad."""
    rotation = master_from_cone @ rotation_opk(mounting_error_rad) @ master_from_cone.T
    return (
        np.array(
            [
                rotation[2, 1] - rotation[1, 2],
                rotation[0, 2] - rotation[2, 0],
                rotation[1, 0] - rotation[0, 1],
            ]
        )
        / 2
    )


def evaluate(name: str, seeds: int, exposures: int) -> dict[str, Any]:
    """By cone: errors of the turns in their covariance over `seeds` flights."""
    squares: dict[str, float] = {}
    ratios: dict[str, list[Array]] = {}
    errors: dict[str, list[Array]] = {}
    stated: dict[str, list[Array]] = {}
    for seed in range(1, seeds + 1):
        world, found = fly_platform(name, seed, exposures)
        for cone in found.cones:
            true = world.camera.master_from_cone(world.rig.cone(cone.cone))
            error = cone.correction_rad - true_rotation(
                true, world.camera.mounting_error_rad[cone.cone]
            )
            own = float(error @ np.linalg.solve(cone.covariance, error))
            squares[cone.cone] = squares.get(cone.cone, 0.0) + own
            ratios.setdefault(cone.cone, []).append(error / np.sqrt(np.diag(cone.covariance)))
            errors.setdefault(cone.cone, []).append(error)
            stated.setdefault(cone.cone, []).append(np.diag(cone.covariance))
        output = ", ".join(f"{c} {3.0 * v / seed / 9.0:.2f}" for c, v in squares.items())
        print(f"flight {seed}: squares per rank so far: {output}", file=sys.stderr, flush=True)
    return {
        cone: {
            "errors": 3 * len(ratios[cone]),
            "squares_per_rank": squares[cone] / (3 * len(ratios[cone])),
            "bounds": [
                float(chi2.ppf(p, 3 * len(ratios[cone]))) / (3 * len(ratios[cone]))
                for p in (0.0005, 0.9995)
            ],
            "within_3_sigma": float(np.mean(np.abs(ratios[cone]) < 3.0)),
            "largest": float(np.max(np.abs(ratios[cone]))),
            "rms_error_urad": (np.sqrt(np.mean(np.square(errors[cone]), axis=0)) * 1e6).tolist(),
            "rms_sigma_urad": (np.sqrt(np.mean(stated[cone], axis=0)) * 1e6).tolist(),
        }
        for cone in squares
    }


def compare_with_truth(calibration: Path, truth: Path) -> dict[str, Any]:
    """Turns of a `calibration.json` less those of the emulator's truth, urad."""
    found = json.loads((calibration / "calibration.json").read_text())["figures"]
    cones = json.loads((truth / "parameters.json").read_text())["cones"]
    output = {}
    for cone, rotation in found["rotation_urad"].items():
        true = cones[cone]
        error = true_rotation(np.array(true["master_from_cone"]), true["mounting_error_rad"])
        output[cone] = {
            "error_urad": (np.array(rotation) - error * 1e6).tolist(),
            "sigma_urad": found["turn_sigma_urad"][cone],
            "with_places_urad": found["with_places_urad"][cone],
        }
    return output


def main() -> None:
    line = argparse.ArgumentParser(
        prog="python -m benchmarks.ultracam_platform", description=__doc__
    )
    line.add_argument("--rig", default="ultracam-l-mini")
    line.add_argument("--seeds", type=int, default=50)
    line.add_argument("--exposures", type=int, default=12, help="of each of two lines")
    line.add_argument("--calibration", type=Path, help="compare this one of rendered exposures")
    line.add_argument("--truth", type=Path, help="truth folder of those exposures")
    given = line.parse_args()
    if given.calibration is not None:
        print(json.dumps(compare_with_truth(given.calibration, given.truth), indent=1))
        return
    figures = evaluate(given.rig, given.seeds, given.exposures)
    output = {"machine": machine(), "rig": given.rig, "flights": given.seeds, "cones": figures}
    print(json.dumps(output, indent=1))


if __name__ == "__main__":
    main()
