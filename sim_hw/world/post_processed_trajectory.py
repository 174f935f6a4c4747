"""When an emulated flight exposes on each of its lines, and the trajectory computed after landing.

The trajectory is a CSV of the reference point's place and attitude with slowly varying errors, each
exposure's drawn independently, as after post-processing of GNSS and inertial data.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sim_hw.world.atomic_file import atomic_file
from sim_hw.world.flight import SimulatedFlight, path_point
from sim_hw.world.seeding import random_stream
from sim_hw.world.world import World

POSITION_M = (0.05, 0.05, 0.05)
ATTITUDE_DEG = (0.005, 0.005, 0.005)
STEP_NS = 10_000_000
AROUND_NS = 200_000_000
SEARCH_M = 5.0
COLUMNS = ("gps_ns", "latitude_deg", "longitude_deg", "height_m", "roll_deg", "pitch_deg",
           "heading_deg")  # fmt: skip


def marks_of_lines(
    world: World, flight: SimulatedFlight, first_gps_ns: int, count: int, lines: int
) -> list[int]:
    """Instants of `count` exposures on each line, at the same places along it, in flown order.

    Raises:
        ValueError: a line is not found; the flight ends first.
    """
    plan = flight.plan
    step_m = world.plan.distance_m
    marks = [first_gps_ns + round(k * step_m / plan.ground_speed_mps * 1e9) for k in range(count)]
    at_m = flight.distance_flown_m(first_gps_ns) - flight.first_line_at_m + count * step_m
    for line in range(1, lines):
        course = math.pi if line % 2 else 0.0
        # The straight after the turn; on it the way along grows or falls as the way flown does.
        for _ in range(100_000):
            right, along, now, bank = path_point(plan, at_m)
            if (
                bank == 0.0
                and abs(now - course) < 1e-9
                and right > (line - 0.5) * (plan.line_spacing_m)
            ):
                break
            at_m += SEARCH_M
        else:
            raise ValueError(f"line {line + 1} is never reached; fly fewer lines")
        places = [k * step_m for k in range(count)]
        for place in reversed(places) if line % 2 else places:
            ahead = (along - place) if line % 2 else (place - along)
            way = at_m + ahead + flight.first_line_at_m
            marks.append(flight.epoch_gps_ns + round(way / plan.ground_speed_mps * 1e9))
        at_m += plan.line_length_m
    return marks


def write_trajectory(
    path: Path,
    flight: SimulatedFlight,
    marks: Sequence[int],
    *,
    seed: int,
    position_m: tuple[float, float, float] = POSITION_M,
    attitude_deg: tuple[float, float, float] = ATTITUDE_DEG,
) -> None:
    """Samples of 100 Hz about every mark; errors of one exposure are drawn once.

    Args:
        position_m: sigma east, north, up.
        attitude_deg: sigma of roll, pitch, heading.
    """
    random = random_stream(seed, "post-processed")
    with atomic_file(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for mark in marks:
            moved = random.normal(0.0, position_m)
            attitude_error = random.normal(0.0, attitude_deg)
            for offset in range(-AROUND_NS, AROUND_NS + 1, STEP_NS):
                pose = flight.pose(mark + offset)
                place = flight.geodetic(pose.position_enu_m + moved)
                angles = np.degrees(flight.attitude_rad(pose)) + attitude_error
                writer.writerow(
                    [
                        mark + offset,
                        *(f"{v:.10f}" for v in place[:2]),
                        f"{place[2]:.4f}",
                        *(f"{v:.6f}" for v in angles),
                    ]
                )
