"""`syntopic install` and `syntopic uninstall`: the service as a part of the machine."""

from __future__ import annotations

import json
import sys
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated

import typer

from daemon.cli.exit_status import status_of
from daemon.cli.options import AsJson
from daemon.terminal.console import Console

if TYPE_CHECKING:
    from daemon.onboard.installation import InstallationReport

HELP = """Install the service: unit, user, folders, device rules, kernel settings, compiled kernels.

The configuration is validated first and stays in its place. Files edited by hand are not
overwritten. `--root` writes the files into an image instead.

Examples: `sudo /opt/syntopic/bin/syntopic install`, `syntopic install --root image/`
"""
UNINSTALL_HELP = """Stop the service and remove the files of `syntopic install`.

Missions, the configuration, the user and files edited by hand remain.

Example: `sudo /opt/syntopic/bin/syntopic uninstall`
"""

Root = Annotated[Path, typer.Option(help="Root folder of an image (default: this machine).")]


def install(
    config: Annotated[Path, typer.Argument(help="Configuration of the service.")] = Path(
        "/etc/syntopic/service.toml"
    ),
    root: Root = Path("/"),
    replace: Annotated[bool, typer.Option(help="Overwriting of files edited by hand.")] = False,
    as_json: AsJson = False,
) -> None:
    from daemon.onboard import installation
    from daemon.onboard.preflight.service_file import load

    command = Path(sys.argv[0]).absolute()
    configuration = PurePosixPath(config.absolute())
    rig, missions, mirror = None, None, None
    copy_to: tuple[Path, ...] = ()
    if config.exists():
        loaded, _ = load(config)
        rig, missions = loaded.mission.rig, loaded.mission.root
        mirror, copy_to = loaded.mission.mirror, loaded.landing.copy_to
    console = Console(stderr=True)
    done = installation.install(
        installation.contents(command, configuration, missions, mirror, copy_to),
        installation.steps(command, rig),
        root=root,
        log=lambda line: console.print(line, style="dim", highlight=False),
        replace=replace,
    )
    next_line = (
        "systemctl enable --now syntopic"
        if config.exists()
        else f"write {configuration} (syntopic sim RIG writes one to begin with), then "
        "syntopic check it, then install again: its rig's kernels are compiled then"
    )
    _print_outcome(done, as_json, "written", next_line)


def uninstall(root: Root = Path("/"), as_json: AsJson = False) -> None:
    from daemon.onboard import installation

    console = Console(stderr=True)
    done = installation.uninstall(
        root=root, log=lambda line: console.print(line, style="dim", highlight=False)
    )
    _print_outcome(done, as_json, "removed", "missions are still in /var/lib/syntopic")


def _print_outcome(done: InstallationReport, as_json: bool, verb: str, next_line: str) -> None:
    if as_json:
        content = {
            verb: done.files,
            "retained": done.retained,
            "steps": done.steps,
            "next": next_line,
        }
        typer.echo(json.dumps(content))
    else:
        console = Console()
        console.print(f"{len(done.files)} files {verb}")
        for path in done.retained:
            console.print(f"retained, edited by hand: {path}", style="yellow", highlight=False)
        for purpose, outcome in done.steps.items():
            console.print(f"{purpose}: {outcome}", highlight=False, soft_wrap=True)
        console.print(f"Next: {next_line}", highlight=False, soft_wrap=True)
    raise typer.Exit(status_of(is_good=not done.failed))
