"""`syntopic verify`: is what a mission folder holds still what was stored?"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import Progress

HELP = """Check every frame and record of a mission against its hash and the chain of records.

The exit status is 0 when all is well, 1 when something is missing, altered or extra.

Example: `syntopic verify flights/demo/missions/20261121T101500Z-ultracam-x-mini`
"""


def verify(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    from daemon.disk import store
    from daemon.disk.mission import Mission

    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("verifying", total=None)

        def show(done: int, total: int) -> None:
            progress.update(task, completed=done, total=total)

        report = store.verify(Mission.open(mission), show)
    if as_json:
        typer.echo(
            json.dumps(
                {
                    "exposures": report.exposures,
                    "frames": report.frames,
                    "problems": list(report.problems),
                }
            )
        )
    else:
        console = Console()
        for problem in report.problems:
            console.print(f"[red]{problem}[/]")
        verdict = "all well" if not report.problems else f"{len(report.problems)} problems"
        console.print(f"{report.exposures} exposures, {report.frames} frames: {verdict}")
    raise typer.Exit(1 if report.problems else 0)
