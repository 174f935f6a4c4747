"""`syntopic send`: send a command to a running service over its Unix socket."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from daemon.cli.exit_status import ExitStatus
from daemon.cli.options import AsJson
from daemon.terminal.console import Console

HELP = """Send a command to a running service.

Commands are those of the API (docs/how-to/flight/watching.md): arm, start, stop, trigger, interval,
distance, land, acknowledge, exposure, reject, accept, withdraw, retake,
new-mission, release-disk, accept-disk, verify, copy, report, shutdown. They go over the service's
Unix socket (`[watch] control`) and need no token: the service authorizes them by user and group.

Examples: `syntopic send start`,
`syntopic send arm --override --set reason="probe 3 is known to be broken"`,
`syntopic send interval --set interval_s=2.5 --set count=40`,
`syntopic send acknowledge --set fault="device SU02"`,
`syntopic send release-disk --set disk=mirror`
"""
DEFAULT_SOCKET = Path("/run/syntopic/control.sock")


def send(
    name: Annotated[str, typer.Argument(help="Command.")],
    socket: Annotated[Path, typer.Option(help="Unix socket of the service.")] = DEFAULT_SOCKET,
    override: Annotated[
        bool, typer.Option("--override", help="Override of missing prerequisites.")
    ] = False,
    values: Annotated[
        list[str] | None, typer.Option("--set", help="KEY=VALUE of the command; repeatable.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    from daemon.onboard.monitoring.access.control_socket import send_command

    arguments: dict[str, Any] = {"override": True} if override else {}
    for given in values or []:
        key, equals, value = given.partition("=")
        if not equals:
            raise typer.BadParameter(f"--set {given}: write KEY=VALUE")
        arguments[key] = _read(value)
    done, sentence = send_command(socket, name, arguments)
    if as_json:
        typer.echo(json.dumps({"done": done, "sentence": sentence}))
    else:
        Console(soft_wrap=True).print(sentence, style="" if done else "red", markup=False)
    if not done:
        raise typer.Exit(ExitStatus.PROBLEM)


def _read(value: str) -> Any:
    """A number where it is one, else text."""
    try:
        return json.loads(value)
    except ValueError:
        return value
