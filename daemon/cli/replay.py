"""`syntopic replay`: a recorded flight through the same code again."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import ValidationError
from rich.progress import Progress

from daemon.cli.exit_status import ExitStatus
from daemon.cli.options import AsJson
from daemon.cli.process import as_flown
from daemon.configuration.model import Configuration, ConfigurationError
from daemon.mission.layout import Mission, MissionError
from daemon.terminal.console import Console, light_table

HELP = """Replay a recorded mission through the code and compare the results.

Bytes of receivers and probes pass their codecs, frames and marks pass matching and ledger, and
Level-0 passes the pipeline, with one and with two parallel exposures. Records are compared as
canonical JSON, images by the hash of their decoded pixels. Nothing is written.

Examples: `syntopic replay MISSION`, `syntopic replay MISSION --records-only --json`,
`syntopic replay MISSION --elevation terrain.asc`
"""
SENTENCES_SHOWN = 20


def replay(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    parallel: Annotated[
        list[int] | None, typer.Option(help="Parallel exposures; repeatable (default: 1 and 2).")
    ] = None,
    only: Annotated[
        list[int] | None,
        typer.Option(help="Number of an exposure whose images are compared; repeatable."),
    ] = None,
    records_only: Annotated[bool, typer.Option(help="Comparison without images.")] = False,
    radiometry: Annotated[
        Path | None, typer.Option(help="Folder of radiometric calibrations (default: as recorded).")
    ] = None,
    elevation: Annotated[
        Path | None, typer.Option(help="Height model (default: as recorded).")
    ] = None,
    as_json: AsJson = False,
) -> None:
    folder = Mission.open(mission)
    configuration = _flown_configuration(folder)
    threads = configuration.processing.threads
    os.environ.setdefault("NUMBA_NUM_THREADS", str(threads))
    from daemon.mission.log.flight_log import logs_of
    from daemon.onboard.flight.flight_identity import identity
    from daemon.postflight.replay.flight_replay import ReplayResult, replay_log
    from daemon.postflight.replay.product_comparison import compare_products, compare_records
    from processing.rig import load_rig

    rig = load_rig(folder.rig_path)
    made = identity(configuration, rig, folder)
    total = ReplayResult(is_complete=True)
    logs = logs_of(folder.log_dir)
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("records", total=len(logs))
        for log in logs:
            found = replay_log(
                log, folder, rig, configuration, lambda boot_id: replace(made, boot_id=boot_id)
            )
            compare_records(folder, found)
            total.add(found)
            progress.advance(task)
        if not records_only:
            plan, radiometry = as_flown(folder, radiometry, elevation)
            for count in parallel or [1, 2]:
                progress.update(
                    task,
                    description=f"images, {count} in work",
                    completed=0,
                    total=len(only or total.records),
                )
                compare_products(
                    folder,
                    rig,
                    configuration.processing,
                    plan,
                    total,
                    radiometry=radiometry,
                    parallel=count,
                    only=only or (),
                    progress=lambda _number: progress.advance(task),
                )
    _show(folder, total.as_json(), as_json=as_json)
    if not total.agrees:
        raise typer.Exit(ExitStatus.PROBLEM)


def _show(folder: Mission, result: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps({"mission": str(folder.path), **result}))
        return
    table = light_table(f"Replay of {folder.id}", ("what",), ("equal", "different"))
    for row in result["compared"]:
        table.add_row(row["what"], str(row["equal"]), str(row["different"]))
    console = Console()
    console.print(table)
    for sentence in result["sentences"][:SENTENCES_SHOWN]:
        console.print(sentence, style="yellow", markup=False)
    left = len(result["sentences"]) - SENTENCES_SHOWN
    if left > 0:
        console.print(f"and {left} more; --json has all of them")


def _flown_configuration(folder: Mission) -> Configuration:
    """The configuration that was flown; files that it names need not be here."""
    try:
        return Configuration.model_validate(folder.flown_configuration())
    except (MissionError, ValidationError) as error:
        raise ConfigurationError(
            [f"{folder.service_path}: {error}; a replay needs what was flown"]
        ) from error
