"""`python -m benchmarks.time_from_pixels`: delays of nine heads found from pixels, against truth.

Each flight is adjusted with its control and the velocities and rates of its trajectory, with delay,
rotation and offset of every head but the first unknown; its orientations are then compared with
the inertial ones, which gives the common delay and the lever arm of the antenna.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
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
from daemon.postflight.calibration.boresight_calibration import (
    ANGLES,
    OPTIONAL,
    VELOCITY,
    controlled_of,
)
from processing.bundle.adjust import Adjustment, AdjustmentSettings, adjust
from processing.bundle.network import (
    Attitudes,
    CameraModel,
    HeadMounting,
    HeadTiming,
    ImagePoints,
    Images,
    Network,
    Points,
    Stations,
)
from processing.calibration.boresight import (
    BoresightCalibration,
    InertialOrientations,
    calibrate_boresight,
    mounting_of,
    rig_motion,
)
from processing.calibration.head_delays import joint_covariance
from processing.geometry.orientation import BODY_FROM_CAMERA, ENU_FROM_NED
from processing.geometry.rotation import (
    level_from_body,
    omega_phi_kappa,
    rotations_from_vectors,
)
from sim_hw.blocks.figure_of_eight import (
    HALF_MM,
    Figure,
    FigureFlight,
    nine_heads,
    simulate_figure_flight,
)
from sim_hw.world.seeding import random_stream

Array = NDArray[np.float64]

MOUNTING_ERROR_RAD = 2e-3
OFFSET_ERROR_M = 0.05
NOMINAL_ANTENNA_M = (0.35, -0.20, -1.25)


@dataclass(frozen=True)
class Timed:
    """What a flight gave: errors and covariance of the quantities `names`, s, m."""

    names: tuple[str, ...]
    error: Array
    covariance: Array
    adjustment: Adjustment
    found: BoresightCalibration


def inertial_of(flight: FigureFlight) -> InertialOrientations:
    """What receiver and inertial unit state at the marks, with the correlation of their errors."""
    spread = flight.spread
    return InertialOrientations(
        flight.position_m,
        flight.velocity_mps,
        np.array([ENU_FROM_NED @ level_from_body(*a) for a in flight.angles_rad]),
        flight.rate_rad_per_s,
        np.array(spread.position_m),
        np.array(spread.attitude_rad),
        flight.acceleration_mps2,
        flight.rate_change_rad_per_s2,
        flight.time_s,
        spread.position_correlation_s,
        spread.attitude_correlation_s,
    )


def network_of(
    flight: FigureFlight, *, seed: int = 0, readout: bool = False, jitter: bool = False
) -> Network:
    """Images and control with the motion, started from a mounting that is a little off."""
    random = np.random.default_rng([seed, 21])
    n, points = len(flight.time_s), len(flight.points)
    start = np.array(
        [ENU_FROM_NED @ level_from_body(*a) @ BODY_FROM_CAMERA for a in flight.angles_rad]
    )
    heads = []
    for k, head in enumerate(flight.heads):
        off = rotations_from_vectors(random.normal(0.0, MOUNTING_ERROR_RAD, (1, 3)))[0]
        offset = head.offset_m + random.normal(0.0, OFFSET_ERROR_M, 3)
        heads.append(
            HeadMounting(
                head.name,
                head.rotation if k == 0 else head.rotation @ off,
                head.offset_m if k == 0 else offset,
                rotation_free=k > 0,
                offset_free=k > 0,
                timing=HeadTiming(
                    delay_free=k > 0,
                    readout_free=readout,
                    frame_height_mm=2.0 * HALF_MM[1],
                    jitter_sigma_s=(head.jitter_s or None) if jitter else None,
                ),
            )
        )
    xyz, sigma = np.full((points, 3), np.nan), np.full((points, 3), np.nan)
    xyz[: flight.control] = flight.surveyed_m
    sigma[: flight.control] = flight.spread.control_m
    names = tuple(f"{k + 1:06d}" for k in range(n))
    free = np.zeros(n, dtype=bool)
    nominal = mounting_of(np.array(NOMINAL_ANTENNA_M), np.zeros(3))
    network = Network(
        cameras=tuple(CameraModel(h.name, h.f_mm, pixel_mm=3.76e-3) for h in flight.heads),
        heads=tuple(heads),
        stations=Stations(names, flight.position_m, free),
        attitudes=Attitudes(names, start, free),
        images=Images(
            tuple(f"{names[e]}_{h}" for e, h in zip(flight.exposure, flight.head, strict=True)),
            flight.exposure,
            flight.exposure,
            flight.head,
            flight.head,
        ),
        points=Points(tuple(f"p{k}" for k in range(points)), xyz, sigma, np.zeros(points, bool)),
        image_points=ImagePoints(
            flight.image,
            flight.point,
            flight.xy_mm,
            np.full(flight.xy_mm.shape, flight.spread.image_mm),
        ),
    )
    guess = flight.points + random.normal(0.0, 1.0, flight.points.shape)
    started = np.where(np.isfinite(xyz), xyz, guess)
    return replace(
        network,
        points=replace(network.points, xyz_m=started),
        motion=rig_motion(inertial_of(flight), nominal),
    )


def calibrated(
    network: Network, flight: FigureFlight, settings: AdjustmentSettings | None = None
) -> tuple[Adjustment, BoresightCalibration]:
    """The block and the comparison, repeated with the motion at the instants that were found."""
    inertial = inertial_of(flight)
    every = tuple(range(len(flight.time_s)))
    mounting = mounting_of(np.array(NOMINAL_ANTENNA_M), np.zeros(3))
    for _ in range(2):
        moving = replace(network, motion=rig_motion(inertial, mounting))
        result = adjust(moving, settings)
        found = calibrate_boresight(controlled_of(result, every), inertial, mounting)
        mounting = found.mounting
        network = started_at(network, result)
    return result, found


def started_at(network: Network, result: Adjustment) -> Network:
    """The network with the adjusted values of its orientations and points as starting values."""
    state = result.state
    there = ~result.left_out & np.isnan(network.points.sigma_m).all(axis=1)
    xyz = np.where(there[:, None], state.points, network.points.xyz_m)
    return replace(
        network,
        stations=replace(network.stations, position_m=state.station),
        attitudes=replace(network.attitudes, rotation=state.attitude),
        points=replace(network.points, xyz_m=xyz),
        heads=tuple(
            replace(
                head,
                rotation=state.head_rotation[k],
                offset_m=state.head_offset[k],
                timing=replace(
                    head.timing, delay_s=state.head_delay[k], readout_s=state.readout[k]
                ),
            )
            for k, head in enumerate(network.heads)
        ),
    )


def evaluate(flight: FigureFlight, seed: int, **how: Any) -> Timed:
    """Errors of one flight's delays and lever arms, with their joint covariance."""
    network = network_of(flight, seed=seed, **how)
    result, found = calibrated(network, flight)
    layout, heads = result.layout, flight.heads
    every = tuple(range(len(flight.time_s)))
    free = range(1, len(heads))
    columns = np.concatenate(
        [layout.head_delay[1:], layout.head_offset[1:].ravel(), layout.readout]
    )
    joint = joint_covariance(result, every, found, columns)
    error = np.concatenate(
        [
            np.zeros(3),
            found.mounting.antenna_m - flight.antenna_m,
            [found.mounting.time_offset_s - flight.common_delay_s],
            np.zeros(3),
            [result.state.head_delay[k] - heads[k].delay_s for k in free],
            *(result.state.head_offset[k] - heads[k].offset_m for k in free),
            [result.state.readout[k] - heads[k].readout_s for k in range(len(heads))],
        ]
    )
    names = (
        *("", "", "", "antenna forward", "antenna right", "", "common delay", "", "", ""),
        *(f"delay {heads[k].name}" for k in free),
        *(f"lever arm {axis} {heads[k].name}" for k in free for axis in ("right", "forward", "up")),
        *(f"readout time {head.name}" for head in heads),
    )
    taken = [
        k
        for k, name in enumerate(names)
        if name and joint[k, k] > 0.0 and (k >= 10 or found.determined[k])
    ]
    return Timed(
        tuple(names[k] for k in taken), error[taken], joint[np.ix_(taken, taken)], result, found
    )


