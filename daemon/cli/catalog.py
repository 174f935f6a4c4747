"""`syntopic catalog`: exposures of many missions, and queries by place, time and quality."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Annotated

import typer

from daemon.cli.exit_status import status_of
from daemon.cli.options import AsJson
from daemon.cli.transfer import folder_of
from daemon.terminal.console import Console, light_table
from drivers.base.extras import require

app = typer.Typer(
    help="""Keep a catalog of many missions and query it.

A catalog is a folder with `exposures.parquet` (GeoParquet), `exposures.gpkg` for QGIS and STAC
collections under `catalog.json`. Requires `pip install 'syntopic[catalog]'`.

Examples: `syntopic catalog build season missions/ s3://survey/2026`,
`syntopic catalog query season --polygon block.geojson --verdict good`
""",
    rich_markup_mode="markdown",
    no_args_is_help=True,
)

BUILD_HELP = """Read the records of missions and write the catalog again.

A place is a mission, a folder of missions, or one of these in an object store. It is added to the
places of the catalog, which are all read again; with --replace it takes their place. A mission that
cannot be read is listed at the end; the others are in the catalog. Footprints are those of the
navigation in flight.

Examples: `syntopic catalog build season missions/`, `syntopic catalog build season`
"""

QUERY_HELP = """List exposures by polygon, time and quality.

Conditions hold together. With --commands the selection is printed as commands of `syntopic
process`, one a mission, in folders and in object stores.

Examples: `syntopic catalog query season --bbox 16 47 17 48 --since 2026-11-01 --verdict refly`,
`syntopic catalog query season --polygon block.geojson --gsd-max 0.1 --commands`
"""


@app.callback()
def catalog() -> None:
    """Keep a catalog of many missions."""


@app.command(help=BUILD_HELP)
def build(
    folder: Annotated[Path, typer.Argument(help="Folder of the catalog.")],
    places: Annotated[
        list[str] | None, typer.Argument(help="Missions, folders of missions, or stores.")
    ] = None,
    replace: Annotated[
        bool, typer.Option("--replace", help="Forget the earlier places of the catalog.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    require("catalog")
    from daemon.mission.transfer.object_store import is_store_url
    from daemon.postflight.mission_catalog.catalog_build import build_catalog

    found = [p if is_store_url(p) else str(folder_of(p)) for p in places or []]
    done = build_catalog(folder, found, replaces_places=replace)
    if as_json:
        content = {
            "folder": str(folder),
            "missions": done.missions,
            "exposures": done.exposures,
            "failures": list(done.failures),
        }
        typer.echo(json.dumps(content))
    else:
        console = Console(soft_wrap=True)
        console.print(f"{done.exposures} exposures of {done.missions} missions in {folder}")
        for failure in done.failures:
            console.print(failure, style="yellow", markup=False)
    raise typer.Exit(status_of(is_good=not done.failures))


@app.command(help=QUERY_HELP)
def query(
    folder: Annotated[Path, typer.Argument(help="Folder of the catalog.")],
    polygon: Annotated[Path | None, typer.Option(help="GeoJSON with polygons, WGS 84.")] = None,
    bbox: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(
            help="West, south, east, north in degrees; west > east crosses the antimeridian."
        ),
    ] = None,
    since: Annotated[str | None, typer.Option(help="First time, ISO 8601, UTC.")] = None,
    until: Annotated[str | None, typer.Option(help="Last time, ISO 8601, UTC.")] = None,
    verdict: Annotated[
        list[str] | None, typer.Option(help="Verdict: good, usable or refly; repeatable.")
    ] = None,
    gsd_max: Annotated[float | None, typer.Option(help="Largest GSD in m.")] = None,
    sun_min: Annotated[float | None, typer.Option(help="Least sun elevation in degrees.")] = None,
    mission: Annotated[list[str] | None, typer.Option(help="Id of a mission; repeatable.")] = None,
    commands: Annotated[
        bool, typer.Option("--commands", help="Commands that process the selection.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    require("catalog")
    from daemon.postflight.mission_catalog.catalog_queries import (
        CatalogQuery,
        parse_time,
        process_arguments,
        select,
    )

    selected = select(
        folder,
        CatalogQuery(
            polygon=polygon,
            bbox=bbox,
            since=None if since is None else parse_time(since),
            until=None if until is None else parse_time(until),
            verdicts=verdict or (),
            gsd_max_m=gsd_max,
            sun_min_deg=sun_min,
            missions=mission or (),
        ),
    )
    if as_json:
        content = {
            "exposures": selected,
            "commands": process_arguments(selected),
        }
        typer.echo(json.dumps(content))
    elif commands:
        for line in process_arguments(selected):
            typer.echo(shlex.join(line))
    else:
        table = light_table("Exposures", ("mission", "utc", "verdict"), ("exposure", "GSD m"))
        for one in selected:
            gsd = "" if one["gsd_m"] is None else f"{one['gsd_m']:.3f}"
            table.add_row(
                one["mission"], one["utc"] or "", one["verdict"] or "", str(one["exposure"]), gsd
            )
        console = Console()
        console.print(table)
        console.print(f"{len(selected)} exposures", highlight=False)
