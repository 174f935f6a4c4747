"""`syntopic kernels`: compile the pipeline ahead of the flight."""

from __future__ import annotations

import time

import typer

HELP = """Compile the pipeline's kernels into the cache, so that nothing compiles in flight.

Example: `syntopic kernels`
"""


def kernels() -> None:
    from processing import compiled

    started = time.monotonic()
    count = compiled.warm_up()
    typer.echo(f"{count} kernels ready after {time.monotonic() - started:.1f} s")
