"""`syntopic disk-health`: ask the disks how they are, for the service that may not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from daemon.cli.options import AsJson

HELP = """Read the health of every disk with smartctl and store it for the service.

A timer runs this as root every two minutes (syntopic-disk-health.timer). If no disk can be
read, the service reports it.

Examples: `syntopic disk-health`, `syntopic disk-health --out /tmp/disks.json`
"""


def disk_health(
    out: Annotated[Path | None, typer.Option(help="File to write (default: in /run).")] = None,
    as_json: AsJson = False,
) -> None:
    from daemon.mission.store import health
    from daemon.mission.store.output_places import refuse_foreign_file

    path = out or health.REPORT
    refuse_foreign_file(path, health.is_report, cure="give another name with --out")
    try:
        report = health.collect()
    except health.HealthError as error:
        health.write_report(path, health.failed_report(error))
        raise
    health.write_report(path, report)
    if as_json:
        typer.echo(json.dumps(report))
        return
    for name, stated in report["disks"].items():
        found = health.health_of(stated)
        verdict = "; ".join(found.problems) or "healthy"
        typer.echo(f"{name} {found.model} {found.serial}: {verdict}")
