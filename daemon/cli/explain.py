"""`syntopic explain`: what an event means, and what helps."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from typing import Annotated

import typer

from daemon.terminal.console import Console
from daemon.terminal.tables import light_table

HELP = """Explain an event of the service: meaning, cause and corrective action.

Without NAME all events are listed. NAME may be part of a name.

Examples: `syntopic explain lost`, `syntopic explain arming`, `syntopic explain --json`
"""


def explain(
    name: Annotated[str, typer.Argument(help="An event, or part of its name.")] = "",
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    markdown: Annotated[
        bool, typer.Option("--markdown", help="Output as the page docs/events.md.")
    ] = False,
) -> None:
    from daemon.onboard.flight.event_table import TABLE, as_markdown, entry_of

    if markdown:
        sys.stdout.write(as_markdown())
        return
    exact = entry_of(name)
    found = [exact] if exact else [entry for entry in TABLE if name in entry.name]
    if as_json:
        sys.stdout.write(json.dumps({"events": [asdict(entry) for entry in found]}) + "\n")
    else:
        table = light_table(f"{len(found)} events", ("event", "severity", "cause", "action"), ())
        for entry in found:
            table.add_row(entry.name, entry.severity, entry.cause, entry.action)
        Console().print(table)
    if not found:
        raise typer.Exit(1)
