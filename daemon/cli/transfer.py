"""`syntopic transfer`: a mission on its way from the aircraft's disk to another."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

HELP = """Copy a mission to another disk, every byte read back and every hash checked.

Interrupted, it goes on where it stopped when it is started again. The source is kept, unless
--remove-source is given and the whole copy is verified.

Example: `syntopic transfer MISSION /media/shuttle`
"""


def transfer(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    disk: Annotated[Path, typer.Argument(help="Folder of the other disk.")],
    remove_source: Annotated[
        bool, typer.Option("--remove-source", help="Delete the mission here once it is verified.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    from daemon.disk.mission import Mission
    from daemon.disk.transfer import transfer as run

    columns = (BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("copying and reading back", total=None)
        report = run(
            Mission.open(mission),
            disk,
            remove_source=remove_source,
            progress=lambda done, total: progress.update(task, completed=done, total=total),
        )
    if as_json:
        typer.echo(
            json.dumps(
                {
                    "target": str(report.target),
                    "copied": report.copied,
                    "kept": report.kept,
                    "nbytes": report.nbytes,
                    "exposures": report.verified.exposures,
                    "frames": report.verified.frames,
                    "source_removed": report.source_removed,
                }
            )
        )
        return
    console = Console(soft_wrap=True)
    console.print(
        f"{report.copied} files copied, {report.kept} were there already, "
        f"{report.nbytes / 1e9:.2f} GB in all; {report.verified.exposures} exposures and "
        f"{report.verified.frames} frames verified in [bold]{report.target}[/]"
    )
    console.print(
        "The source was removed." if report.source_removed else "The source is where it was."
    )
