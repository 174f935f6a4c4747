"""Options, progress and figures that commands over the exposures of a mission have in common."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
    from daemon.postflight.batch.batch_run import BatchCounts, BatchOutcome, Compute
    from daemon.postflight.batch.capacity import ProcessAllocation
    from daemon.postflight.batch.executor import BatchExecutor, BatchTask, BatchWork

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


@dataclass(frozen=True)
class Placement:
    """Where the tasks of one work are computed, and with how many threads a process."""

    executor: BatchExecutor
    allocation: ProcessAllocation

    @property
    def threads(self) -> int:
        return self.allocation.threads


@dataclass(frozen=True)
class ExecutorOptions:
    """Options of a command whose exposures are computed by processes or by a cluster.

    The annotations are those of the command line (`takes_executor`).
    """

    processes: Processes = None
    threads: Threads = None
    scheduler: Scheduler = None
    tls_ca: TlsCa = None
    tls_certificate: TlsCertificate = None
    tls_key: TlsKey = None

    def check(self) -> None:
        """Refuse a cluster that cannot be used, before anything is read.

        Raises:
            MissingExtraError: dask is not installed.
            ConfigurationError: an address off this machine without TLS, processes of this
                machine, or TLS options without a scheduler.
        """
        from daemon.postflight.batch.cluster_address import given_tls_options

        given = given_tls_options(self.tls_ca, self.tls_certificate, self.tls_key)
        if self.scheduler is not None:
            self.cluster()
        elif given:
            raise ConfigurationError(
                [f"{given} is for a cluster; give its address: --scheduler tls://HOST:8786"]
            )

    def cluster(self) -> BatchExecutor:
        """The executor on the cluster of `scheduler`.

        Raises:
            MissingExtraError, ConfigurationError: see `check`.
        """
        from daemon.postflight.batch.cluster_address import cluster_address
        from drivers.base.extras import require

        scheduler = self.scheduler or ""
        if self.processes is not None:
            raise ConfigurationError(
                [
                    "--processes counts processes of this machine; with --scheduler those of the "
                    f"cluster compute. Leave it out, and give it to: syntopic worker {scheduler}"
                ]
            )
        address = cluster_address(scheduler, self.tls_ca, self.tls_certificate, self.tls_key)
        require("cluster")
        from daemon.postflight.batch.dask_executor import DaskExecutor

        console = Console(stderr=True, soft_wrap=True)
        return DaskExecutor(
            address, announce=lambda sentence: console.print(sentence, highlight=False)
        )

    def place(
        self,
        task_nbytes: int,
        tasks: int,
        tasks_per_process: int = 1,
        further_nbytes: int | None = None,
        shared_nbytes: int = 0,
    ) -> Placement:
        """An executor for so many tasks: the cluster, processes, or this process.

        Args:
            task_nbytes: memory of one process with a task.
            tasks: their number.
            tasks_per_process: as many as take longer than the start of a process.
            further_nbytes: memory of a further task in one process; None for that of a process.
            shared_nbytes: of `task_nbytes`, what all processes have in memory once.

        Raises:
            ConfigurationError: more processes than memory, or a cluster that cannot be used.
        """
        self.check()
        if self.scheduler is not None:
            from daemon.postflight.batch.capacity import ProcessAllocation

            return Placement(self.cluster(), ProcessAllocation(0, self.threads or 1, "its workers"))
        plan = self._allocation(task_nbytes, -(-tasks // tasks_per_process), shared_nbytes)
        if self.processes == 0 or (self.processes is None and plan.processes == 1):
            from daemon.postflight.batch import capacity
            from daemon.postflight.batch.in_process import InProcessExecutor
            from daemon.products.pipeline_pool import usable_count

            further = task_nbytes if further_nbytes is None else further_nbytes
            needed = task_nbytes + (IN_PROCESS_COUNT - 1) * further
            fits = needed <= capacity.available_memory_nbytes()
            return Placement(InProcessExecutor(IN_PROCESS_COUNT if fits else 1, usable_count), plan)
        from daemon.postflight.batch.local_processes import LocalProcessExecutor

        return Placement(LocalProcessExecutor(plan.processes), plan)

    def run(
        self,
        work: BatchWork,
        tasks: Sequence[BatchTask],
        description: str,
        tasks_per_process: int = 1,
    ) -> BatchOutcome:
        """Compute tasks where these options say, with progress on stderr.

        Args:
            work: what is computed.
            tasks: one for each exposure.
            description: such as "writing".
            tasks_per_process: see `place`.

        Raises:
            Exception: see `daemon.postflight.batch.batch_run.run_batch`.
        """
        from daemon.postflight.batch.batch_run import run_batch

        placed = self.place(work.memory_nbytes, len(tasks), tasks_per_process)
        with shown_progress(description, len(tasks), 0) as show:
            return run_batch(placed.executor, replace(work, threads=placed.threads), tasks, show)

    def compute(self, description: str, tasks_per_process: int = 1) -> Compute:
        """The same as a function of work and tasks, which raises KeyboardInterrupt after Ctrl-C.

        Args:
            description: such as "writing".
            tasks_per_process: see `place`.
        """

        def compute(work: BatchWork, tasks: Sequence[BatchTask]) -> BatchOutcome:
            return completed(self.run(work, tasks, description, tasks_per_process))

        from daemon.postflight.batch.batch_run import completed

        return compute

    def _allocation(
        self, task_nbytes: int, processes_max: int, shared_nbytes: int
    ) -> ProcessAllocation:
        from daemon.postflight.batch import capacity

        cores, available = capacity.usable_cores(), capacity.available_memory_nbytes()
        plan = capacity.plan_processes(
            task_nbytes,
            processes_max,
            cores=cores,
            available_nbytes=available,
            threads=self.threads,
            shared_nbytes=shared_nbytes,
        )
        if self.threads is not None and self.threads > cores:
            Console(stderr=True, soft_wrap=True).print(
                f"--threads {self.threads}: this machine has {cores} cores; more threads than "
                f"cores only wait for each other. Give --threads {cores} or fewer",
                style="yellow",
                highlight=False,
            )
        count = self.processes
        if count is None:
            return plan
        needed = shared_nbytes + count * (task_nbytes - shared_nbytes)
        if needed > available and count > 1:
            raise ConfigurationError(
                [
                    f"--processes {count} needs {needed / 1e9:.1f} GB of memory; "
                    f"{available / 1e9:.1f} GB are available. Give --processes {plan.processes}"
                ]
            )
        own = self.threads or (min(2, cores) if count == 0 else max(1, cores // count))
        return replace(plan, processes=count, threads=own, reason="as requested")


def takes_executor(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of `ExecutorOptions` in place of its parameter `where`.

    Args:
        command: a function that typer runs, with the keyword `where`.
    """
    signature = inspect.signature(command, eval_str=True)
    options = inspect.signature(ExecutorOptions, eval_str=True).parameters.values()
    parameters: list[inspect.Parameter] = []
    for parameter in signature.parameters.values():
        own = [option.replace(kind=parameter.kind) for option in options]
        parameters += own if parameter.name == "where" else [parameter]

    @functools.wraps(command)
    def run(**given: Any) -> None:
        where = {field.name: given.pop(field.name) for field in fields(ExecutorOptions)}
        command(**given, where=ExecutorOptions(**where))

    # typer reads it.
    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {one.name: one.annotation for one in parameters}
    return run


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
                (counts.memory_retries, "memory retries"),
                (counts.store_retries, "store retries"),
            )
            note = ", ".join(f"{count} {name}" for count, name in parts if count)
            progress.update(task, completed=complete + counts.done + counts.failed, note=note)

        yield show
