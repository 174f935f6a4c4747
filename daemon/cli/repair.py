"""`syntopic repair`: bring a mission in order without flying it."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from daemon.cli.exit_status import status_of
from daemon.cli.options import AsJson
from daemon.terminal.console import Console

HELP = """Bring index, records, logs and disk of a mission together, as the service does on start.

A lost or damaged index is rebuilt from the records. Stored exposures are sealed from the flight
log, and incomplete ones are moved aside. Level-0 is not changed. What cannot be repaired
is listed. With --rebuild the index is rebuilt even if it is intact.

With --mirror two copies of a mission are synchronized: the leading copy is repaired, and the other
copy is updated from it. Differing files are moved aside, and nothing is overwritten.

Examples: `syntopic repair MISSION`, `syntopic repair MISSION --mirror /mnt/b/MISSION`
"""


def repair(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    rebuild: Annotated[bool, typer.Option("--rebuild", help="Rebuild of the index.")] = False,
    mirror: Annotated[
        Path | None, typer.Option("--mirror", help="Folder of the mission's other copy.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    from daemon.mission.layout import Mission
    from daemon.mission.log.log_seals import close_run, seal_logs
    from daemon.mission.mirror import mirror_repair
    from daemon.mission.store import durable
    from daemon.mission.verification import recovery
    from daemon.onboard.flight.recovery_match import seal_from_log
    from processing.rig import load_rig

    folder, other = Mission.open(mission), None if mirror is None else Mission.open(mirror)
    if other is not None:
        folder, other = mirror_repair.leading_first(folder, other)
    brought: list[str] = []
    with folder.held(), nullcontext() if other is None else other.held():
        if other is not None:
            brought += mirror_repair.before_recovery(folder, other)
        if rebuild:
            for name in ("mission.db", "mission.db-wal", "mission.db-shm"):
                (folder.path / name).unlink(missing_ok=True)
            durable.sync_directory(folder.path)
        report = recovery.recover(folder, seal_from_log(load_rig(folder.rig_path)))
        chain = folder.open_chain()
        logs = seal_logs(folder, chain)
        is_closed = close_run(folder, chain, "repair")
        chain.close()
        if other is not None:
            brought += mirror_repair.after_recovery(folder, other)
    done = [*report.done, *brought, *(f"log {name}: sealed" for name in logs)]
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
                    "exposures": len(report.finalized),
                }
            )
        )
    else:
        console = Console(soft_wrap=True)
        for problem in report.problems:
            console.print(problem, style="red", markup=False, highlight=False)
        for sentence in done:
            console.print(sentence, markup=False, highlight=False)
        console.print(f"{len(report.finalized)} exposures are sealed and in the index.")
        console.print(f"Next: syntopic verify {folder.path}")
    raise typer.Exit(status_of(is_good=not report.problems))
