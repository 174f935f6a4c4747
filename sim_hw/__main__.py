"""`python -m sim_hw RIG --out DIR`: run an emulated rig until a signal ends it.

One JSON line on stdout reports that every device answers; progress and errors go to stderr.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from processing.rig import RigError, load_rig, shipped_rigs
from sim_hw.processes.parent_death import terminate_with_parent
from sim_hw.processes.simulator import SimulatorSettings, simulate
from sim_hw.receivers.device_kinds import PROBES, RECEIVERS
from sim_hw.world.ground_types import GROUNDS
from sim_hw.world.world import WorldSettings
from sim_hw.world.world_clock import WorldClock


def parser() -> argparse.ArgumentParser:
    """The command line."""
    line = argparse.ArgumentParser(prog="python -m sim_hw", description=__doc__)
    add = line.add_argument
    add("rig", help="name of a shipped rig, or a rig file")
    add("--out", type=Path, required=True, help="folder for calibration, truth and scene")
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
    add("--height", type=float, help="flying height above mean ground, m")
    add("--speed", type=float, help="ground speed, m/s")
    add("--heading", type=float, default=0.0, help="track of the first line, degrees")
    add("--exposures", type=int, default=13, help="exposures of a line; sizes the scene")
    add("--scene-margin", type=float, default=0.0, help="further ground on all sides, m")
    add("--packet-loss", type=float, default=0.0, help="share of image packets lost")
    add(
        "--fault",
        action="append",
        default=[],
        metavar="NAME@TIME[:DEVICE][,DURATION]",
        help="plan a fault, see docs/reference/results/faults.md; may be repeated",
    )
    add("--scenario", type=Path, help="a file with faults")
    add("--read-faults", action="store_true", help="read further faults from stdin, one in a line")
    add("--pps", action="store_true", help="a pulse per second as well")
    add("--receiver", choices=RECEIVERS, default="ublox", help="kind of the receiver")
    add("--probe", choices=PROBES, default="modbus", help="kind of the thermometer")
    add("--first-address", default="127.0.0.2", help="loopback address of the first head")
    add("--scene", help="a GeoTIFF to fly over instead of the shipped photographs")
    add("--ground", choices=list(GROUNDS), default="land", help="what is flown over")
    add("--still", action="store_true", help="render one exposure, and send it for every pulse")
    add("--digests", action="store_true", help="write the SHA-256 of every frame to OUT/sent")
    add("--scene-cache", type=Path, help="folder where built scenes are kept (default: OUT/scenes)")
    add("--processes", type=int, default=2, help="worker processes that render")
    add("--parent", type=int, metavar="PID", help="end when this process, which started us, does")
    return line


def displacement(text: str) -> tuple[str, tuple[float, float]]:
    """Read SENSOR=X,Y."""
    name, _, numbers = text.partition("=")
    try:
        x, y = (float(number) for number in numbers.split(","))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r}; write it as SU02=1.0,-0.6") from error
    return name, (x, y)


def rig_file(name_or_path: str) -> Path:
    """The file of a rig; RigError lists the shipped ones where there is none."""
    path = shipped_rigs().get(name_or_path, Path(name_or_path))
    if not path.is_file():
        known = ", ".join(shipped_rigs())
        raise RigError([f"rig {name_or_path!r} is neither a file nor one of: {known}"])
    load_rig(path)
    return path


def main(arguments: Sequence[str] | None = None) -> int:
    given = parser().parse_args(arguments)
    if given.parent is not None:
        terminate_with_parent(given.parent)
    if given.processes < 1 or given.exposures < 1:
        print("sim_hw: processes and exposures are at least 1", file=sys.stderr)
        return 2
    try:
        path = rig_file(given.rig)
    except RigError as error:
        print(f"sim_hw: {error}", file=sys.stderr)
        return 2
    clock = WorldClock.from_wall_clock()
    world = WorldSettings(
        rig_file=str(path.resolve()),
        seed=given.seed,
        epoch_gps_ns=clock.gps_ns_at_start,
        dc_k=given.dc,
        displaced_px=dict(given.displace),
        height_m=given.height,
        ground_speed_mps=given.speed,
        heading_deg=given.heading,
        exposures=given.exposures,
        scene_margin_m=given.scene_margin,
        scene_file=given.scene,
        ground=given.ground,
    )
    settings = SimulatorSettings(
        out=given.out,
        scene_cache=given.scene_cache or given.out / "scenes",
        first_address=given.first_address,
        packet_loss=given.packet_loss,
        processes=given.processes,
        faults=tuple(given.fault),
        scenario=given.scenario,
        receiver=given.receiver,
        has_pps=given.pps,
        is_frozen=given.still,
        has_digests=given.digests,
        reads_faults=given.read_faults,
        probe=given.probe,
    )
    return simulate(settings, world, clock)


if __name__ == "__main__":
    sys.exit(main())
