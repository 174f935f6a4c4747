"""Honest uncertainty of `calibrate lab`: seeds of rigs and test fields, errors in their covariance.

    python -m benchmarks.laboratory_field ultracam-l-mini --seeds 50

Image coordinates go through the emulator's projection with noise; measurement on frames is tested
apart. One line a seed on stderr, the pooled figures as JSON on stdout.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from daemon.postflight.calibration.laboratory.calibration_field import RigCalibration, calibrate_rig
from daemon.postflight.calibration.laboratory.field_measurement import (
    FieldExposure,
    TargetField,
    TargetObservations,
)
from daemon.postflight.calibration.laboratory.field_report import (
    EstimatedParameter,
    covariance_of,
    estimated_parameters,
)
from processing.geometry.rotation import rotation_matrix, vectors_from_rotations
from processing.rig import Rig, find_rig
from sim_hw.laboratory import calibration_field

Array = NDArray[np.float64]

NOISE_PX = 0.005


@dataclass(frozen=True)
class PooledErrors:
    """Squared errors in their covariances, how many, and the standardised ones."""

    squares: float
    count: int
    standardised: Array

    @property
    def mean(self) -> float:
        return self.squares / self.count

    @property
    def interval(self) -> tuple[float, float]:
        low, high = (float(chi2.ppf(p, self.count)) for p in (0.0005, 0.9995))
        return low / self.count, high / self.count


def calibrate_sample(
    rig: Rig, seed: int, *, exposures: int, targets: tuple[int, int]
) -> tuple[RigCalibration, calibration_field.TrueRig]:
    """One rig, one field, one calibration from image coordinates."""
    truth = calibration_field.true_rig(rig, seed)
    plan = calibration_field.plan_for(rig, exposures)
    xyz = calibration_field.targets(seed, targets, plan.size_m, plan.depth_m)
    random = np.random.default_rng(seed)
    sigma = calibration_field.SURVEY_SIGMA_M
    field = TargetField(
        tuple(f"T{k}" for k in range(len(xyz))),
        xyz + random.normal(0.0, sigma, xyz.shape),
        np.full(len(xyz), sigma),
    )
    observations: list[tuple[int, int, NDArray[np.int64], Array]] = []
    field_exposures = []
    for k, (place, rotation) in enumerate(
        calibration_field.poses(seed, exposures, plan.distance_m)
    ):
        field_exposures.append(FieldExposure(f"E{k}", {}, place, rotation, {}))
        for j, sensor in enumerate(rig.sensors):
            cone = rig.cone_of(sensor.name)
            index, px = calibration_field.seen(truth, cone, sensor, place, rotation, xyz)
            observations.append((k, j, index, px + random.normal(0.0, NOISE_PX, px.shape)))
    table = TargetObservations(
        np.concatenate([np.full(len(i), k) for k, _, i, _ in observations]),
        np.concatenate([np.full(len(i), j) for _, j, i, _ in observations]),
        np.concatenate([i for _, _, i, _ in observations]),
        np.concatenate([p for _, _, _, p in observations]),
    )
    found = calibrate_rig(
        rig,
        field_exposures,
        field,
        table,
        offset_sigma_mm=calibration_field.OFFSET_MM,
        skew_sigma_per_mm=calibration_field.SKEW_PER_MM,
        progress=lambda _what, _done, _total: None,
    )
    return found, truth


def errors_of(
    found: RigCalibration, truth: calibration_field.TrueRig
) -> tuple[list[EstimatedParameter], Array]:
    """What was estimated, and estimated less true in the adjustment's units."""
    rows = estimated_parameters(found)
    errors = []
    for row in rows:
        if row.where.startswith("cone "):
            cone = found.rig.cone(row.where[5:])
            if row.what in ("omega", "phi", "kappa"):
                rotation = rotation_matrix(*cone.rotation_rad).T @ truth.master_from_cone(
                    truth.rig.cone(cone.name)
                )
                axis = ("omega", "phi", "kappa").index(row.what)
                errors.append(-float(vectors_from_rotations(rotation)[axis]))
            else:
                errors.append(row.value - float(getattr(truth.rig.cone(cone.name).lens, row.what)))
            continue
        was, true = found.before.sensor(row.where), truth.sensors[row.where]
        value = {
            "x": was.x_mm + true.shift[0],
            "y": was.y_mm + true.shift[1],
            "rotation": was.rotation_rad + true.rotation,
            "scale": was.scale * (1.0 + true.scale) - 1.0,
            "skew x": was.skew_per_mm[0] + true.skew[0],
            "skew y": was.skew_per_mm[1] + true.skew[1],
        }[row.what]
        errors.append(row.value - value)
    return rows, np.array(errors)


def pooled(
    rig: Rig, seeds: range, *, exposures: int, targets: tuple[int, int], verbose: bool = False
) -> PooledErrors:
    squares, count, standardised = 0.0, 0, []
    for seed in seeds:
        begun = time.process_time()
        found, truth = calibrate_sample(rig, seed, exposures=exposures, targets=targets)
        rows, error = errors_of(found, truth)
        covariance = covariance_of(found, rows)
        scale = 1.0 / np.sqrt(np.diag(covariance))
        own = float(
            (error * scale) @ np.linalg.solve(covariance * scale[:, None] * scale, error * scale)
        )
        squares += own
        count += len(rows)
        standardised.append(error * scale)
        if verbose:
            print(
                f"seed {seed}: {own / len(rows):.2f}, sigma {found.sigma_px:.4f} px, "
                f"{len(found.observations.px)} points, {time.process_time() - begun:.1f} s",
                file=sys.stderr,
                flush=True,
            )
    return PooledErrors(squares, count, np.concatenate(standardised))


def main() -> None:
    line = argparse.ArgumentParser(description=__doc__)
    line.add_argument("rig")
    line.add_argument("--seeds", type=int, default=50)
    line.add_argument("--exposures", type=int, default=12)
    line.add_argument("--targets", type=int, default=16, help="across and down")
    line.add_argument("--out", type=Path, help="write the figures here as well")
    given = line.parse_args()
    result = pooled(
        find_rig(given.rig),
        range(1, given.seeds + 1),
        exposures=given.exposures,
        targets=(given.targets, given.targets),
        verbose=True,
    )
    size = np.abs(result.standardised)
    figures = {
        "rig": given.rig,
        "seeds": given.seeds,
        "mean_square": result.mean,
        "interval": result.interval,
        "errors": result.count,
        "within_three": float(np.mean(size <= 3.0)),
        "largest": float(size.max()),
    }
    text = json.dumps(figures)
    if given.out:
        given.out.write_text(text)
    print(text)


if __name__ == "__main__":
    main()