def write_flight(flight: FigureFlight, folder: Path, **how: Any) -> None:
    """The flight as an adjustment project with `inertial.csv`, as a person would hand it over."""
    network = replace(network_of(flight, **how), motion=None)
    heads = []
    for head in network.heads:
        angles = np.degrees(omega_phi_kappa(head.rotation))
        timing = head.timing
        heads.append(
            {
                "name": head.name,
                **dict(zip(("omega_deg", "phi_deg", "kappa_deg"), angles.tolist(), strict=True)),
                **dict(zip(("x_m", "y_m", "z_m"), head.offset_m.tolist(), strict=True)),
                "rotation": "free" if head.rotation_free else "held",
                "offset": "free" if head.offset_free else "held",
                "delay": "free" if timing.delay_free else "held",
                "readout": "free" if timing.readout_free else "held",
                "frame_height_mm": timing.frame_height_mm,
                "jitter_sigma_ms": timing.jitter_sigma_s and timing.jitter_sigma_s * 1e3,
            }
        )
    file = ProjectFile.model_validate(
        {
            "format": 1,
            "name": "figure of eight",
            "camera": [{"name": c.name, "f_mm": c.f_mm} for c in network.cameras],
            "head": heads,
        }
    )
    nothing = np.zeros((0, 3))
    write_project(folder, file, network, CheckPoints((), nothing, nothing))
    write_table(
        folder / "inertial.csv",
        "Antenna positions and inertial attitudes at the marks of the exposures.",
        ("exposure", "x_m", "y_m", "z_m", *VELOCITY, *ANGLES, *OPTIONAL),
        (
            (name, *(float(v) for v in row))
            for name, row in zip(
                network.stations.names,
                np.hstack(
                    [
                        flight.position_m,
                        flight.velocity_mps,
                        np.degrees(flight.angles_rad),
                        np.degrees(flight.rate_rad_per_s),
                        flight.acceleration_mps2,
                        np.degrees(flight.rate_change_rad_per_s2),
                        flight.time_s[:, None],
                    ]
                ),
                strict=True,
            )
        ),
    )


