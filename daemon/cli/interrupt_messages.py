"""State after Ctrl-C, in one sentence for each command.

Files appear complete or not at all (`daemon.mission.store.durable`), so that each sentence is true
at any instant. The command `run` handles Ctrl-C itself once its service is up.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import typer

from daemon.cli.exit_status import ExitStatus

RETRY_HINT = "run the same command again"
NOTHING_BEGUN = f"Interrupted: nothing was begun; {RETRY_HINT}."
_NOTHING_WRITTEN = f"nothing was changed; {RETRY_HINT}"
_COMPLETE_FILES = f"every file that has its name is complete, new or as it was before; {RETRY_HINT}"

SENTENCES = {
    "demo": f"the exposures stored so far are complete; {RETRY_HINT} for a new flight",
    "sim": f"all emulated devices are closed; {RETRY_HINT} to open them",
    "run": f"stored exposures are complete; {RETRY_HINT} to continue the flight",
    "monitor": f"the flight is not affected; {RETRY_HINT} to watch it",
    "send": "the service may have received the command; run `syntopic monitor` to see its state",
    "process": (
        "the products of exposures processed so far are complete and all others are as before; "
        f"{RETRY_HINT}, or name the remaining exposures with --only"
    ),
    "worker": f"exposures in work are finished or computed elsewhere; {RETRY_HINT} to join again",
    "pansharpen": (
        f"the images computed so far are complete and all others are as before; {RETRY_HINT} to "
        "compute the others"
    ),
    "orthomosaic": (
        f"the tiles computed so far stay and an earlier orthomosaic is as before; {RETRY_HINT} "
        "to continue"
    ),
    "repair": f"every step done so far is complete; {RETRY_HINT} to finish",
    "transfer": (
        "every file copied so far is complete, and nothing is removed before the copy is sealed; "
        f"{RETRY_HINT} to continue"
    ),
    "init": f"both files of the rig are complete, or both are as before; {RETRY_HINT}",
    "kernels": f"the kernels compiled so far remain; {RETRY_HINT} to compile the others",
    "force-ip": (
        "the head may have its new address; run `syntopic check --find-heads` to see its state"
    ),
    "install": f"every file written so far is complete; {RETRY_HINT} to finish",
    "uninstall": f"every file left is complete; {RETRY_HINT} to finish",
    **dict.fromkeys(
        ("explain", "check", "verify", "replay", "reflights", "disk-health"), _NOTHING_WRITTEN
    ),
    **dict.fromkeys(("bench", "rigs", "schema", "token list"), _NOTHING_WRITTEN),
    "certificate": (
        f"every file is complete, and the service uses the certificate it had; {RETRY_HINT} to "
        "finish"
    ),
    "token": (
        "the token file is complete; run `syntopic token list` to see whether it was changed"
    ),
    **dict.fromkeys(("report", "adjust", "triangulate", "orient", "intersect"), _COMPLETE_FILES),
    **dict.fromkeys(("calibrate", "catalog", "import", "export", "rigs show"), _COMPLETE_FILES),
}
"""By the name of a command, or of a group whose commands have none of their own."""


def sentence_of(name: str) -> str:
    """What is complete after Ctrl-C, and how to continue.

    Args:
        name: of the command, such as "transfer" or "export raw".
    """
    known = SENTENCES.get(name) or SENTENCES.get(name.partition(" ")[0]) or _COMPLETE_FILES
    return f"Interrupted: {known}."


def interruptible(callback: Callable[..., Any], name: str) -> Callable[..., Any]:
    """The same function, which ends with the sentence of its command on Ctrl-C."""

    @functools.wraps(callback)
    def run(*arguments: Any, **keywords: Any) -> Any:
        try:
            return callback(*arguments, **keywords)
        except KeyboardInterrupt:
            print_notice(sentence_of(name))
            raise typer.Exit(ExitStatus.INTERRUPTED) from None

    return run


def print_notice(sentence: str) -> None:
    """Print where errors are printed."""
    from daemon.terminal.console import Console

    console = Console(stderr=True, soft_wrap=True)
    console.print(sentence, style="yellow", markup=False, highlight=False)
