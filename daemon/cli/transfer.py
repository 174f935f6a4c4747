"""`syntopic transfer`: a mission on its way from the aircraft's disk to another."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from daemon.cli.options import AsJson
from daemon.terminal.console import Console

HELP = """Copy a mission to another disk and verify every file.

Each file is read back from the other disk and compared by hash, in every run. An interrupted
transfer continues when the same command is run again. The source remains unless --remove-source is
given: then the copy is sealed, the source is removed, and no later run changes the copy.

Example: `syntopic transfer MISSION /media/shuttle`
"""


def transfer(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    disk: Annotated[Path, typer.Argument(help="Folder of the other disk.")],
    remove_source: Annotated[
        bool, typer.Option("--remove-source", help="Remove the source after the copy is sealed.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    from daemon.mission.layout import Mission
    from daemon.mission.transfer.transfer import finish_transfer
    from daemon.mission.transfer.transfer import transfer as run

    columns = (BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("copying and reading back", total=None)

        def show(done: int, total: int) -> None:
            progress.update(task, completed=done, total=total)

        finished = None
        if not mission.exists():
            finished = finish_transfer(mission, disk, progress=show)
        report = finished or run(
            Mission.open(mission), disk, remove_source=remove_source, progress=show
        )
    if as_json:
        typer.echo(
            json.dumps(
                {
                    "target": str(report.target),
                    "copied": report.copied,
                    "already_present": report.already_present,
                    "nbytes": report.nbytes,
                    "exposures": report.verified.exposures,
                    "frames": report.verified.frames,
                    "source_removed": report.source_removed,
                    "sealed_utc": report.sealed_utc,
                }
            )
        )
        return
    console = Console(soft_wrap=True)
    console.print(
        f"{report.copied} files copied, {report.already_present} identical files unchanged, "
        f"{report.nbytes / 1e9:.2f} GB in all; {report.verified.exposures} exposures and "
        f"{report.verified.frames} frames verified in {report.target}"
    )
    if report.sealed_utc:
        console.print(f"The copy is sealed since {report.sealed_utc}.")
    console.print("The source is removed." if report.source_removed else "The source is unchanged.")
