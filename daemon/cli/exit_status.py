"""Exit statuses of every command, and what status 1 means for each.

The help pages, the manual page and docs/reference/exit-status.md are rendered from these tables.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from daemon.mission.exposure_batch import ExposureFailure


class ExitStatus(enum.IntEnum):
    """How a command ended."""

    DONE = 0
    PROBLEM = 1
    REFUSED = 2
    WAITING = 3
    INTERRUPTED = 130


MEANINGS: Final = {
    ExitStatus.DONE: "The command is done and found no problem.",
    ExitStatus.PROBLEM: "The command found a problem, or could not finish.",
    ExitStatus.REFUSED: "The command line or the configuration is refused. Nothing was changed.",
    ExitStatus.WAITING: "No item fails, and at least one is waiting. Only `check` has it.",
    ExitStatus.INTERRUPTED: "Ctrl-C ended the command. The message states what is complete.",
}

PROBLEMS: Final = {
    "run": "the service ended after a fault that needs a person or a restart",
    "check": "an item fails, or a search found nothing",
    "monitor": "the connection is refused, or no service announced itself",
    "send": "the service refuses the command, or does not answer",
    "token": "the token file cannot be read or written, or the name is unknown or taken",
    "certificate": "a file exists or cannot be written",
    "explain": "no event or flag has that name",
    "reflights": "segments must be flown again",
    "verify": "a file is missing, altered or foreign",
    "repair": "something could not be repaired",
    "transfer": "a copy differs from its source, or could not be written",
    "catalog": "a mission could not be read or processed, or the query cannot be answered",
    "report": "a section of the report could not be computed",
    "process": "an exposure could not be processed; the others are done",
    "worker": "no scheduler answers",
    "pansharpen": "an exposure could not be processed; the others are done",
    "replay": "a result differs from the recorded one",
    "orient": "the orientation of an exposure cannot be computed",
    "triangulate": "the block cannot be adjusted, or a photograph has no orientation",
    "orthomosaic": "an image could not be read, or the block has no orthomosaic",
    "intersect": "no point can be intersected",
    "export": "the mission cannot be read, or a file could not be written",
    "import": "the input cannot be read or is inconsistent",
    "rigs": "a file could not be written",
    "calibrate": "the input does not determine the calibration",
    "calibrate thermal": "the flights change nothing",
    "calibrate validity": "a sensor was displaced, or the mission cannot be read",
    "adjust": "the adjustment did not converge, or the project is inconsistent (sigma0 beyond 20)",
    "force-ip": "the head does not answer, or keeps its address",
    "demo": "an exposure was lost, or the emulator or the service ended",
    "sim": "the emulator did not start",
    "bench": "a needed program or file is missing",
    "kernels": "a kernel cannot be compiled",
    "init": "no head answers, or the check of the written files fails",
    "schema": "the schema cannot be read",
    "disk-health": "no disk can be read",
    "install": "a step failed",
    "uninstall": "a step failed",
}
"""What status 1 means, by the name of a command, or of a group for all its commands."""


JSON_OPTIONS: Final = {"run": "--json-lines", "schema": ""}
"""Options that print figures as JSON, where they are not `--json`; `schema` prints JSON anyway."""


def status_of(*, is_good: bool) -> ExitStatus:
    """The status of a command that ran to its end."""
    return ExitStatus.DONE if is_good else ExitStatus.PROBLEM


def problem_of(name: str) -> str:
    """What status 1 of a command means.

    Args:
        name: of the command, such as "transfer" or "export raw".
    """
    return PROBLEMS.get(name) or PROBLEMS[name.partition(" ")[0]]


def statuses_of(name: str) -> dict[ExitStatus, str]:
    """The statuses that a command may end with, and their meanings."""
    found = {
        ExitStatus.DONE: "done",
        ExitStatus.PROBLEM: problem_of(name),
        ExitStatus.REFUSED: "command line or configuration refused",
        ExitStatus.WAITING: "an item is waiting",
        ExitStatus.INTERRUPTED: "interrupted",
    }
    if name != "check":
        del found[ExitStatus.WAITING]
    return found


def as_markdown() -> str:
    """The tables of docs/reference/exit-status.md."""
    lines = ["| status | meaning |", "|---|---|"]
    lines += [f"| {status:d} | {meaning} |" for status, meaning in MEANINGS.items()]
    lines += ["", "| command | figures as JSON | status 1 |", "|---|---|---|"]
    for name, problem in PROBLEMS.items():
        option = JSON_OPTIONS.get(name, "--json")
        figures = f"`{option}`" if option else "always"
        lines.append(f"| `{name}` | {figures} | {problem} |")
    return "\n".join(lines) + "\n"


def help_line(name: str) -> str:
    """The last line of a command's help page."""
    listed = "; ".join(f"{status:d} {meaning}" for status, meaning in statuses_of(name).items())
    return f"Exit status: {listed}."


def exit_if_failed(failures: Sequence[ExposureFailure]) -> None:
    """List the exposures that failed on stderr; a command without any continues.

    Raises:
        typer.Exit: with status 1, where an exposure failed.
    """
    import typer
    from rich.text import Text

    from daemon.terminal.console import Console, light_table

    if not failures:
        return
    count = len({failure.exposure for failure in failures})
    many = f"{count} exposures" if count > 1 else "1 exposure"
    table = light_table(f"{many} failed; every other one is done", ("exposure", "cause"), ())
    for failure in failures:
        table.add_row(f"{failure.exposure} ", Text(failure.cause, overflow="fold"))
    Console(stderr=True).print(table)
    raise typer.Exit(ExitStatus.PROBLEM)
