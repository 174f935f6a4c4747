"""`syntopic explain`: the meaning of an event or a quality flag."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from daemon.cli.exit_status import ExitStatus
from daemon.cli.options import AsJson
from daemon.terminal.console import Console, light_table

if TYPE_CHECKING:
    from daemon.onboard.flight.event_table import EventDefinition
    from daemon.onboard.flight.flag_table import FlagDefinition

HELP = """Explain an event of the service or a quality flag: cause and action.

Without NAME all are listed. NAME may be part of a name.

Examples: `syntopic explain lost`, `syntopic explain TILT`, `syntopic explain --json`
"""


def explain(
    name: Annotated[str, typer.Argument(help="An event or a flag, or part of its name.")] = "",
    as_json: AsJson = False,
    markdown: Annotated[
        bool, typer.Option("--markdown", help="Output as the page docs/reference/flight/events.md.")
    ] = False,
) -> None:
    from daemon.onboard.flight.event_table import TABLE, as_markdown, entry_of
    from daemon.onboard.flight.flag_table import FLAG_TABLE

    if markdown:
        sys.stdout.write(as_markdown())
        return
    exact = entry_of(name)
    events = [exact] if exact else [entry for entry in TABLE if name in entry.name]
    is_event = exact is not None and exact.name == name
    flags = [] if is_event else [e for e in FLAG_TABLE if name.upper() in e.name]
    if any(entry.name == name.upper() for entry in flags):
        events = []
        flags = [entry for entry in flags if entry.name == name.upper()]
    if as_json:
        content = {
            "events": [asdict(entry) for entry in events],
            "flags": [asdict(entry) for entry in flags],
        }
        sys.stdout.write(json.dumps(content) + "\n")
    else:
        _print(events, flags, name)
    if not events and not flags:
        raise typer.Exit(ExitStatus.PROBLEM)


def _print(events: Sequence[EventDefinition], flags: Sequence[FlagDefinition], name: str) -> None:
    console = Console()
    if events:
        table = light_table(
            f"{len(events)} event{'s' * (len(events) != 1)}",
            ("event", "severity", "cause", "action"),
            (),
        )
        for event in events:
            table.add_row(event.name, event.severity, event.cause, event.action)
        console.print(table)
    if flags:
        table = light_table(
            f"{len(flags)} flag{'s' * (len(flags) != 1)}", ("flag", "cause", "action"), ()
        )
        for flag in flags:
            table.add_row(flag.name, flag.cause, flag.action)
        console.print(table)
    if not events and not flags:
        console.print(f"No event or flag has {name!r} in its name.", markup=False)
