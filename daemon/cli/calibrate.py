"""`syntopic calibrate`: calibrations from what was flown, proposed and never put in place."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from daemon.cli import (
    calibrate_board,
    calibrate_boresight,
    calibrate_flight,
    calibrate_head,
    calibrate_lab,
    calibrate_platform,
    calibrate_radiometric,
    calibrate_rig,
)
from daemon.cli.exit_status import status_of
from daemon.cli.options import AsJson
from daemon.terminal.console import Console, light_table

if TYPE_CHECKING:
    from daemon.postflight.calibration.thermal_calibration import ThermalRecords
    from processing.calibration.thermal_learning import LearnedDrift, Observability
    from processing.calibration.thermal_proposal import ProposedChange

HELP = """Compute calibrations from laboratory series and flown missions, each as a new, dated file.

Examples: `syntopic calibrate board PICTURES --rig rig.toml --board charuco:11x8:30mm:22mm`,
`syntopic calibrate lab SERIES`, `syntopic calibrate thermal MISSION...`
"""

app = typer.Typer(help=HELP, no_args_is_help=True, rich_markup_mode="markdown")

THERMAL_HELP = """Estimate the temperature-dependent model from flown missions.

The missions were flown with one rig file at dC that spread over at least 5 K. The residuals of
their stitching give a new, dated rig file, which takes effect only after it is configured. No file
is overwritten.

Examples: `syntopic calibrate thermal MISSION...`, `syntopic calibrate thermal A B --out rig.toml`
"""


VALIDITY_HELP = """Detect displaced sensors and misreading probes, with time and amount.

Combines the stitching of all exposures (`mosaic.json` of Level-2). The detection limit is a few
hundredths of a pixel, lower than that of a single exposure. Writes `export/displacements.json` into
the mission.

