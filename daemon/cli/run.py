"""`syntopic run`: the onboard service."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from daemon.cli.exit_status import ExitStatus

HELP = """Run the onboard service with a configuration, until SIGTERM or until the plan is flown.

A service that was killed resumes the same mission with the rig it began with; where the configured
rig differs, the sentence names the keys, and --new-mission begins another one. Events are printed
one per line as text, or with --json-lines as one JSON object each.

Examples: `syntopic run service.toml`, `syntopic run service.toml --json-lines`
"""


def run(
    config: Annotated[Path, typer.Argument(help="Service configuration (TOML).")],
    json_lines: Annotated[
        bool, typer.Option("--json-lines", help="One JSON object per event.")
    ] = False,
    parent: Annotated[
        int | None,
        typer.Option(help="Process whose end makes the service land.", metavar="PID"),
    ] = None,
    new_mission: Annotated[
        bool,
        typer.Option("--new-mission", help="New mission; an interrupted one is sealed and closed."),
    ] = False,
) -> None:
    from daemon.mission.mirror.mirror_startup import interrupted_mission
    from daemon.onboard.preflight.resumption import close_interrupted
    from daemon.onboard.preflight.service_file import load
    from daemon.onboard.service.processes import die_with_parent
    from daemon.onboard.service.service import Service

    if parent is not None:
        die_with_parent(parent, signal.SIGTERM)
    show = _print_json if json_lines else _print_line
    continues, status = True, 0
    while continues:
        # Read again: a new mission may have another plan.
        configuration, rig = load(config)
        if new_mission and (mission := interrupted_mission(configuration)) is not None:
            show({"event": "closed", "id": mission.id, "recovery": close_interrupted(mission)})
        service = Service(configuration, rig, config, show)
        status = asyncio.run(service.run())
        continues = service.continues and status == 0
    raise typer.Exit(ExitStatus(status))


def _print_json(event: Mapping[str, Any]) -> None:
    _write_line(json.dumps(event))


def _print_line(event: Mapping[str, Any]) -> None:
    """One fact a line, key=value; what is long (reports, ledgers) is in the mission folder."""
    fields = [
        f"{key}={value}"
        for key, value in event.items()
        if key not in ("event", "mono_ns", "report", "ledger") and value not in (None, [], {})
    ]
    if "report" in event:
        fields.append(f"verdict={event['report'].get('verdict')}")
    _write_line(f"{event['event']} {' '.join(fields)}")


def _write_line(line: str) -> None:
    """A reader that has ended, or a full disk behind it, ends no flight."""
    try:
        print(line, flush=True)
    except OSError:
        sys.stdout = Path(os.devnull).open("w")  # noqa: SIM115 - open as long as the service lives
