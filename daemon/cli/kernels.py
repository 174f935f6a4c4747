"""`syntopic kernels`: compile the pipeline ahead of the flight."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from processing.rig import find_rig

HELP = """Compile the pipeline's kernels into the cache, so that nothing compiles in flight.

Examples: `syntopic kernels`, `syntopic kernels ultracam-x`
"""


def kernels(
    rig: Annotated[
        str, typer.Argument(help="Name of a shipped rig, or a rig file.")
    ] = "ultracam-x-mini",
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    from processing.pipelines import kernel_compilation

    found = find_rig(rig)
    done = kernel_compilation.compile_for(found)
    if as_json:
        content = {"rig": found.name, "compiled": done.compiled, "seconds": round(done.seconds, 2)}
        typer.echo(json.dumps(content | {"variants": dict(done.variants)}))
        return
    typer.echo(
        f"{sum(done.variants.values())} kernels ready for {rig}, {done.compiled} of them compiled "
        f"just now, {done.seconds:.1f} s"
    )