FIGURES: dict[str, tuple[Figure, ...]] = {
    "one figure of eight": (Figure(),),
    "two figures, two speeds": (Figure(), Figure(airspeed_mps=70.0, azimuth_deg=90.0)),
}
CASES: dict[str, tuple[str, dict[str, float], dict[str, bool]]] = {
    "global shutter": ("one figure of eight", {}, {}),
    "global shutter, two figures": ("two figures, two speeds", {}, {}),
    "jitter of 0.3 ms": ("one figure of eight", {"jitter_s": 3e-4}, {"jitter": True}),
    "rolling shutter of 30 ms": ("one figure of eight", {"readout_s": 0.03}, {"readout": True}),
}


def run_case(name: str, seeds: int) -> dict[str, Any]:
    """Errors over their standard deviations of `seeds` flights of a case, and the latter."""
    figures, heads, how = CASES[name]
    runs: list[Timed] = []
    squares = rank = 0.0
    for seed in range(1, seeds + 1):
        own = nine_heads(random_stream(seed, "heads"), **heads)
        flight = simulate_figure_flight(seed, FIGURES[figures], heads=own)
        runs.append(evaluate(flight, seed, **how))
        error, covariance = runs[-1].error, runs[-1].covariance
        squares += float(error @ np.linalg.solve(covariance, error))
        rank += len(error)
    ratio = np.concatenate([np.abs(r.error) / np.sqrt(np.diag(r.covariance)) for r in runs])
    return {
        "squares_per_rank": squares / rank,
        "bounds": [float(chi2.ppf(q, rank)) / rank for q in (0.0005, 0.9995)],
        "rank": int(rank),
        "within_3_sigma": float(np.mean(ratio < 3.0)),
        "largest": float(ratio.max()),
        "sigma": {kind: _of_kind(runs, kind, sigma=True) for kind in KINDS},
        "rms": {kind: _of_kind(runs, kind, sigma=False) for kind in KINDS},
    }


KINDS = (
    *("common delay", "delay oblique", "lever arm right", "lever arm forward", "lever arm up"),
    *("antenna forward", "antenna right", "readout time"),
)


def _of_kind(runs: list[Timed], kind: str, *, sigma: bool) -> float | None:
    """Root mean square of standard deviations, or of errors, over flights and heads."""
    values = [
        float(r.covariance[k, k]) if sigma else float(r.error[k] ** 2)
        for r in runs
        for k, name in enumerate(r.names)
        if name.startswith(kind)
    ]
    return float(np.sqrt(np.mean(values))) if values else None


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.time_from_pixels", description=__doc__
    )
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--case", choices=CASES, action="append", help="default: all")
    parser.add_argument("--project", type=Path, help="write flight 1 as a project and stop")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    if options.project is not None:
        write_flight(simulate_figure_flight(1), options.project)
        return
    output: dict[str, Any] = {"machine": machine(), "seeds": options.seeds}
    for name in options.case or CASES:
        output[name] = f = run_case(name, options.seeds)
        if options.json:
            continue
        low, high = f["bounds"]
        print(
            f"{name}: squares per rank {f['squares_per_rank']:.3f} ({low:.3f} to {high:.3f} holds "
            f"99.9 %), {100 * f['within_3_sigma']:.1f} % within 3 sigma, largest {f['largest']:.1f}"
        )
        for kind in KINDS:
            if f["sigma"][kind] is not None:
                unit, factor = ("ms", 1e3) if "delay" in kind or "time" in kind else ("cm", 1e2)
                print(
                    f"  {kind}: sigma {f['sigma'][kind] * factor:.3f}, error "
                    f"{f['rms'][kind] * factor:.3f} {unit}"
                )
    if options.json:
        print(json.dumps(output))


if __name__ == "__main__":
    main()
