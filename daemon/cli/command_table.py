"""Every command of `syntopic`: its name, where it is, one line of help, and its group.

A command's module is imported when the command runs, so that `syntopic --help` and the service
load nothing of the others. The help page and README list the commands in this order.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, MutableMapping
from typing import Any, Final, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command, get_group

from daemon.cli import interrupt_messages
from daemon.cli.exit_status import ExitStatus, help_line


class CommandEntry(NamedTuple):
    """One command, or one group of commands (`object_name` is a `typer.Typer` there)."""

    name: str
    module: str
    object_name: str
    help_name: str
    summary: str
    group: str


_IN_FLIGHT: Final = "In flight"
_GROUND: Final = "After landing"
_LABORATORY: Final = "In the laboratory"
_BENCH: Final = "On the bench"


def _command(
    name: str, group: str, summary: str, place: str = "", help_name: str = "HELP"
) -> CommandEntry:
    module, _, object_name = (place or name).partition(":")
    return CommandEntry(
        name, f"daemon.cli.{module}", object_name or module, help_name, summary, group
    )


TABLE: Final = {
    one.name: one
    for one in (
        _command(
            "run", _IN_FLIGHT, "Run the onboard service until SIGTERM or until the plan is flown."
        ),
        _command(
            "check", _IN_FLIGHT, "Check a configuration and verify each device with one datum."
        ),
        _command("monitor", _IN_FLIGHT, "Monitor a flight from a terminal."),
        _command("send", _IN_FLIGHT, "Send a command to a running service."),
        _command("token", _IN_FLIGHT, "Create, list and revoke access tokens.", "token:app"),
        _command("certificate", _IN_FLIGHT, "Create a local authority and a TLS certificate."),
        _command("explain", _IN_FLIGHT, "Explain an event or a quality flag: cause and action."),
        _command(
            "reflights", _IN_FLIGHT, "List the segments of the plan that must be flown again."
        ),
        _command("verify", _GROUND, "Check every file of a mission against its hash."),
        _command("repair", _GROUND, "Bring index, records, logs and disks of a mission together."),
        _command("transfer", _GROUND, "Copy a mission to a disk or an object store; verify it."),
        _command("catalog", _GROUND, "Keep and query a catalog of missions.", "catalog:app"),
        _command("report", _GROUND, "Write the mission report as one HTML file."),
        _command("process", _GROUND, "Process exposures again, Level-0 to Level-2."),
        _command("worker", _GROUND, "Join a cluster with the cores of this machine."),
        _command("pansharpen", _GROUND, "Compute Level-3: pansharpened RGB and CIR images."),
        _command("orthomosaic", _GROUND, "Compute the orthomosaic from the stitched images."),
        _command(
            "replay", _GROUND, "Replay a recorded flight through the code and compare hashes."
        ),
        _command(
            "orient",
            _GROUND,
            "Compute the exterior orientation of every head.",
            "export:orientation",
            "ORIENTATION_HELP",
        ),
        _command("triangulate", _GROUND, "Run the aerial triangulation of a mission."),
        _command("intersect", _GROUND, "Compute ground points from measured image points."),
        _command("export", _GROUND, "Export a mission for other programs.", "export:app"),
        _command(
            "import", _GROUND, "Import exposures or projects of other systems.", "imports:app"
        ),
        _command("rigs", _LABORATORY, "List the shipped rigs or describe a rig file.", "rigs:app"),
        _command(
            "calibrate", _LABORATORY, "Compute calibrations, each a new file.", "calibrate:app"
        ),
        _command("adjust", _LABORATORY, "Adjust a bundle from a project of text files."),
        _command("init", _BENCH, "Write rig.toml and service.toml for the connected devices."),
        _command("schema", _BENCH, "Print the JSON Schema of rig.toml or service.toml."),
        _command(
            "force-ip", _BENCH, "Give a GigE Vision head an IP address by broadcast.", "force_ip"
        ),
        _command("demo", _BENCH, "Fly the first flight with emulated devices."),
        _command("sim", _BENCH, "Run the emulated devices of a rig until Ctrl-C."),
        _command("bench", _BENCH, "Time the pipeline on one exposure against other software."),
        _command("kernels", _BENCH, "Compile the pipeline's kernels before a flight."),
        _command(
            "disk-health", _BENCH, "Read the health of every disk with smartctl.", "disk_health"
        ),
        _command("install", _BENCH, "Install the service: unit, user, folders, device rules."),
        _command(
            "uninstall",
            _BENCH,
            "Remove what `install` installed.",
            "install:uninstall",
            "UNINSTALL_HELP",
        ),
    )
}

RENAMED: Final = {
    "at": "triangulate",
    "develop": "pansharpen",
    "advise": "reflights",
    "command": "send",
}
"""Former names of commands, refused with the present one."""


def load(entry: CommandEntry) -> Any:
    """The command as click runs it, its module imported."""
    found = getattr(importlib.import_module(entry.module), entry.object_name)
    if isinstance(found, typer.Typer):
        _complete(found, entry.name)
        group = get_group(found)
        group.name = entry.name
        return group
    app = typer.Typer(add_completion=False, rich_markup_mode="markdown")
    text = getattr(importlib.import_module(entry.module), entry.help_name)
    app.command(name=entry.name, help=text)(found)
    _complete(app)
    return get_command(app)


def _complete(app: typer.Typer, group: str = "") -> None:
    """Give every command its sentence on Ctrl-C, and its exit statuses as last line of help."""
    for command in app.registered_commands:
        callback = command.callback
        if callback is not None:
            name = f"{group} {command.name or callback.__name__.replace('_', '-')}".strip()
            command.callback = interrupt_messages.interruptible(callback, name)
            command.epilog = help_line(name)
    for below in app.registered_groups:
        if below.typer_instance is not None and isinstance(below.name, str):
            _complete(below.typer_instance, f"{group} {below.name}".strip())


class _Loaded(MutableMapping[str, Any]):
    """Commands by name, each imported when it is looked up."""

    def __init__(self) -> None:
        self._loaded: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._loaded:
            self._loaded[name] = load(TABLE[name])
        return self._loaded[name]

    def __setitem__(self, name: str, command: Any) -> None:
        self._loaded[name] = command

    def __delitem__(self, name: str) -> None:
        del self._loaded[name]

    def __contains__(self, name: object) -> bool:
        return name in TABLE or name in self._loaded

    def __iter__(self) -> Iterator[str]:
        return iter(TABLE)

    def __len__(self) -> int:
        return len(TABLE)


class CommandGroup(TyperGroup):
    """The commands of `TABLE`. Its help page lists summaries and imports no command."""

    def __init__(self, **attributes: Any) -> None:
        attributes["commands"] = {}
        super().__init__(**attributes)
        self.commands = _Loaded()
        self._is_listing = False

    def invoke(self, ctx: Any) -> Any:
        """Import and run the command; Ctrl-C before it begins ends in one sentence as well."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            interrupt_messages.print_notice(interrupt_messages.NOTHING_BEGUN)
            raise typer.Exit(ExitStatus.INTERRUPTED) from None

    def list_commands(self, ctx: Any) -> list[str]:
        """The names, in the order of `TABLE`."""
        return list(self.commands)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command for click.

        Raises:
            UsageError: `cmd_name` is a former name; the sentence has the present one.
        """
        if cmd_name in RENAMED:
            ctx.fail(f"No such command '{cmd_name}'. Use '{RENAMED[cmd_name]}'.")
        if cmd_name not in self.commands:
            return None
        if self._is_listing:
            entry = TABLE[cmd_name]
            return TyperCommand(entry.name, help=entry.summary, rich_help_panel=entry.group)
        return self.commands[cmd_name]

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help page from the summaries."""
        self._is_listing = True
        try:
            super().format_help(ctx, formatter)
        finally:
            self._is_listing = False

    def shell_complete(self, ctx: Any, incomplete: str) -> Any:
        """Names and summaries that complete `incomplete`."""
        self._is_listing = True
        try:
            return super().shell_complete(ctx, incomplete)
        finally:
            self._is_listing = False
