"""`syntopic advise`: what to fly again before leaving."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from daemon.cli.failures import end_walk
from daemon.tables import light_table

HELP = """Which segments of the plan must be flown again, from verdicts, overlaps and gaps.

The plan is GeoJSON, KML or QGroundControl's .plan. The mission may still be flying. Written are a
GeoJSON, a KML and a MAVLink mission of the segments. The exit status is 1 while there are any. An
exposure whose record cannot be read counts as not flown, and is listed at the end.

Examples: `syntopic advise MISSION`, `syntopic advise MISSION --plan block.geojson`
"""


def advise(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    plan: Annotated[
        Path | None, typer.Option(help="The plan; that of the mission, where it has one.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    from daemon.disk.level2 import write_folder
    from daemon.disk.mission import Mission
    from daemon.orientation.exterior import exposures_of, mount_of
    from daemon.plan import advisor, flown, writing
    from daemon.plan.image_size import image_on_ground_m
    from daemon.plan.reading import PlanError, read_plan
    from processing.rig import load_rig

    folder = Mission.open(mission)
    path = plan or folder.plan_path
    if path is None:
        raise PlanError(f"{folder.path}: was flown without a plan; give --plan FILE")
    read = read_plan(path)
    _, section = mount_of(folder)
    rig = load_rig(folder.rig_path)
    along_m, across_m = image_on_ground_m(rig, section.height_above_ground_m)
    taken = flown.taken_of(folder, read.specification)
    advice = advisor.advise(read, taken, image_along_m=along_m, image_across_m=across_m)
    base_m = along_m * (1.0 - read.specification.forward_overlap)
    read_records = exposures_of(folder)
    simulated = any(exposure.simulated for exposure in read_records.results.values())
    out = folder.export_dir / "fly-again"
    texts = {
        "fly-again.geojson": writing.geojson(advice.segments, simulated=simulated),
        "fly-again.kml": writing.kml(advice.segments, simulated=simulated),
        "fly-again.waypoints": writing.mavlink_mission(
            advice.segments, height_m=section.height_above_ground_m, distance_m=base_m
        ),
    }
    write_folder(out, {name: [text.encode()] for name, text in texts.items()})
    if as_json:
        typer.echo(
            json.dumps(
                {
                    "folder": str(out),
                    "exposures": len(taken),
                    "planned_m": advice.planned_m,
                    "well_m": advice.well_m,
                    "segments": [
                        {
                            "line": one.line.id,
                            "from_m": one.from_m,
                            "to_m": one.to_m,
                            "reasons": list(one.reasons),
                        }
                        for one in advice.segments
                    ],
                    "failures": [failure.as_json() for failure in read_records.failures],
                }
            )
        )
    else:
        console = Console(soft_wrap=True)
        if advice.segments:
            table = light_table("Fly again", ("line", "why"), ("from m", "to m"))
            for one in advice.segments:
                why = "; ".join(one.reasons)
                table.add_row(one.line.id, why, f"{one.from_m:.0f}", f"{one.to_m:.0f}")
            Console().print(table)
        share = advice.well_m / advice.planned_m if advice.planned_m else 0.0
        console.print(
            f"{share:.1%} of {advice.planned_m / 1000:.1f} km is well, "
            f"from {len(taken)} exposures. The segments are in [bold]{out}[/]"
            if advice.segments
            else f"All of {advice.planned_m / 1000:.1f} km is well; nothing is to be flown again. "
            f"[bold]{out}[/] says so."
        )
    end_walk(read_records.failures)
    raise typer.Exit(0 if advice.is_complete else 1)
