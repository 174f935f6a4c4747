"""`syntopic export stac` and `syntopic export gis`: a mission for catalogs and maps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from daemon.cli.exit_status import exit_if_failed
from daemon.cli.options import AsJson, Crs, MountFile, Trajectory
from daemon.terminal.console import Console, light_table

STAC_HELP = """Write a STAC 1.1 collection with one item an image.

Items have time, footprint, bands, view angles, sun, verdict, and links to Level-2 and to the COGs
that `export pictures` wrote, with size and SHA-256. Links are relative. Orthoimages in
`export/orthomosaic` are items with their transform.

Examples: `syntopic export pictures MISSION` and then `syntopic export stac MISSION`,
`syntopic export stac MISSION --license CC-BY-4.0 --trajectory sbet.out`
"""

GIS_HELP = """Write a GeoPackage with styles for QGIS, and a KMZ.

Layers: footprints and projection centres with their verdicts, flight lines as planned and as
flown, gaps of the plan, and the density of tie points of `syntopic triangulate`. An empty layer
states why it is empty.

Examples: `syntopic export gis MISSION`,
`syntopic export gis MISSION --trajectory sbet.out --dem dem.tif --crs EPSG:25833`
"""


def stac(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    license_id: Annotated[
        str, typer.Option("--license", help="SPDX identifier of the images' licence.")
    ] = "other",
    trajectory: Trajectory = None,
    mount: MountFile = None,
    crs: Crs = None,
    as_json: AsJson = False,
) -> None:
    from daemon.mission.layout import Mission
    from daemon.postflight.export.stac import export_stac

    folder = Mission.open(mission)
    with folder.held(), Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("describing", total=len(folder.numbers()))
        done = export_stac(
            folder,
            license_id=license_id,
            crs=crs,
            trajectory_file=trajectory,
            mount_file=mount,
            progress=lambda count: progress.update(task, completed=count),
        )
    if as_json:
        content = {
            "collection": str(done.collection),
            "items": done.items,
            "cogs": done.cogs,
            "orthoimages": done.orthoimages,
            "failures": [failure.as_json() for failure in done.failures],
        }
        typer.echo(json.dumps(content))
    else:
        console = Console(soft_wrap=True)
        console.print(
            f"{done.items} items, {done.cogs} COGs and {done.orthoimages} orthoimages in "
            f"{done.collection}"
        )
        if not done.cogs:
            console.print("No COG is linked. Run syntopic export pictures before this command.")
    exit_if_failed(done.failures)


def gis(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    dem: Annotated[
        Path | None, typer.Option(help="Height model for footprints: GeoTIFF or .asc.")
    ] = None,
    trajectory: Trajectory = None,
    mount: MountFile = None,
    crs: Crs = None,
    as_json: AsJson = False,
) -> None:
    from daemon.mission.layout import Mission
    from daemon.postflight.export.gis_export import export_gis

    folder = Mission.open(mission)
    with folder.held(), Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("locating", total=len(folder.numbers()))
        done = export_gis(
            folder,
            crs=crs,
            trajectory_file=trajectory,
            mount_file=mount,
            dem_file=dem,
            progress=lambda count: progress.update(task, completed=count),
        )
    if as_json:
        content = {
            "folder": str(done.folder),
            "layers": {
                layer.name: {"features": len(layer.features), "note": layer.note}
                for layer in done.layers
            },
            "failures": [failure.as_json() for failure in done.failures],
        }
        typer.echo(json.dumps(content))
    else:
        table = light_table("Layers", ("layer", "note"), ("features",))
        for layer in done.layers:
            table.add_row(layer.title, layer.note, str(len(layer.features)))
        console = Console()
        console.print(table)
        console.print(f"mission.gpkg and mission.kmz are in {done.folder}", soft_wrap=True)
    exit_if_failed(done.failures)
