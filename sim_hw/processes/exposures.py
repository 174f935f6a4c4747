"""`python -m sim_hw.processes.exposures RIG`: exposures on disk, without devices.

Writes a mission folder in the format for hand-written missions (docs/reference/formats.md), the
laboratory's calibration and the truth. Rendering is separate so that benchmarks time the pipeline
alone.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tifffile

from processing.rig import Rig
from sim_hw.__main__ import displacement, rig_file
from sim_hw.world import sensor_calibration
from sim_hw.world.atomic_file import atomic_file
from sim_hw.world.electronics import (
    COLUMN_BIAS_DN,
    PIXEL_BIAS_DN,
    Electronics,
    true_sensor,
)
from sim_hw.world.ground_types import GROUNDS
from sim_hw.world.post_processed_trajectory import marks_of_lines, write_trajectory
from sim_hw.world.rendering import ExposureParameters, light_on_sensor
from sim_hw.world.scene import open_scene
from sim_hw.world.seeding import random_stream
from sim_hw.world.snapshots import PROBE_SIGMA_C, exposure_parameters_of
from sim_hw.world.surveyed_points import write_surveyed
from sim_hw.world.truth import SensorExposure, TruthWriter
from sim_hw.world.world import World, WorldSettings

EPOCH_GPS_NS = 1_447_000_000_000_000_000
FIRST_AFTER_S = 20
MARK_SIGMA_NS = 60
CONTROL, CHECKS = 12, 30
"""Surveyed points of a block."""
LEAST_BLOCK = 5
"""Exposures that make one: fewer hardly overlap three times."""
BLACK_SIGMAS = 4.0
MIN_FULL_WELL_E = 2000.0
"""Fewer electrons at the highest value leave nothing but photon noise: 2.2 % of white."""


def write_exposures(world: World, out: Path, *, count: int, scenes: Path, lines: int = 1) -> Path:
    """Render the first exposures of each line; returns the mission folder, `out/mission`.

    `out/calibration` holds what the laboratory measured, `out/truth` what is really so,
    `out/trajectory.csv` what a post-processed trajectory would say. A file `out/ready.json` is
    written last.
    """
    rig, seed = world.rig, world.settings.seed
    mission, calibration = out / "mission", out / "calibration"
    scene = open_scene(world.scene_settings, scenes)
    first_ns = EPOCH_GPS_NS + FIRST_AFTER_S * 1_000_000_000
    flight = world.flight.beginning_first_line_at(world.flight.distance_flown_m(first_ns))
    marks = marks_of_lines(world, flight, first_ns, count, lines)
    sensor_calibration.write_rig(Path(world.settings.rig_file), mission)
    _write_plan(world, mission, calibration / "radiometry")
    write_trajectory(out / "trajectory.csv", flight, marks, seed=seed)
    if rig.virtual_image is not None and len(marks) >= LEAST_BLOCK:
        write_surveyed(
            out / "surveyed", world, flight, marks, seed=seed, control=CONTROL, checks=CHECKS
        )
    # Where no image is stitched there is no mapping to write down.
    truth = None if rig.virtual_image is None else TruthWriter(world, out / "truth")
    if truth is not None:
        truth.write_parameters()
    parameters_by_sensor: list[dict[str, ExposureParameters]] = [{} for _ in marks]
    for number in range(1, len(marks) + 1):
        (mission / "L0" / f"{number:06d}").mkdir(parents=True, exist_ok=True)
    for cone in rig.cones:
        for sensor in cone.sensors:
            faults = true_sensor(cone, sensor, seed, field_radius_mm=world.field_radius_mm(cone))
            sensor_calibration.write_radiometry(
                calibration, sensor, sensor_calibration.measure(sensor, faults, seed)
            )
            head = Electronics(sensor, faults, world.electrons_per_radiance_s(cone))
            for k, mark_ns in enumerate(marks):
                parameters = exposure_parameters_of(world, cone, mark_ns)
                frame = head.frame(
                    light_on_sensor(world, scene, flight, cone, sensor, parameters),
                    exposure_time_us=parameters.exposure_time_us,
                    tdi_shifts=parameters.tdi_shifts,
                    gain_db=0.0,
                    temperature_c=world.temperature_c(sensor.probe, parameters.mid_gps_ns),
                    random=random_stream(seed, "noise", sensor.name, k + 1),
                )
                path = mission / "L0" / f"{k + 1:06d}" / f"{sensor.name}.tif"
                with atomic_file(path) as part:
                    tifffile.imwrite(part, frame)
                parameters_by_sensor[k][sensor.name] = parameters
                if truth is not None:
                    truth.add(SensorExposure(sensor.name, k + 1, parameters), flight)
            print(sensor.name, file=sys.stderr, flush=True)
    for k, mark_ns in enumerate(marks):
        path = mission / "L0" / f"{k + 1:06d}" / "exposure.json"
        record = _record(world, k + 1, mark_ns, parameters_by_sensor[k]) | {
            "line_id": f"line {k // count + 1}"
        }
        with atomic_file(path) as part:
            part.write_text(json.dumps(record, indent=1))
    with atomic_file(out / "ready.json") as part:
        part.write_text(json.dumps({"exposures": len(marks)}))
    return mission


def _record(
    world: World, number: int, mark_ns: int, parameters_by_sensor: dict[str, ExposureParameters]
) -> dict[str, Any]:
    random = random_stream(world.settings.seed, "probes of exposure", number)
    return {
        "number": number,
        "simulated": True,
        "mark_gps_ns": str(mark_ns),
        "mark_sigma_ns": MARK_SIGMA_NS,
        "mark_source": "event-mark",
        "temperatures": [
            {
                "probe": probe,
                "value_c": world.temperature_c(probe, mark_ns)
                + float(random.normal(0.0, PROBE_SIGMA_C)),
            }
            for probe in world.rig.probes
        ],
        "frames": [
            {
                "sensor": name,
                "exposure_time_us": parameters.exposure_time_us,
                "settings": {"TdiShifts": parameters.tdi_shifts},
            }
            for name, parameters in parameters_by_sensor.items()
        ],
    }


def _write_plan(world: World, mission: Path, radiometry: Path) -> None:
    plan = world.plan
    text = (
        "[plan]\n"
        f"ground_height_m = {plan.ground_height_m!r}\n"
        f"height_above_ground_m = {plan.height_above_ground_m!r}\n"
        f"ground_speed_mps = {plan.ground_speed_mps!r}\n\n"
        "[mission]\n"
        f"radiometry = {json.dumps(str(radiometry.resolve()))}\n"
    )
    with atomic_file(mission / "service.toml") as part:
        part.write_text(text, encoding="utf-8")


def radiometry_problem(rig: Rig) -> str | None:
    """Why frames of a rig would show nothing but its placeholders for radiometric values.

    Args:
        rig: the camera.

    Returns:
        One sentence about the first such sensor; None where all can be emulated.
    """
    for sensor in rig.sensors:
        full_well_e = sensor.full_scale_dn * sensor.electrons_per_dn
        read_noise_dn = sensor.read_noise_e / sensor.electrons_per_dn
        least_dn = BLACK_SIGMAS * math.hypot(read_noise_dn, PIXEL_BIAS_DN, COLUMN_BIAS_DN)
        found = []
        if full_well_e < MIN_FULL_WELL_E:
            found.append(
                f"electrons_per_dn = {sensor.electrons_per_dn:g} fills {sensor.bits} bits with "
                f"{full_well_e:.0f} electrons; a sensor holds {MIN_FULL_WELL_E:.0f} at least"
            )
        if sensor.black_dn < least_dn:
            found.append(
                f"black_dn = {sensor.black_dn:g} cuts the noise of dark pixels off at 0 DN; it is "
                f"{least_dn:.1f} at least"
            )
        if found:
            return (
                f"sensor {sensor.name}: {'; '.join(found)}. Give black_dn, electrons_per_dn and "
                "read_noise_e of the sensor, such as 64, 20 and 30 for 12 bits"
            )
    return None


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; one JSON line gives the path of every result."""
    line = argparse.ArgumentParser(prog="python -m sim_hw.processes.exposures", description=__doc__)
    add = line.add_argument
    add("rig", help="name of a shipped rig, or a rig file")
    add("--out", type=Path, required=True, help="folder for mission, calibration and truth")
    add("--exposures", type=int, default=1, help="of each line")
    add("--lines", type=int, default=1, help="flown there and back, 30 %% apart in overlap")
    add("--seed", type=int, default=1, help="seed for all random generators")
    add("--dc", type=float, default=0.0, help="temperature above calibration, K")
    add(
        "--displace",
        type=displacement,
        action="append",
        default=[],
        metavar="SENSOR=X,Y",
        help="move a sensor right and up in its layer, pixels; may be repeated",
    )
    add("--ground", choices=list(GROUNDS), default="landscape", help="what is flown over")
    add("--cloud-over", metavar="SENSOR", help="a sensor that a cloud hides the ground from")
    add("--scene-cache", type=Path, help="folder where built scenes are kept (default: OUT/scenes)")
    given = line.parse_args(arguments)
    try:
        world = World(
            WorldSettings(
                rig_file=str(rig_file(given.rig)),
                seed=given.seed,
                epoch_gps_ns=EPOCH_GPS_NS,
                dc_k=given.dc,
                displaced_px=dict(given.displace),
                exposures=given.exposures,
                ground=given.ground,
                cloud_over=given.cloud_over,
            )
        )
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    problem = radiometry_problem(world.rig)
    if problem is not None:
        print(f"{given.rig}: {problem}", file=sys.stderr)
        return 2
    given.out.mkdir(parents=True, exist_ok=True)
    mission = write_exposures(
        world,
        given.out,
        count=given.exposures,
        scenes=given.scene_cache or given.out / "scenes",
        lines=given.lines,
    )
    print(json.dumps({"mission": str(mission), "truth": str(given.out / "truth")}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
