"""`syntopic command`: tell a running service something, over its Unix socket."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

HELP = """Give a running service a command.

Commands are start, stop, trigger, interval, distance, land and acknowledge. They go over the
service's Unix socket (`[watch] control`) and need no token: the machine knows who you are, and your
group decides. The exit status is 1 where the service refuses.

Examples: `syntopic command start`, `syntopic command interval --every 2.5 --count 40`,
`syntopic command acknowledge "device SU02"`, `syntopic command start --override`
"""
DEFAULT_SOCKET = Path("/run/syntopic/control.sock")


def command(
    name: Annotated[str, typer.Argument(help="What to do.")],
    fault: Annotated[str | None, typer.Argument(help="Which, for acknowledge.")] = None,
    socket: Annotated[Path, typer.Option(help="Where the service listens.")] = DEFAULT_SOCKET,
    override: Annotated[
        bool, typer.Option("--override", help="Fly although something is missing.")
    ] = False,
    every: Annotated[float | None, typer.Option(help="Seconds, for interval.")] = None,
    count: Annotated[int, typer.Option(help="For interval; 0: until stopped.")] = 0,
    metres: Annotated[float | None, typer.Option(help="For distance.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    from daemon.watch.control_socket import give

    arguments: dict[str, Any] = {
        "fault": fault,
        "override": override,
        "interval_s": every,
        "count": count,
        "distance_m": metres,
    }
    done, sentence = give(socket, name, arguments)
    if as_json:
        typer.echo(json.dumps({"done": done, "sentence": sentence}))
    else:
        Console(soft_wrap=True).print(sentence, style="" if done else "red", markup=False)
    if not done:
        raise typer.Exit(1)
