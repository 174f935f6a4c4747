"""`python -m benchmarks.live_accuracy`: the triangulation in flight at check points.

Lines flown there and back, and cross lines over them, are rendered as the ideal camera sees them,
with shot noise and errors of navigation and boresight. Check points are drawn on the true terrain
and measured in the images with noise. They are intersected from the orientations that the live
triangulation has at landing, and from those of `syntopic triangulate`, and compared with the truth.
Errors are normalised by the joint covariance of all check points, which follows from the full
covariance of all orientations.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from daemon.cli.benchmark.measurement import machine
from daemon.mission.layout import Mission
from daemon.onboard.triangulation.mission_triangulation import MissionTriangulation
from daemon.orientation.exterior_orientation import sealed_exposures
from daemon.orientation.local_frame import LocalFrame
from daemon.postflight.triangulation.matching_work import match_mission_block
from daemon.postflight.triangulation.triangulation import (
    TriangulationSettings,
    block_of,
    project_of,
    weight_by_residuals,
)
from processing.bundle.adjust import adjust
from processing.bundle.camera_orientations import camera_orientations
from processing.bundle.initial_values import completed
from processing.bundle.measured_points import measured_point
from processing.geometry.rotation import vectors_from_rotations
from processing.matching.block_matching import BlockMatching, image_mm
from processing.rig import VirtualImage, shipped_rigs
from sim_hw.processes.exposures import EPOCH_GPS_NS, FIRST_AFTER_S
from sim_hw.world.flight import Pose, SimulatedFlight
from sim_hw.world.post_processed_trajectory import marks_of_lines
from sim_hw.world.world import World, WorldSettings
from tests.daemon.flown_block import (
    FlownBlock,
    GroundPoints,
    ground_points,
    write_flown,
    write_navigation,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MEASURED_PX = 0.1
"""Sigma of a measured image coordinate."""
TURN_S = 120
CONFIDENCE = 0.999


@dataclass(frozen=True)
class Crossing:
    """A straight line across the others: between two instants, another flight, shifted."""

    begins_ns: int
    flight: SimulatedFlight
    shift_m: Array


@dataclass(frozen=True)
class CrossedFlight(SimulatedFlight):
    """A flight that ends with cross lines."""

    crossings: tuple[Crossing, ...] = ()

    def pose(self, gps_ns: int) -> Pose:
        """See `SimulatedFlight.pose`."""
        for one in reversed(self.crossings):
            if gps_ns >= one.begins_ns:
                pose = one.flight.pose(gps_ns)
                return replace(pose, position_enu_m=pose.position_enu_m + one.shift_m)
        return super().pose(gps_ns)


@dataclass(frozen=True)
class Orientations:
    """Adjusted orientations with their joint covariance.

    Attributes:
        number: (n,) exposures.
        station_m, rotation: (n, 3), (n, 3, 3), local frame and object from camera.
        covariance: (6 n, 6 n) of projection centres and of rotation vectors about camera axes.
    """

    frame: LocalFrame
    number: Indices
    station_m: Array
    rotation: Array
    covariance: Array


def fly(folder: Path, each: int, lines: int, crossings: int, seed: int) -> FlownBlock:
    """Render the block."""
    text = shipped_rigs()["ultracam-l-mini"].read_text()
    file = folder / "rig.toml"
    file.write_text(text.replace("width_px = 2364", "width_px = 1182"))
    settings = WorldSettings(
        rig_file=str(file), seed=seed, epoch_gps_ns=EPOCH_GPS_NS, exposures=each, height_m=1500.0
    )
    plan = World(settings).flight.plan
    world = World(replace(settings, scene_margin_m=(lines - 1) * plan.line_spacing_m))
    first = EPOCH_GPS_NS + FIRST_AFTER_S * 1_000_000_000
    flight = world.flight.beginning_first_line_at(world.flight.distance_flown_m(first))
    marks = marks_of_lines(world, flight, first, each, lines)
    names = [f"line {k // each + 1}" for k in range(each * lines)]
    east_m, north_m = (lines - 1) * plan.line_spacing_m, (each - 1) * world.plan.distance_m
    count = int(east_m / world.plan.distance_m) + 2
    across: list[Crossing] = []
    for k in range(crossings):
        begin = marks[-1] + TURN_S * 1_000_000_000
        course = 90.0 if k % 2 == 0 else 270.0
        straight = replace(plan, heading_deg=course, line_length_m=1e9)
        other = SimulatedFlight(straight, seed + 1 + k, EPOCH_GPS_NS)
        sense = 1.0 if k % 2 == 0 else -1.0
        length_m = (count - 1) * world.plan.distance_m
        middle = (east_m / 2, flight.first_line_at_m + north_m * (k + 1) / (crossings + 1))
        # Where it is at its first exposure, and where it has to be.
        there = sense * other.distance_flown_m(begin)
        shift = np.array([middle[0] - sense * length_m / 2 - there, middle[1], 0.0])
        across.append(Crossing(begin - 1_000_000_000, other, shift))
        step_ns = world.plan.distance_m / plan.ground_speed_mps * 1e9
        marks += [begin + round(i * step_ns) for i in range(count)]
        names += [f"cross {k + 1}"] * count
    crossed = CrossedFlight(
        flight.plan, flight.seed, flight.epoch_gps_ns, flight.first_line_at_m, tuple(across)
    )
    return write_flown(folder, world, crossed, marks, names)


def live(mission: Path) -> tuple[Orientations, Array, dict[str, Any]]:
    """The live triangulation at landing.

    Returns:
        Its orientations, sigmas of image coordinates (2,) px, and figures.
    """
    folder = Mission.open(mission)
    done = MissionTriangulation(folder)
    read = sealed_exposures(folder).results
    seconds = []
    for number in sorted(read):
        begun = time.perf_counter()
        done.add(read[number])
        seconds.append(time.perf_counter() - begun)
    begun = time.perf_counter()
    done.land()
    block = done.live
    assert block is not None and block.last is not None and done.frame is not None
    accuracy = done.accuracy()
    figures = {
        "exposure_s": {"median": float(np.median(seconds)), "max": float(max(seconds))},
        "landing_s": time.perf_counter() - begun,
        "sigma0": block.last.sigma0,
        "findings": [one.as_json() for one in done.findings],
        "accuracy": None if accuracy is None else accuracy.as_json(),
    }
    own = [block.orientations[k] for k in block.last_images]
    found = Orientations(
        done.frame,
        np.array([one.image.number for one in own]),
        np.array([one.position_m for one in own]),
        np.array([one.rotation for one in own]),
        block.last.cameras.covariance(),
    )
    return found, block.image_sigma_px, figures


def after_landing(
    mission: Path, trajectory: Path, cells: tuple[int, int]
) -> tuple[Orientations, dict[str, Any]]:
    """As `syntopic triangulate`, with a grid of that many features."""
    begun = time.perf_counter()
    block = block_of(Mission.open(mission), trajectory_file=trajectory)
    settings = TriangulationSettings(matching=BlockMatching(cells=cells))
    tied = match_mission_block(block, settings.matching)
    project = weight_by_residuals(project_of(block, tied, settings), tied.points)
    done = adjust(completed(project.network), project.settings)
    cameras = camera_orientations(done)
    figures = {
        "seconds": time.perf_counter() - begun,
        "sigma0": done.sigma0,
        "groups": {group.name: float(group.factor) for group in done.groups},
        "image_points": len(tied.image),
    }
    number = np.array([eo.exposure for eo in block.oriented])
    return (
        Orientations(
            block.frame, number, cameras.station_m, cameras.rotation, cameras.covariance()
        ),
        figures,
    )


def at_check_points(
    found: Orientations, image: VirtualImage, points: GroundPoints, flown: FlownBlock
) -> dict[str, Any]:
    """Errors of the intersected check points, m and px, and normalised by their covariance."""
    at = {int(n): k for k, n in enumerate(found.number)}
    own = np.array([int(n) in at for n in points.exposure])
    index = np.array([at[int(n)] for n in points.exposure[own]])
    point, xy = points.point[own], image_mm(image, points.px[own])
    count = len(points.enu_m)
    xyz = np.full((count, 3), np.nan)
    gain, noise = np.zeros((3 * count, len(found.covariance))), np.zeros((3 * count, 3))
    sigma_mm = np.full(len(xy), MEASURED_PX * image.pitch_mm)
    for p in range(count):
        rows, part = np.flatnonzero(point == p), slice(3 * p, 3 * p + 3)
        one = measured_point(
            image.f_mm, found.station_m, found.rotation, index[rows], xy[rows], sigma_mm[rows]
        )
        if one is not None:
            xyz[p], gain[part], noise[part] = one.xyz_m, one.gain, one.noise
    known = np.isfinite(xyz).all(axis=1)
    covariance = gain @ found.covariance @ gain.T
    for p in range(len(xyz)):
        part = slice(3 * p, 3 * p + 3)
        covariance[part, part] += noise[part]
    errors = xyz - _truth(flown, points.enu_m, found.frame)
    keep = np.repeat(known, 3)
    flat = errors.ravel()[keep]
    inner = covariance[np.ix_(keep, keep)]
    squares = float(flat @ np.linalg.solve(inner, flat)) / len(flat)
    tail = (1.0 - CONFIDENCE) / 2.0
    low, high = (
        float(v) for v in np.asarray(stats.chi2.ppf([tail, 1.0 - tail], len(flat))) / len(flat)
    )
    gsd_m = flown.world.plan.gsd_m
    rms = np.sqrt(np.mean(errors[known] ** 2, axis=0))
    standardised = flat / np.sqrt(np.diag(inner))
    return {
        "points": int(known.sum()),
        "rms_m": [float(v) for v in rms],
        "rms_px": [float(v / gsd_m) for v in rms],
        "mean_m": errors[known].mean(axis=0).tolist(),
        "expected_m": np.sqrt(np.diag(inner).reshape(-1, 3).mean(axis=0)).tolist(),
        "normalised": squares,
        "interval": [float(low), float(high)],
        "is_inside": bool(low < squares < high),
        "largest_standardised": float(np.abs(standardised).max()),
    }


def _truth(flown: FlownBlock, enu_m: Array, frame: LocalFrame) -> Array:
    places = np.array([flown.flight.geodetic(one) for one in enu_m])
    return frame.from_geodetic(*places.T)


def orientation_differences(one: Orientations, other: Orientations) -> dict[str, float]:
    """Differences between two triangulations, in standard deviations of the second, RMS."""
    at = {int(n): k for k, n in enumerate(other.number)}
    squares = []
    for k, number in enumerate(one.number.tolist()):
        if number not in at:
            continue
        j = at[number]
        there = other.frame.to_geodetic(other.station_m[j : j + 1])
        step = one.station_m[k] - one.frame.from_geodetic(*there.T)[0]
        turn = _between(one.frame, other.frame)
        angle = vectors_from_rotations(((turn @ other.rotation[j]).T @ one.rotation[k])[None])[0]
        sigma = np.sqrt(np.diag(other.covariance)[6 * j : 6 * j + 6])
        squares.append((np.concatenate([step, angle]) / sigma) ** 2)
    found = np.sqrt(np.mean(squares, axis=0))
    return {"position_sigmas": float(found[:3].max()), "attitude_sigmas": float(found[3:].max())}


def _between(one: LocalFrame, other: LocalFrame) -> Array:
    """Rotation from another local frame into one."""
    return one.local_from_enu(other.latitude_deg, other.longitude_deg)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.live_accuracy", description=__doc__)
    parser.add_argument("--exposures", type=int, default=10, help="of each line")
    parser.add_argument("--lines", type=int, default=5)
    parser.add_argument("--crossings", type=int, default=2)
    parser.add_argument("--points", type=int, default=120)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument(
        "--cells", type=int, nargs=2, default=BlockMatching().cells,
        help="columns and rows of features of an image after landing",
    )  # fmt: skip
    parser.add_argument("--folder", type=Path, default=None, help="where the mission is kept")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="syntopic-bench-") as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        flown = fly(folder, options.exposures, options.lines, options.crossings, options.seed)
        points = ground_points(flown, options.points, options.seed, sigma_px=MEASURED_PX)
        image = flown.world.image
        at_landing, sigma_px, flight = live(flown.mission)
        columns, rows = options.cells
        final, landed = after_landing(flown.mission, write_navigation(flown), (columns, rows))
        found = {
            "exposures": len(flown.marks),
            "gsd_m": flown.world.plan.gsd_m,
            "image_sigma_px": sigma_px.tolist(),
            "live": {**flight, "check_points": at_check_points(at_landing, image, points, flown)},
            "after_landing": {
                **landed,
                "check_points": at_check_points(final, image, points, flown),
            },
            "difference": orientation_differences(at_landing, final),
        }
    print(json.dumps({"machine": machine(), "figures": found}, indent=1))


if __name__ == "__main__":
    main()
