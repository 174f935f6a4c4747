"""`syntopic verify`: is what a mission folder holds still what was stored?"""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import Progress
from rich.table import Table
from rich.text import Text

from daemon.cli.batch_options import ExecutorOptions, Scheduler, TlsCa, TlsCertificate, TlsKey
from daemon.cli.exit_status import status_of
from daemon.cli.options import AsJson
from daemon.cli.transfer import folder_of
from daemon.configuration.model import ConfigurationError
from daemon.terminal.console import Console
from drivers.base.extras import require

if TYPE_CHECKING:
    from daemon.mission.verification.verification import CheckAll, VerifyReport

HELP = """Check a mission folder against its hashes and list files without a hash.

Files without a hash do not change the exit status. A mission may be verified while it is flown.

A mission that `syntopic transfer` copied to an object store is read there, each object once.

With --processes or --scheduler, exposures of a mission folder are compared by processes of this
machine or by a cluster.

Examples: `syntopic verify flights/demo/missions/20261121T101500Z-ultracam-x-mini`,
`syntopic verify s3://survey/2026/20261121T101500Z-ultracam-x-mini`
"""
HashProcesses = Annotated[
    int | None,
    typer.Option(help="Number of processes (default: threads of this process).", min=1, max=1024),
]
SHOWN = 5
"""So many names of files that are not covered are printed for each reason; --json has all."""


def verify(
    mission: Annotated[str, typer.Argument(help="Mission folder, or its address in a store.")],
    processes: HashProcesses = None,
    scheduler: Scheduler = None,
    tls_ca: TlsCa = None,
    tls_certificate: TlsCertificate = None,
    tls_key: TlsKey = None,
    as_json: AsJson = False,
) -> None:
    from daemon.mission.layout import Mission
    from daemon.mission.store import store
    from daemon.mission.transfer.object_store import ObjectStore, is_store_url
    from daemon.mission.transfer.store_verification import verify_in_store
    from daemon.mission.verification.verification import check_in_threads
    from daemon.postflight.batch.local_processes import LocalProcessExecutor
    from daemon.postflight.batch.verification_work import verified_by

    where = ExecutorOptions(processes, None, scheduler, tls_ca, tls_certificate, tls_key)
    where.check()
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("verifying", total=None)

        def show(done: int, total: int) -> None:
            progress.update(task, completed=done, total=total)

        if is_store_url(mission):
            require("stores")
            if processes is not None or scheduler is not None:
                raise ConfigurationError(
                    ["--processes and --scheduler are for mission folders; leave them out"]
                )
            report = verify_in_store(ObjectStore(mission), show)
        else:
            folder = Mission.open(folder_of(mission), checks_subfolders=False)
            check_all: CheckAll = check_in_threads
            if scheduler is not None:
                check_all = verified_by(where.cluster())
            elif processes is not None:
                check_all = verified_by(LocalProcessExecutor(processes))
            report = store.verify(folder, show, check_all)
    if as_json:
        typer.echo(json.dumps(asdict(report)))
    else:
        _print(report)
    raise typer.Exit(status_of(is_good=not report.problems))


def _print(report: VerifyReport) -> None:
    from daemon.mission.verification.verification import STATES

    console = Console(soft_wrap=True)
    table = Table("what", "files", "hash in", title="Covered", title_justify="left", box=None)
    for covered in report.covered:
        table.add_row(covered.what, str(covered.files), covered.by)
    console.print(table)
    if report.not_covered:
        table = Table("why", "files", "names", title="Not covered", title_justify="left", box=None)
        for one in report.not_covered:
            more = ["..."] if len(one.files) > SHOWN else []
            names = "\n".join(_printable(name) for name in [*one.files[:SHOWN], *more])
            table.add_row(one.reason, str(len(one.files)), Text(names))
        console.print(table)
    for remark in report.remarks:
        console.print(_printable(remark), markup=False, highlight=False)
    for problem in report.problems:
        console.print(_printable(problem), style="red", markup=False, highlight=False)
    wrong = len(report.problems)
    verdict = "nothing is wrong" if not wrong else f"{wrong} problem{'s' if wrong > 1 else ''}"
    console.print(f"Mission: {STATES[report.state]}", highlight=False)
    console.print(f"{report.exposures} exposures, {report.frames} frames: {verdict}")


def _printable(text: str) -> str:
    """File names may hold bytes that are no text, and control characters."""
    shown = text.encode("utf-8", "backslashreplace").decode("utf-8")
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in shown)
