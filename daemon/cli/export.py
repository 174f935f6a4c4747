"""`syntopic export`: what a mission holds, in the form that other programs want."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

app = typer.Typer(
    help="""Write what others need into the mission's export folder.

Example: `syntopic export raw MISSION`
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
    """The receivers' own bytes, one file each in its native format, and the event file."""
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
    console.print(f"events.csv: {done.events} exposures")
    console.print(f"They are in [bold]{done.folder}[/]", soft_wrap=True)
