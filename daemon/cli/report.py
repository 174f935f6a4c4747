"""`syntopic report`: a mission to be read, and to be sent to whoever helps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

HELP = """Write the mission's report: one HTML file that needs nothing beside it.

With --bundle also `export/support.zip`: configuration without secrets, records, verdicts, what
devices and service said, versions. No pixels, no raw bytes, no positions.

Examples: `syntopic report MISSION`, `syntopic report MISSION --bundle`
"""


def report(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    bundle: Annotated[bool, typer.Option("--bundle", help="Also what support needs.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    from daemon.disk.mission import Mission
    from daemon.disk.verification import verify
    from daemon.export.support_bundle import write_bundle
    from daemon.report import write_report

    folder = Mission.open(mission)
    console = Console(stderr=as_json, soft_wrap=True)
    path = write_report(folder.path)
    told: dict[str, object] = {"report": str(path)}
    if bundle:
        with console.status("checking every frame and record"):
            verified = verify(folder)
        written = write_bundle(folder, verified)
        told |= {"bundle": str(written.path), "contents": written.contents}
    if as_json:
        typer.echo(json.dumps(told))
        return
    console.print(f"Report   [bold]{path}[/]")
    if bundle:
        console.print(f"Bundle   [bold]{written.path}[/], {written.path.stat().st_size} bytes:")
        for name, nbytes in written.contents.items():
            console.print(f"  {name}: {nbytes} bytes", highlight=False)
