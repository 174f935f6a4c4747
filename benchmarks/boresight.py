"""`python -m benchmarks.boresight`: boresight, lever arm, time offset against truth, many flights.

Each flight is adjusted with its control alone, its orientations are compared with the inertial
ones, and errors are compared with their covariances.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from daemon.cli.benchmark.measurement import machine
from daemon.postflight.adjustment.csv_tables import write_table
from daemon.postflight.adjustment.project import CheckPoints
from daemon.postflight.adjustment.project_file import ProjectFile
from daemon.postflight.adjustment.project_writer import write_project
from daemon.postflight.calibration.boresight_calibration import controlled_of
from processing.bundle.adjust import adjust
from processing.bundle.initial_values import completed
from processing.bundle.network import (
    Attitudes,
    CameraModel,
    ImagePoints,
    Images,
    Network,
    Points,
    Stations,
)
from processing.calibration.boresight import (
    PARAMETER_SCALES,
    BoresightCalibration,
    InertialOrientations,
    calibrate_boresight,
    mounting_of,
)
from processing.geometry.orientation import BODY_FROM_CAMERA, ENU_FROM_NED
from processing.geometry.rotation import level_from_body, vectors_from_rotations
from sim_hw.blocks.calibration_flight import (
    F_MM,
    FULL,
    ONE_WAY,
    PIXEL_MM,
    CalibrationFlight,
    CalibrationLine,
    simulate_calibration_flight,
)

Array = NDArray[np.float64]

LEVEL_FLIGHT_LEVER_SIGMA_M = 0.02


def network_of(flight: CalibrationFlight) -> Network:
    """Images and control, started from the inertial orientation."""
    n, points = len(flight.centre_m), len(flight.points)
    start = np.array([ENU_FROM_NED @ level_from_body(*a) @ BODY_FROM_CAMERA
                      for a in flight.angles_rad])  # fmt: skip
    xyz, sigma = np.full((points, 3), np.nan), np.full((points, 3), np.nan)
    xyz[: flight.control] = flight.surveyed_m
    sigma[: flight.control] = flight.spread.control_m
    names = tuple(f"{k + 1:06d}" for k in range(n))
    free = np.zeros(n, dtype=bool)
    every = np.arange(n)
    return Network(
        cameras=(CameraModel("stitched", F_MM, pixel_mm=PIXEL_MM),),
        stations=Stations(names, flight.position_m, free),
        attitudes=Attitudes(names, start, free),
        images=Images(names, every, every, np.zeros(n, np.int64), np.full(n, -1)),
        points=Points(tuple(f"p{k}" for k in range(points)), xyz, sigma, np.zeros(points, bool)),
        image_points=ImagePoints(
            flight.image, flight.point, flight.xy_mm,
            np.full(flight.xy_mm.shape, flight.spread.image_mm),
        ),
    )  # fmt: skip


def inertial_of(flight: CalibrationFlight) -> InertialOrientations:
    return InertialOrientations(
        flight.position_m,
        flight.velocity_mps,
        np.array([ENU_FROM_NED @ level_from_body(*a) for a in flight.angles_rad]),
        flight.rate_rad_per_s,
        np.array(flight.spread.position_m),
        np.array(flight.spread.attitude_rad),
    )


def write_flight(flight: CalibrationFlight, folder: Path) -> None:
    """The flight as an adjustment project with `inertial.csv`, as a person would hand it over."""
    file = ProjectFile.model_validate(
        {
            "format": 1,
            "name": "calibration flight",
            "camera": [{"name": "stitched", "f_mm": F_MM, "pixel_um": PIXEL_MM * 1e3}],
        }
    )
    nothing = np.zeros((0, 3))
    write_project(folder, file, completed(network_of(flight)), CheckPoints((), nothing, nothing))
    write_table(
        folder / "inertial.csv",
        "Antenna positions and inertial attitudes at the marks of the exposures.",
        (
            *("exposure", "x_m", "y_m", "z_m", "vx_mps", "vy_mps", "vz_mps"),
            *("roll_deg", "pitch_deg", "heading_deg"),
            *("rate_forward_deg_s", "rate_right_deg_s", "rate_down_deg_s"),
        ),
        (
            (f"{k + 1:06d}", *row)
            for k, row in enumerate(
                np.hstack(
                    [
                        flight.position_m,
                        flight.velocity_mps,
                        np.degrees(flight.angles_rad),
                        np.degrees(flight.rate_rad_per_s),
                    ]
                )
            )
        ),
    )


def error_of(found: BoresightCalibration, flight: CalibrationFlight) -> Array:
    """Found less true, (10,), rad, m, s, in the order of the parameters."""
    truth = level_from_body(*flight.boresight_rad)
    rotation = vectors_from_rotations(truth.T @ found.mounting.imu_from_body)
    return np.concatenate(
        [
            rotation,
            found.mounting.antenna_m - flight.antenna_m,
            [found.mounting.time_offset_s - flight.time_offset_s],
            found.mounting.shift_m - flight.shift_m,
        ]
    )


def evaluate(
    seed: int, lines: tuple[CalibrationLine, ...], **how: Any
) -> tuple[BoresightCalibration, Array, float, int]:
    """One flight: what was found, its error, squares in its covariance, and their rank."""
    flight = simulate_calibration_flight(seed, lines)
    result = adjust(completed(network_of(flight)))
    surveyed = flight.antenna_m + np.random.default_rng([seed, 8]).normal(
        0.0, LEVEL_FLIGHT_LEVER_SIGMA_M, 3
    )
    given = mounting_of(surveyed, np.zeros(3))
    found = calibrate_boresight(
        controlled_of(result, tuple(range(len(flight.centre_m)))), inertial_of(flight), given, **how
    )
    error = error_of(found, flight)
    seen = found.basis.T @ (error / PARAMETER_SCALES)
    within = (
        found.basis.T
        @ (found.covariance / PARAMETER_SCALES[:, None] / PARAMETER_SCALES)
        @ found.basis
    )
    return found, error, float(seen @ np.linalg.solve(within, seen)), len(seen)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.boresight", description=__doc__)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--project", type=Path, help="write flight 1 as a project and stop")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    if options.project is not None:
        write_flight(simulate_calibration_flight(1), options.project)
        return
    output: dict[str, Any] = {"machine": machine(), "seeds": options.seeds}
    cases: dict[str, tuple[tuple[CalibrationLine, ...], dict[str, Any]]] = {
        "full flight": (FULL, {}),
        "full flight, lever arm surveyed": (FULL, {"lever_sigma_m": LEVEL_FLIGHT_LEVER_SIGMA_M}),
        "one line one way": (ONE_WAY, {}),
    }
    for name, (lines, how) in cases.items():
        runs = [evaluate(seed, lines, **how) for seed in range(1, options.seeds + 1)]
        squares, rank = sum(r[2] for r in runs), sum(r[3] for r in runs)
        low, high = (float(chi2.ppf(q, rank)) / rank for q in (0.0005, 0.9995))
        sigma = np.array([r[0].sigma for r in runs])
        ratio = np.abs([r[1] for r in runs]) / sigma
        ratio = ratio[np.isfinite(ratio)]
        output[name] = {
            "squares_per_rank": squares / rank,
            "bounds": [low, high],
            "rank": rank,
            "within_3_sigma": float(np.mean(ratio < 3.0)),
            "largest": float(ratio.max()),
            "median_sigma": np.median(sigma, axis=0).tolist(),
            "unseparated": sorted({u.sentence for r in runs for u in r[0].inseparable}),
        }
    if options.json:
        print(json.dumps(output))
        return
    for name in cases:
        f = output[name]
        print(
            f"{name}: squares per rank {f['squares_per_rank']:.3f} ({f['bounds'][0]:.3f} to "
            f"{f['bounds'][1]:.3f} holds 99.9 %), {100 * f['within_3_sigma']:.1f} % within 3 "
            f"sigma, largest {f['largest']:.1f}"
        )
        s = f["median_sigma"]
        angles = " ".join(f"{np.degrees(v) * 1e3:.2f}" for v in s[:3])
        print(
            f"  sigma: boresight {angles} mdeg, lever arm "
            + " ".join(f"{v * 100:.1f}" for v in s[3:6])
            + f" cm, time {s[6] * 1e3:.2f} ms, shift "
            + " ".join(f"{v * 100:.1f}" for v in s[7:])
            + " cm (nan: not determined)"
        )
        for sentence in f["unseparated"]:
            print(f"  {sentence}")


if __name__ == "__main__":
    main()
