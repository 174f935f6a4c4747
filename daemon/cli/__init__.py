"""The command `syntopic`: one file a subcommand, each a thin skin over the daemon.

Figures are printed as tables for people and, with --json, as one object for programs. Heavy parts
are imported inside the commands that need them, so that the service stays light.
"""

from __future__ import annotations

import errno
import os
import sys
from typing import NoReturn

import typer

from daemon.cli import (
    adjust,
    advise,
    at,
    bench,
    calibrate,
    certificate,
    check,
    command,
    demo,
    develop,
    disk_health,
    explain,
    export,
    imports,
    install,
    interruption,
    intersect,
    kernels,
    monitor,
    process,
    repair,
    replay,
    report,
    rigs,
    run,
    sim,
    token,
    transfer,
    verify,
)
from daemon.configuration.model import ConfigurationError
from daemon.errors import DaemonError
from daemon.terminal.console import Console
from drivers.base.extras import MissingExtraError, missing_module
from processing.rig import RigError

app = typer.Typer(
    name="syntopic",
    help="Onboard software of an aerial camera made of several heads.\n\n"
    "Examples: `syntopic demo`, `syntopic run service.toml`, `syntopic calibrate lab --help`",
    epilog="Begin with: syntopic demo",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command(name="demo", help=demo.HELP)(demo.demo)
app.command(name="run", help=run.HELP)(run.run)
app.command(name="explain", help=explain.HELP)(explain.explain)
app.command(name="monitor", help=monitor.HELP)(monitor.monitor)
app.command(name="command", help=command.HELP)(command.command)
app.command(name="check", help=check.HELP)(check.check)
app.command(name="certificate", help=certificate.HELP)(certificate.certificate)
app.command(name="process", help=process.HELP)(process.process)
app.command(name="develop", help=develop.HELP)(develop.develop)
app.command(name="verify", help=verify.HELP)(verify.verify)
app.command(name="replay", help=replay.HELP)(replay.replay)
app.command(name="report", help=report.HELP)(report.report)
app.command(name="repair", help=repair.HELP)(repair.repair)
app.command(name="transfer", help=transfer.HELP)(transfer.transfer)
app.command(name="adjust", help=adjust.HELP)(adjust.adjust)
app.command(name="at", help=at.HELP)(at.at)
app.command(name="sim", help=sim.HELP)(sim.sim)
app.command(name="bench", help=bench.HELP)(bench.bench)
app.command(name="kernels", help=kernels.HELP)(kernels.kernels)
app.command(name="advise", help=advise.HELP)(advise.advise)
app.command(name="orient", help=export.ORIENTATION_HELP)(export.orientation)
app.command(name="intersect", help=intersect.HELP)(intersect.intersect)
app.command(name="disk-health", help=disk_health.HELP)(disk_health.disk_health)
app.command(name="install", help=install.HELP)(install.install)
app.command(name="uninstall", help=install.UNINSTALL_HELP)(install.uninstall)
app.add_typer(rigs.app, name="rigs")
app.add_typer(imports.app, name="import")
app.add_typer(export.app, name="export")
app.add_typer(calibrate.app, name="calibrate")
app.add_typer(token.app, name="token")
interruption.make_interruptible(app)


_ABOUT_DISKS = frozenset(
    {errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.EACCES, errno.EPERM, errno.ENODEV}
)


def main() -> NoReturn:
    """Entry point: mistakes of the user end in sentences, not in a traceback."""
    try:
        app()
    except (ConfigurationError, RigError) as error:
        console = Console(stderr=True, soft_wrap=True)
        count = len(error.problems)
        console.print(f"Refused: {count} mistake{'s' if count > 1 else ''}", style="bold red")
        for problem in error.problems:
            console.print(f"  {problem}", markup=False, highlight=False)
        sys.exit(2)
    except (DaemonError, MissingExtraError) as error:
        _refuse(error)
    except ImportError as error:
        absent = missing_module(error)
        if absent is None:
            raise
        _refuse(absent)
    except OSError as error:
        _refuse(_disk_refusal(error))
    except KeyboardInterrupt:
        interruption.say(f"Interrupted: nothing was begun; {interruption.AGAIN}.")
        sys.exit(interruption.STATUS)
    sys.exit(0)


def _disk_refusal(error: OSError) -> DaemonError:
    """The sentence of a call that the operating system refused.

    Raises:
        OSError: `error` itself, if it names no file: then it is not about a disk.
    """
    names = [
        os.fsdecode(n) for n in (error.filename, error.filename2) if isinstance(n, str | bytes)
    ]
    if error.errno not in _ABOUT_DISKS and not names:
        raise error
    where = " to ".join(names) or "the disk"
    return DaemonError(
        f"{where}: {error.strerror}. Files that have their names are complete; remove the cause "
        f"and {interruption.AGAIN}"
    )


def _refuse(error: Exception) -> NoReturn:
    Console(stderr=True, soft_wrap=True).print(str(error), style="red", markup=False)
    sys.exit(1)
