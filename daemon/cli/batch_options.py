"""Options, progress and figures that commands over the exposures of a mission have in common."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from daemon.configuration.model import ConfigurationError
from daemon.terminal.console import Console

if TYPE_CHECKING:
    from daemon.postflight.batch.batch_run import BatchCounts
    from daemon.postflight.batch.capacity import ProcessAllocation
    from daemon.postflight.batch.executor import BatchExecutor

Processes = Annotated[
    int | None,
    typer.Option(
        help="Number of processes; 0 for none but this one (default: by cores and memory).", min=0
    ),
]
Threads = Annotated[
    int | None,
    typer.Option(help="Number of threads of one process (default: by cores).", min=1, max=256),
]
Scheduler = Annotated[
    str | None,
    typer.Option(help="Scheduler of a dask cluster, such as tcp://127.0.0.1:8786."),
]
TlsCa = Annotated[Path | None, typer.Option(help="Certificate of the authority, PEM.")]
TlsCertificate = Annotated[Path | None, typer.Option(help="Certificate, PEM.")]
TlsKey = Annotated[Path | None, typer.Option(help="Key of the certificate, PEM.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="List what would be computed.")]

IN_PROCESS_COUNT = 2
"""Exposures in work in one process, as in flight."""


class _RateColumn(ProgressColumn):
    """Exposures per second of the last half minute."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{speed:.2f}/s" if speed else "")


def executor_for(plan: ProcessAllocation, processes: int | None) -> BatchExecutor:
    """The executor on this machine: processes, or this one where it suffices.

    Args:
        plan: as computed.
        processes: as requested; 0 or None.
    """
    if processes == 0 or (processes is None and plan.processes == 1):
        from daemon.postflight.batch.in_process import InProcessExecutor
        from daemon.products.pipeline_pool import usable_count

        return InProcessExecutor(IN_PROCESS_COUNT, usable_count)
    from daemon.postflight.batch.local_processes import LocalProcessExecutor

    return LocalProcessExecutor(processes or plan.processes)


def cluster_executor(
    scheduler: str,
    ca: Path | None,
    certificate: Path | None,
    key: Path | None,
    processes: int | None = None,
) -> BatchExecutor:
    """The executor on a cluster.

    Args:
        scheduler: its address.
        ca: certificate of the authority.
        certificate: of this command.
        key: of the certificate.
        processes: as requested for this machine; refused.

    Raises:
        MissingExtraError: dask is not installed.
        ConfigurationError: an address off this machine without TLS, or processes of this machine.
    """
    from daemon.postflight.batch.cluster_address import cluster_address
    from drivers.base.extras import require

    if processes is not None:
        raise ConfigurationError(
            [
                "--processes counts processes of this machine; with --scheduler those of the "
                f"cluster compute. Leave it out, and give it to: syntopic worker {scheduler}"
            ]
        )
    require("cluster")
    from daemon.postflight.batch.dask_executor import DaskExecutor

    console = Console(stderr=True, soft_wrap=True)
    return DaskExecutor(
        cluster_address(scheduler, ca, certificate, key),
        announce=lambda sentence: console.print(sentence, highlight=False),
    )


def process_plan(
    task_nbytes: int, tasks: int, processes: int | None, threads: int | None
) -> ProcessAllocation:
    """Processes and threads for so many tasks on this machine, as now loaded.

    Raises:
        ConfigurationError: more processes than memory.
    """
    from dataclasses import replace

    from daemon.postflight.batch import capacity

    cores, available = capacity.usable_cores(), capacity.available_memory_nbytes()
    plan = capacity.plan_processes(
        task_nbytes, tasks, cores=cores, available_nbytes=available, threads=threads
    )
    if processes is None:
        return plan
    if processes * task_nbytes > available and processes > 1:
        raise ConfigurationError(
            [
                f"--processes {processes} needs {processes * task_nbytes / 1e9:.1f} GB of memory; "
                f"{available / 1e9:.1f} GB are available. Give --processes {plan.processes}"
            ]
        )
    own = threads or (min(2, cores) if processes == 0 else max(1, cores // processes))
    return replace(plan, processes=processes, threads=own, reason="as requested")


@contextmanager
def shown_progress(
    description: str, total: int, complete: int
) -> Iterator[Callable[[BatchCounts], None]]:
    """Progress n of N with rate and remaining time on stderr.

    Args:
        description: such as "processing".
        total: of exposures.
        complete: of them before the run.

    Yields:
        To be called with the counts of the run.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _RateColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(description, total=total, completed=complete, note="")

        def show(counts: BatchCounts) -> None:
            parts = (
                (counts.failed, "failed"),
                (counts.lost_processes, "processes lost"),
                (counts.store_retries, "store retries"),
            )
            note = ", ".join(f"{count} {name}" for count, name in parts if count)
            progress.update(task, completed=complete + counts.done + counts.failed, note=note)

        yield show
