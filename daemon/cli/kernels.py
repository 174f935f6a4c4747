"""`syntopic kernels`: compile the pipeline ahead of the flight."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from daemon.cli.options import AsJson
from processing.rig import find_rig

HELP = """Compile the pipeline's kernels into the cache, so that nothing compiles in flight.

Kernels are compiled in as many processes as this machine has cores.

Examples: `syntopic kernels`, `syntopic kernels ultracam-x`
"""


def kernels(
    rig: Annotated[
        str, typer.Argument(help="Name of a shipped rig, or a rig file.")
    ] = "ultracam-x-mini",
    as_json: AsJson = False,
) -> None:
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    from daemon import DaemonError
    from daemon.terminal.console import Console
    from processing.pipelines import kernel_compilation
    from processing.pipelines.parallel_compilation import KernelCompilationError

    found = find_rig(rig)
    columns = (
        TextColumn("Compiling kernels"),
        BarColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[kernel]}"),
    )
    with Progress(
        *columns, console=Console(stderr=True), transient=True, speed_estimate_period=600
    ) as bar:
        task = bar.add_task("", total=None, kernel="")

        def show(kernel: str, done_s: float, total_s: float) -> None:
            is_last = done_s > total_s - 1e-6
            shown = "running the pipeline once" if is_last else kernel.removeprefix("processing.")
            bar.update(task, completed=done_s, total=total_s, kernel=shown)

        try:
            done = kernel_compilation.compile_for(found, progress=show)
        except KernelCompilationError as error:
            raise DaemonError(str(error)) from error
    if as_json:
        content = {"rig": found.name, "compiled": done.compiled, "seconds": round(done.seconds, 2)}
        typer.echo(json.dumps(content | {"variants": dict(done.variants)}))
        return
    typer.echo(
        f"{sum(done.variants.values())} kernels ready for {rig}, {done.compiled} variants compiled "
        f"in {done.seconds:.1f} s"
    )
