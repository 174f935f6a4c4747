"""The command `syntopic`: one file a subcommand, each a thin layer over the daemon.

Figures are printed as tables for people and, with --json, as one object for programs. Which
commands there are is in `daemon.cli.command_table`; a command's module is imported when it runs.
"""

from __future__ import annotations

import errno
import os
import sys
from importlib.metadata import version
from typing import Annotated, NoReturn

import typer

from daemon.cli import interrupt_messages
from daemon.cli.command_table import CommandGroup
from daemon.cli.exit_status import ExitStatus

app = typer.Typer(
    name="syntopic",
    cls=CommandGroup,
    help="Onboard software of an aerial camera made of several heads.\n\n"
    "Examples: `syntopic demo`, `syntopic run service.toml`, `syntopic calibrate lab --help`",
    epilog="Begin with: syntopic demo. Exit statuses of a command: syntopic COMMAND --help",
    no_args_is_help=True,
    add_completion=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"syntopic {version('syntopic')}")
        raise typer.Exit


@app.callback()
def syntopic(
    show_version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version.", is_eager=True, callback=_print_version
        ),
    ] = False,
) -> None:
    """Commands are in `daemon.cli.command_table`."""


_DISK_ERRNOS = frozenset(
    {errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.EACCES, errno.EPERM, errno.ENODEV}
)


def main() -> NoReturn:
    """Entry point: mistakes of the user end in sentences, not in a traceback."""
    try:
        app()
    except KeyboardInterrupt:
        interrupt_messages.print_notice(interrupt_messages.NOTHING_BEGUN)
        sys.exit(ExitStatus.INTERRUPTED)
    except Exception as error:  # noqa: BLE001 - what is not understood is raised again
        _print_refusal(error)
    sys.exit(ExitStatus.DONE)


def _print_refusal(error: Exception) -> NoReturn:
    """Print an error with its corrective action; the exit status is 1, of configuration 2.

    Raises:
        Exception: `error` itself, where it is no error of the user or of the machine.
    """
    from daemon import DaemonError
    from daemon.configuration.model import ConfigurationError
    from daemon.terminal.console import Console
    from drivers import DriverError
    from drivers.base.extras import missing_module
    from processing import ProcessingError
    from processing.rig import RigError

    console = Console(stderr=True, soft_wrap=True)
    if isinstance(error, ConfigurationError | RigError):
        count = len(error.problems)
        console.print(f"Refused: {count} error{'s' if count > 1 else ''}", style="bold red")
        for problem in error.problems:
            console.print(f"  {problem}", markup=False, highlight=False)
        sys.exit(ExitStatus.REFUSED)
    refusal: Exception | None = error
    if isinstance(error, ImportError):
        refusal = missing_module(error)
    elif isinstance(error, OSError):
        refusal = _disk_refusal(error)
    elif isinstance(error, ValueError):
        refusal = _validation_refusal(error)
    if not isinstance(refusal, DaemonError | DriverError | ProcessingError):
        raise error
    console.print(str(refusal), style="red", markup=False)
    sys.exit(ExitStatus.PROBLEM)


def _validation_refusal(error: ValueError) -> Exception:
    """The sentences of values that a file's model refuses; another `ValueError` as it is."""
    from pydantic import ValidationError

    from daemon import DaemonError
    from processing.rig.problem_sentences import findings_of, sentences

    if not isinstance(error, ValidationError):
        return error
    found = sentences(findings_of(error), f"values of {error.title}")
    return DaemonError("\n".join([*found, "Correct these values in the input and repeat."]))


def _disk_refusal(error: OSError) -> Exception:
    """The sentence of a call that the operating system refused.

    Raises:
        OSError: `error` itself, if it names no file: then it is not about a disk.
    """
    from daemon import DaemonError

    names = [
        os.fsdecode(n) for n in (error.filename, error.filename2) if isinstance(n, str | bytes)
    ]
    if error.errno not in _DISK_ERRNOS and not names:
        raise error
    where = " to ".join(names) or "the disk"
    return DaemonError(
        f"{where}: {error.strerror}. Files that have their names are complete; remove the cause "
        f"and {interrupt_messages.RETRY_HINT}"
    )
