"""`syntopic reflights`: what to fly again before leaving."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from daemon.cli.exit_status import exit_if_failed, status_of
from daemon.cli.options import AsJson
from daemon.terminal.console import Console, light_table

HELP = """List the segments of the plan that must be flown again.

A point is covered if enough images for the overlaps have valid pixels of it in every band.

The plan is GeoJSON, KML or QGroundControl's .plan. The mission may be in flight. Writes a
GeoJSON, a KML and a MAVLink mission of the segments. An exposure with an unreadable record counts
as not flown and is listed at the end.

Examples: `syntopic reflights MISSION`, `syntopic reflights MISSION --plan block.geojson`
"""


def reflights(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    plan: Annotated[Path | None, typer.Option(help="Plan (default: that of the mission).")] = None,
    elevation: Annotated[
        Path | None, typer.Option(help="Height model (default: that of the mission).")
    ] = None,
    as_json: AsJson = False,
) -> None:
    from daemon.mission.layout import Mission
    from daemon.mission.store.level2 import write_folder
    from daemon.orientation.exterior_orientation import mount_of, sealed_exposures
    from daemon.planning import exposure_footprints, reflight_files, reflight_planning
    from daemon.planning.image_size import image_on_ground_m
    from daemon.planning.plan_readers import PlanError, read_plan
    from daemon.planning.relief import relief_or_reason
    from processing.rig import load_rig

    folder = Mission.open(mission)
    path = plan or folder.plan_path
    if path is None:
        raise PlanError(f"{folder.path}: was flown without a plan; give --plan FILE")
    read = read_plan(path)
    _, section = mount_of(folder)
    if elevation is not None:
        section = section.model_copy(update={"elevation": elevation})
    rig = load_rig(folder.rig_path)
    along_m, across_m = image_on_ground_m(rig, section.height_above_ground_m)
    taken = exposure_footprints.exposure_footprints(folder, read.specification)
    relief, level = relief_or_reason(section)
    advice = reflight_planning.reflights(
        read, taken, image_along_m=along_m, image_across_m=across_m, relief=relief
    )
    notes = [level] if level else []
    if without := exposure_footprints.without_valid_area(folder):
        notes.append(
            f"{without} of {len(taken)} exposures have no recorded valid area: they count "
            "completely, except for heads that sent no image. Run syntopic process to compute it."
        )
    base_m = along_m * (1.0 - read.specification.forward_overlap)
    read_records = sealed_exposures(folder)
    simulated = any(exposure.simulated for exposure in read_records.results.values())
    out = folder.export_dir / "fly-again"
    texts = {
        "fly-again.geojson": reflight_files.geojson(advice.segments, simulated=simulated),
        "fly-again.kml": reflight_files.kml(advice.segments, simulated=simulated),
        "fly-again.waypoints": reflight_files.mavlink_mission(
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
                    "covered_m": advice.covered_m,
                    "hole_m2": round(advice.hole_m2, 1),
                    "notes": notes,
                    "segments": [
                        {
                            "line": one.line.id,
                            "from_m": one.from_m,
                            "to_m": one.to_m,
                            "reasons": list(one.reasons),
                            "holes": [reflight_files.hole_json(hole) for hole in one.holes],
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
            table = light_table("Fly again", ("line", "why"), ("from m", "to m", "ha"))
            for one in advice.segments:
                why = "; ".join(one.reasons)
                numbers = f"{one.from_m:.0f}", f"{one.to_m:.0f}", f"{one.area_m2 / 1e4:.2f}"
                table.add_row(one.line.id, why, *numbers)
            Console().print(table)
        planned = f"{advice.planned_m / 1000:.1f} km"
        if advice.segments:
            console.print(
                f"{advice.covered_m / advice.planned_m:.1%} of {planned} is covered by "
                f"{len(taken)} exposures; too few images see {advice.hole_m2 / 1e4:.2f} ha. The "
                f"segments are in {out}"
            )
        else:
            console.print(f"All of {planned} is covered; nothing is to be flown again.")
        for note in notes:
            console.print(note)
    exit_if_failed(read_records.failures)
    raise typer.Exit(status_of(is_good=advice.is_complete))