Example: `syntopic calibrate validity MISSION`
"""


@app.callback()
def calibrate() -> None:
    """Calibrations from the laboratory, and from flown missions."""


app.command(name="radiometric", help=calibrate_radiometric.HELP)(calibrate_radiometric.radiometric)
app.command(name="head", help=calibrate_head.HELP)(calibrate_head.head)
app.command(name="lab", help=calibrate_lab.HELP)(calibrate_lab.lab)
app.command(name="board", help=calibrate_board.HELP)(calibrate_board.board)
app.command(name="flight", help=calibrate_flight.HELP)(calibrate_flight.flight)
app.command(name="boresight", help=calibrate_boresight.HELP)(calibrate_boresight.boresight)
app.command(name="rig", help=calibrate_rig.HELP)(calibrate_rig.rig)
app.command(name="platform", help=calibrate_platform.HELP)(calibrate_platform.platform)


@app.command(name="thermal", help=THERMAL_HELP)
def thermal(
    missions: Annotated[list[Path], typer.Argument(help="Mission folders with Level-2.")],
    out: Annotated[
        Path | None, typer.Option(help="New rig file (default: dated, next to the mission).")
    ] = None,
    as_json: AsJson = False,
) -> None:
    from daemon.postflight.calibration.calibration_report import content_digest
    from daemon.postflight.calibration.rig_writer import rig_toml
    from daemon.postflight.calibration.thermal_calibration import read_thermal_records, write_rig
    from processing.calibration.thermal_learning import observability, solve_drift
    from processing.calibration.thermal_proposal import proposed_rig

    records = read_thermal_records(missions)
    rig = records.rig
    found = solve_drift(rig, records.state)
    today = f"{datetime.now(UTC):%Y-%m-%d}"
    name = f"{rig.calibration_id}-thermal-{today}"
    proposal, changes = proposed_rig(rig, found, calibration_id=name, date=today)
    written: Path | None = None
    if changes:
        remark = (
            f"{rig.name}, proposed by `syntopic calibrate thermal` on {today} from "
            f"{records.exposures} exposures,\nin place of calibration {rig.calibration_id}. "
            "It counts only where it is configured.\nPer-kelvin values and places of sensors "
            "relative to each other are learned; what is common to\nthe sensors of a cone is as "
            "it was."
        )
        digest = content_digest({"rig.toml": rig_toml(proposal, remark=remark)})
        default_path = missions[0].resolve().parent / f"{rig.name}-thermal-{today}-{digest}.toml"
        written = out or default_path
        # The same content has the same name: it is there already.
        if out is not None or not default_path.exists():
            write_rig(replace(proposal, calibration_id=f"{name}-{digest}"), written, remark=remark)
    seen = observability(rig)
    if as_json:
        typer.echo(json.dumps(_json(records, found, changes, seen, written)))
    else:
        _print(records, found, changes, seen, written)
    raise typer.Exit(status_of(is_good=bool(changes)))


@app.command(name="validity", help=VALIDITY_HELP)
def validity(
    mission: Annotated[Path, typer.Argument(help="A mission folder with Level-2.")],
    as_json: AsJson = False,
) -> None:
    from daemon.mission.layout import Mission
    from daemon.postflight.displacements import (
        DISPLACEMENTS_FILE,
        without_steps,
        write_displacements,
    )

    held = Mission.open(mission)
    folder = held.path
    with held.held():
        displacements = write_displacements(folder)
    path = folder / DISPLACEMENTS_FILE
    if as_json:
        typer.echo(json.dumps({**displacements, "written": str(path)}))
    else:
        console = Console()
        counted = ", ".join(f"{n} of cone {cone}" for cone, n in displacements["exposures"].items())
        if not any(displacements["exposures"].values()):
            counted = (
                "none; has the mission been processed?" if displacements["exposures"] else "none"
            )
        console.print(f"Exposures with a record: {counted}")
        for sentence in displacements["unreadable"] + (
            displacements["sentences"] or [without_steps(displacements["exposures"])]
        ):
            console.print(sentence)
        console.print(f"Written: {path}", soft_wrap=True)
    raise typer.Exit(status_of(is_good=not displacements["steps"]))


def _json(
    records: ThermalRecords,
    found: LearnedDrift,
    changes: tuple[ProposedChange, ...],
    seen: tuple[Observability, ...],
    written: Path | None,
) -> dict[str, Any]:
    return {
        "rig": records.rig.name,
        "calibration_id": records.rig.calibration_id,
        "exposures": records.exposures,
        "skipped": list(records.skipped),
        "dc_spread_k": dict(found.spread_k),
        "not_learned": dict(found.reasons),
        "variance_factors": dict(found.variance_factors),
        "changes": [
            {
                "where": c.where,
                "what": c.what,
                "old": c.old,
                "new": c.new,
                "sigma": c.sigma,
                "significance": c.significance,
                "effect_px": c.effect_px,
            }
            for c in changes
        ],
        "observability": [{"what": o.what, "observable": o.observable, "why": o.why} for o in seen],
        "written": None if written is None else str(written),
    }


def _print(
    records: ThermalRecords,
    found: LearnedDrift,
    changes: tuple[ProposedChange, ...],
    seen: tuple[Observability, ...],
    written: Path | None,
) -> None:
    console = Console()
    console.print(
        f"{records.rig.name}, calibration {records.rig.calibration_id}: "
        f"{records.exposures} exposures"
    )
    for sentence in records.skipped[:10]:
        console.print(f"  passed over: {sentence}", markup=False, highlight=False)
    if len(records.skipped) > 10:
        console.print(f"  and {len(records.skipped) - 10} more")
    for key, reason in found.reasons.items():
        console.print(f"  cone {key}: nothing learned, {reason}", markup=False, highlight=False)
    if changes:
        table = light_table("Old and new", ("", "value"), ("old", "new", "sigma", "t", "px"))
        for c in changes:
            table.add_row(
                c.where,
                c.what,
                f"{c.old:.7g}",
                f"{c.new:.7g}",
                f"{c.sigma:.2g}",
                f"{c.significance:.1f}",
                f"{c.effect_px:.3f}",
            )
        console.print(table)
        console.print(
            "px: what the change moves the sensor's farthest pixel by, at the largest dC flown"
        )
    for o in seen:
        if not o.observable:
            console.print(f"Not observable: {o.what}: {o.why}", markup=False, highlight=False)
    if written is None:
        console.print("Nothing learned, nothing written", style="yellow")
    else:
        console.print(f"Proposed calibration: {written}", soft_wrap=True)
