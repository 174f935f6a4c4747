"""`syntopic repair`: bring a mission in order without flying it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

HELP = """Bring index, records, logs and disk of a mission together, as the service does on start.

A lost or damaged index is built again from the records, what was stored is sealed from the flight
log, and what was never whole is set aside. Level-0 is not touched. The exit status is 1 when
something cannot be put right. With --rebuild the index is made anew even if it looks well.

Example: `syntopic repair MISSION`
"""


def repair(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    rebuild: Annotated[bool, typer.Option("--rebuild", help="Make the index anew.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    from daemon.disk import durable, recovery
    from daemon.disk.log_seals import close_run, seal_logs
    from daemon.disk.mission import Mission
    from daemon.flight.recovery_match import seal_from_log
    from processing.rig import load_rig

    folder = Mission.open(mission)
    with folder.held():
        if rebuild:
            for name in ("mission.db", "mission.db-wal", "mission.db-shm"):
                (folder.path / name).unlink(missing_ok=True)
            durable.sync_directory(folder.path)
        report = recovery.recover(folder, seal_from_log(load_rig(folder.rig_path)))
        chain = folder.open_chain()
        logs = seal_logs(folder, chain)
        is_closed = close_run(folder, chain, "repair")
        chain.close()
    done = [*report.done, *(f"log {name}: sealed" for name in logs)]
    if is_closed:
        done.append("chain.jsonl: closed")
    if as_json:
        typer.echo(
            json.dumps(
                {
                    "done": done,
                    "problems": list(report.problems),
                    "sealed": list(report.sealed),
                    "lost": list(report.lost),
                    "exposures": len(report.settled),
                }
            )
        )
    else:
        console = Console(soft_wrap=True)
        for problem in report.problems:
            console.print(problem, style="red", markup=False, highlight=False)
        for sentence in done:
            console.print(sentence, markup=False, highlight=False)
        console.print(f"{len(report.settled)} exposures are sealed and in the index.")
        console.print(f"Next: [bold]syntopic verify {folder.path}[/]")
    raise typer.Exit(1 if report.problems else 0)
