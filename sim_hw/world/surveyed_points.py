"""Control and check points of an emulated block: surveyed on the ground, measured in the images.

Places are where the true terrain is, pixels where the ideal camera truly sees them; to both comes
the noise of those who measure.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sim_hw.world import true_camera
from sim_hw.world.atomic_file import atomic_file
from sim_hw.world.flight import SimulatedFlight
from sim_hw.world.seeding import random_stream
from sim_hw.world.snapshots import exposure_parameters_of
from sim_hw.world.world import World


def write_surveyed(
    folder: Path,
    world: World,
    flight: SimulatedFlight,
    marks: Sequence[int],
    *,
    seed: int,
    control: int,
    checks: int,
    survey_m: float = 0.02,
    measured_px: float = 0.1,
) -> None:
    """Write `points.csv` and `measured.csv` (docs/reference/formats.md, aerial triangulation).

    Args:
        marks: mid-exposures of the reference cone, exposure by exposure.
        survey_m, measured_px: sigma of each coordinate.
    """
    random = random_stream(seed, "surveyed")
    image = world.image
    poses = [flight.pose(_master_mark(world, mark)) for mark in marks]
    middle = np.array([pose.position_enu_m[:2] for pose in poses])
    low, high = middle.min(axis=0), middle.max(axis=0)
    half = 0.4 * np.array([image.width_px, image.height_px]) * world.plan.gsd_m
    edge = (low - half * 0.5, high + half * 0.5)
    folder.mkdir(parents=True, exist_ok=True)
    points, measured = [], []
    number = 0
    while number < control + checks:
        xy = random.uniform(*edge)
        ground = np.array([*xy, float(world.terrain.height_m(xy[0], xy[1]))])
        at = []
        for k, pose in enumerate(poses):
            column, row = true_camera.ideal_pixels(ground, world.rig, pose)
            if 20 < column < image.width_px - 21 and 20 < row < image.height_px - 21:
                noise = random.normal(0.0, measured_px, 2)
                at.append((k, float(column) + noise[0], float(row) + noise[1]))
        if len(at) < 3:
            continue
        name = f"{'C' if number < control else 'K'}{number + 1:02d}"
        place = flight.geodetic(ground + random.normal(0.0, survey_m, 3))
        role = "control" if number < control else "check"
        points.append([name, role, *(f"{v:.10f}" for v in place[:2]), f"{place[2]:.4f}",
                       *[survey_m] * 3])  # fmt: skip
        measured += [[f"{k + 1:06d}", name, f"{c:.3f}", f"{r:.3f}", measured_px] for k, c, r in at]
        number += 1
    _write(
        folder / "points.csv",
        ("point", "role", "latitude_deg", "longitude_deg", "height_m", "sx_m", "sy_m", "sz_m"),
        points,
    )
    _write(folder / "measured.csv", ("image", "point", "column_px", "row_px", "sigma_px"), measured)


def _master_mark(world: World, mark_gps_ns: int) -> int:
    """Mid-exposure of the master cone where the rig is syntopic."""
    master = world.rig.master_cone or world.rig.reference_cone
    return exposure_parameters_of(world, world.rig.cone(master), mark_gps_ns).mid_gps_ns


def _write(path: Path, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    with atomic_file(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)
