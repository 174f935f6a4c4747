"""`syntopic report`: the mission report, and a support bundle."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from daemon.cli.exit_status import exit_if_failed
from daemon.cli.options import AsJson, lock_for
from daemon.terminal.console import Console

HELP = """Write the mission's report: one self-contained HTML file.

With --bundle also `export/support.zip`: configuration without secrets, records, verdicts, messages
of devices and service, versions. It contains no pixels, raw bytes or positions.

With --out nothing is written into the mission; this also works during the flight. Unreadable files
are listed in the report and at the end.

Examples: `syntopic report MISSION --bundle`, `syntopic report MISSION --out FOLDER`
"""


def report(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    bundle: Annotated[bool, typer.Option("--bundle", help="Support bundle in addition.")] = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder to write into (default: the mission's export).")
    ] = None,
    as_json: AsJson = False,
) -> None:
    from daemon.mission.layout import Mission
    from daemon.mission.verification.verification import verify
    from daemon.postflight.export.support_bundle import write_bundle
    from daemon.postflight.mission_report import write_report

    folder = Mission.open(mission)
    console = Console(stderr=as_json, soft_wrap=True)
    with lock_for(folder, out or folder.export_dir):
        done = write_report(folder.path, out=out)
        failures = [failure.as_json() for failure in done.failures]
        content: dict[str, object] = {"report": str(done.path), "failures": failures}
        if bundle:
            with console.status("checking every frame and record"):
                verified = verify(folder)
            written = write_bundle(folder, verified, out=out)
            content |= {"bundle": str(written.path), "contents": written.contents}
    path = done.path
    if as_json:
        typer.echo(json.dumps(content))
        exit_if_failed(done.failures)
        return
    console.print(f"Report   {path}")
    if bundle:
        console.print(f"Bundle   {written.path}, {written.path.stat().st_size} bytes:")
        for name, nbytes in written.contents.items():
            console.print(f"  {name}: {nbytes} bytes", highlight=False)
    exit_if_failed(done.failures)
