"""`python -m benchmarks.dmc_platform`: are the nine angles of converging heads as good as stated?

Fifty cameras whose mounting, places and drift are off their calibration within the tolerances of
the rig file. Tie points are drawn where the emulator's true camera sees the same ground, with
Gaussian noise; the turns found are compared with the true ones, the common turn taken out (nine of
twelve angles).
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks import rendered
from benchmarks.stitching_samples import same_ground, world_and_rig
from processing.geometry.conditions import Conditions, for_sensors
from processing.geometry.placement import nominal_placements, raw_from_vip_mm
from processing.geometry.rotation import rotation_matrix
from processing.geometry.topology import overlaps
from processing.geometry.virtual_camera import ground_plane
from processing.matching.tie_points import PAN_TO_PAN, TiePoints
from processing.mosaic.mounting import check_platform
from processing.mosaic.pan_only import pan_only_mosaic
from processing.rig import Rig
from sim_hw.world.snapshots import exposure_parameters_of, probe_readings
from sim_hw.world.true_camera import rotation_opk
from sim_hw.world.world import World

Array = NDArray[np.float64]

SEEDS = 50
POINTS = 200
NOISE_PX = 0.05
"""Of one coordinate of a difference; matching reaches 0.02 px on emulated ground."""
DC_K = 12.0


@dataclass(frozen=True)
class PlatformSample:
    """Nine contrasts between the turns of four heads: found minus true over their covariance."""

    square: float
    rank: int
    normalised: Array
    error_rad: Array
    sigma_rad: Array


def sample_platform(name: str, seed: int) -> PlatformSample:
    """One camera, one exposure."""
    world, rig = world_and_rig(name, seed, dc_k=DC_K, exposures=1)
    flight, mark_ns = rendered.flight_and_mark(world, 0)
    looks = {
        s.name: exposure_parameters_of(world, cone, mark_ns)
        for cone in rig.cones
        for s in cone.sensors
    }
    probes = probe_readings(world, mark_ns, seed=seed)
    pose = flight.pose(mark_ns)
    conditions = Conditions(
        height_above_ground_m=world.plan.height_above_ground_m,
        roll_rad=pose.roll_rad,
        pitch_rad=pose.pitch_rad,
    )
    start = nominal_placements(
        rig, probes, for_sensors(rig, world.plan.tdi_shifts), ground=ground_plane(rig, conditions)
    )
    random = np.random.default_rng([seed, 11])
    names = tuple(s.name for s in rig.sensors)
    raw_a, raw_b, index = [], [], []
    strips = overlaps(rig)
    for number, strip in enumerate(strips):
        a, b, box = strip.sensor_a, strip.sensor_b, strip.rectangle
        xy = np.stack(
            [
                random.uniform(box.x_min_mm, box.x_max_mm, 2 * POINTS),
                random.uniform(box.y_min_mm, box.y_max_mm, 2 * POINTS),
            ],
            axis=1,
        )
        at_a, at_b = raw_from_vip_mm(start[a], xy), raw_from_vip_mm(start[b], xy)
        sees = _on(rig, a, at_a) & _on(rig, b, at_b)
        at_a, at_b = at_a[sees][:POINTS], at_b[sees][:POINTS]
        at_b = same_ground(world, flight, looks, (a, at_a), (b, at_b))
        raw_a.append(at_a)
        raw_b.append(at_b + random.normal(0.0, NOISE_PX, at_b.shape))
        index.append(np.full(len(at_a), number))
    overlap = np.concatenate(index)
    sides = np.array([[names.index(s.sensor_a), names.index(s.sensor_b)] for s in strips])
    points = TiePoints(
        names=names,
        pairs=tuple((s.sensor_a, s.sensor_b) for s in strips),
        attempted=tuple(len(i) for i in index),
        sensor_a=sides[overlap, 0],
        sensor_b=sides[overlap, 1],
        raw_a=np.concatenate(raw_a),
        raw_b=np.concatenate(raw_b),
        sigma_px=np.full(len(overlap), NOISE_PX),
        correlation=np.ones(len(overlap)),
        kind=np.full(len(overlap), PAN_TO_PAN),
        overlap=overlap,
    )
    check = check_platform(rig, pan_only_mosaic(rig, start, points), points, probes)
    if check is None:
        raise RuntimeError(f"seed {seed}: the mountings could not be adjusted")
    contrasts = np.kron(np.linalg.svd(np.ones((1, len(check.heads))))[2][1:], np.eye(3))
    found = np.concatenate([head.correction_rad for head in check.heads])
    error = contrasts @ (found - true_rotations(world, rig))
    covariance = contrasts @ check.covariance @ contrasts.T
    sigma = np.sqrt(np.diag(covariance))
    return PlatformSample(
        square=float(error @ np.linalg.solve(covariance, error)),
        rank=len(error),
        normalised=error / sigma,
        error_rad=error,
        sigma_rad=sigma,
    )


def true_rotations(world: World, rig: Rig) -> Array:
    """What the emulator turned the heads by, about the axes of the virtual image, (3 n,) rad."""
    rotations = []
    for cone in rig.pan_cones:
        calibrated = rotation_matrix(*cone.rotation_rad)
        error = rotation_opk(world.camera.mounting_error_rad[cone.name])
        rotation = calibrated @ error @ calibrated.T
        rotations += [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    return np.array(rotations) / 2.0


def pooled(samples: list[PlatformSample]) -> dict[str, float | int]:
    """Errors squared in their covariance, and errors in sigmas, over all trials."""
    rank = sum(t.rank for t in samples)
    normalised = np.abs(np.concatenate([t.normalised for t in samples]))
    errors = np.concatenate([t.error_rad for t in samples])
    return {
        "samples": len(samples),
        "rank": rank,
        "mean_square": sum(t.square for t in samples) / rank,
        "low": float(chi2.ppf(0.0005, rank)) / rank,
        "high": float(chi2.ppf(0.9995, rank)) / rank,
        "inside_3_sigma": float(np.mean(normalised < 3.0)),
        "largest": float(normalised.max()),
        "rms_error_urad": float(np.sqrt(np.mean(errors**2))) * 1e6,
        "rms_sigma_urad": float(
            np.sqrt(np.mean(np.concatenate([t.sigma_rad for t in samples]) ** 2))
        )
        * 1e6,
    }


def _on(rig: Rig, name: str, raw: Array) -> NDArray[np.bool_]:
    sensor = rig.sensor(name)
    last = np.array([sensor.width_px - 1, sensor.height_px - 1])
    return np.asarray(((raw >= 10) & (raw <= last - 10)).all(axis=1))


def main() -> None:
    line = argparse.ArgumentParser(prog="python -m benchmarks.dmc_platform", description=__doc__)
    line.add_argument("--rig", default="dmc-mini")
    line.add_argument("--seeds", type=int, default=SEEDS)
    line.add_argument("--out", type=Path, help="write the figures there as JSON")
    given = line.parse_args()
    figures = pooled([sample_platform(given.rig, 1 + k) for k in range(given.seeds)])
    print(json.dumps(figures, indent=1))
    if given.out is not None:
        given.out.write_text(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
