"""`syntopic export`: what a mission holds, in the form that other programs want."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import Progress

from daemon.cli.tables import light_table

ORIENTATION_HELP = """Exterior orientation of every cone of every exposure, at its own mid-exposure.

From the navigation of the flight, or from a post-processed trajectory; each trajectory gets a
folder of its own. Written are CSV, PAT-B, BINGO's angles, footprints (GeoJSON) and STAC items.

Examples: `syntopic orient MISSION`, `syntopic orient MISSION --trajectory sbet.out`,
`syntopic orient MISSION --mount boresight-2026-11-21/mount.toml`
"""

app = typer.Typer(
    help="""Write what others need into the mission's export folder.

Examples: `syntopic export raw MISSION`, `syntopic export orientation MISSION --crs EPSG:25833`
""",
    rich_markup_mode="markdown",
    no_args_is_help=True,
)


@app.callback()
def export() -> None:
    """Write what others need into the mission's export folder."""


@app.command()
def raw(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """The receivers' own bytes, one file each in its native format, and the event file.

    Example: `syntopic export raw missions/20261121T101500Z-ultracam-x-mini`
    """
    from daemon.mission import Mission
    from daemon.raw_export import export_raw

    done = export_raw(Mission.open(mission))
    if as_json:
        told = {"folder": str(done.folder), "nbytes": done.nbytes, "events": done.events}
        typer.echo(json.dumps(told))
        return
    console = Console()
    for name, nbytes in done.nbytes.items():
        console.print(f"{name}: {nbytes} bytes")
    console.print(f"events.csv: {done.events} exposures; frames.csv: every frame of theirs")
    console.print(f"They are in [bold]{done.folder}[/]", soft_wrap=True)


@app.command(help=ORIENTATION_HELP)
def orientation(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    trajectory: Annotated[
        Path | None, typer.Option(help="Post-processed trajectory: SBET, or .csv.")
    ] = None,
    crs: Annotated[
        str | None, typer.Option(help="Such as EPSG:25833 or EPSG:25833+7837; default: UTM zone.")
    ] = None,
    receiver: Annotated[
        str | None, typer.Option(help="Whose navigation, where there were several.")
    ] = None,
    mount: Annotated[
        Path | None, typer.Option(help="TOML with the [mount] to use, of calibrate boresight.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    from daemon import orientation_export
    from daemon.mission import Mission

    folder = Mission.open(mission)
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("orienting", total=len(folder.numbers()))
        done = orientation_export.export_orientation(
            folder,
            crs=crs,
            trajectory_file=trajectory,
            receiver=receiver,
            mount_file=mount,
            progress=lambda count: progress.update(task, completed=count),
        )
    if as_json:
        typer.echo(json.dumps(orientation_export.as_json(done)))
        return
    console = Console()
    table = light_table(
        f"{done.crs}, heights: {done.height_system}",
        ("image",),
        ("east m", "north m", "height m", "omega", "phi", "kappa"),
    )
    stitched = [eo for eo in done.oriented if eo.is_virtual]
    for eo in stitched or done.oriented:
        place = (f"{value:.2f}" for value in eo.centre_m)
        table.add_row(eo.name, *place, *(f"{angle:.4f}" for angle in eo.omega_phi_kappa_deg))
    console.print(table)
    if stitched:
        console.print(f"and {len(done.oriented) - len(stitched)} of single heads, in the files")
    for one in done.missing:
        console.print(f"{one.exposure:06d} {one.cone}: not oriented, {one.why}", style="yellow")
    if done.change_m is not None:
        console.print(
            f"Against the flight's own navigation: at most {done.change_m:.3f} m and "
            f"{done.change_deg:.4f} deg"
        )
    console.print(
        f"CSV, PAT-B, BINGO, footprints and STAC items are in [bold]{done.folder}[/]; read "
        "about.txt first",
        soft_wrap=True,
    )
