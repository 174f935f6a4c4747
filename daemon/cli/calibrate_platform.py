"""`syntopic calibrate platform`: the mountings of all heads from flown or laboratory exposures."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from daemon.cli.calibration_output import publish_calibration
from daemon.cli.options import AsJson, NewFolder

HELP = """Platform calibration: how every head is mounted, from many exposures.

Takes the stitching of exposures that were processed before (`mosaic.json` of Level-2): a flight
over well textured ground, or laboratory images put into a mission folder. Converging heads: three
angles of each, by tie points of the overlaps. A rig with a master cone: the turn of every other
cone against it; where cones fire one after the other, from twelve exposures on. Writes a dated
folder with rig.toml, report.html and calibration.json; nothing is overwritten, and the new rig file
counts only where it is configured.

Examples: `syntopic calibrate platform MISSION`,
`syntopic calibrate platform A B --previous dmc-platform-2026-05-02 --out dmc-platform-2026-11-21`
"""


def platform(
    missions: Annotated[list[Path], typer.Argument(help="Mission folders with Level-2.")],
    out: NewFolder = None,
    previous: Annotated[
        Path | None,
        typer.Option(help="A platform calibration to compare with; else the rig flown with."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    from daemon.postflight.calibration.calibration_report import calibration_folder, read_previous
    from daemon.postflight.calibration.platform_calibration import (
        KIND,
        read_missions,
        report_of,
        rig_file,
    )
    from processing.calibration.platform import calibrate_platform, calibrated_rig

    before = None if previous is None else read_previous(previous, kind=KIND)
    flown = read_missions(missions)
    today = f"{datetime.now(UTC):%Y-%m-%d}"
    place = calibration_folder(out, f"{flown.rig.name}-platform", today, next_to=missions[0])
    found = calibrate_platform(flown.rig, flown.records)
    made = calibrated_rig(flown.rig, found, calibration_id=place.name, date=today)
    report = report_of(flown, found, calibration_id=place.name, date=today, previous=before)
    publish_calibration(
        report,
        place,
        rig_file=lambda name: rig_file(replace(made, calibration_id=name), flown, date=today),
        as_json=as_json,
    )
