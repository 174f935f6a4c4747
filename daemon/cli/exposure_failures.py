"""How a command ends that walked a mission: exposures that failed, each with its cause."""

from __future__ import annotations

from collections.abc import Sequence

import typer
from rich.text import Text

from daemon.cli.exit_status import ExitStatus
from daemon.mission.exposure_batch import ExposureFailure
from daemon.terminal.console import Console
from daemon.terminal.tables import light_table


def exit_if_failed(failures: Sequence[ExposureFailure]) -> None:
    """List the exposures that failed on stderr; a command without any continues.

    Raises:
        typer.Exit: with status 1, where an exposure failed.
    """
    if not failures:
        return
    count = len({failure.exposure for failure in failures})
    many = f"{count} exposures" if count > 1 else "1 exposure"
    table = light_table(f"{many} failed; every other one is done", ("exposure", "cause"), ())
    for failure in failures:
        table.add_row(f"{failure.exposure} ", Text(failure.cause, overflow="fold"))
    Console(stderr=True).print(table)
    raise typer.Exit(ExitStatus.PROBLEM)
