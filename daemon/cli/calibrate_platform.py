"""`syntopic calibrate platform`: the mountings of all heads from flown or laboratory exposures."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from daemon.cli.calibration_output import publish_calibration
from daemon.cli.options import AsJson, NewFolder

HELP = """Estimate the mounting of every head from many exposures.

Uses the stitching of processed exposures (`mosaic.json` of Level-2): a flight over textured ground,
or laboratory images in a mission folder. For converging heads, three angles of each are estimated
from tie points. For a rig with a master cone, the rotation of every other cone relative to it is
estimated; cones that fire in sequence require twelve exposures. Writes a dated folder with
rig.toml, report.html and calibration.json. The new rig file takes effect only after it is
configured.

Examples: `syntopic calibrate platform MISSION`,
`syntopic calibrate platform A B --previous dmc-platform-2026-05-02 --out dmc-platform-2026-11-21`
"""


def platform(
    missions: Annotated[list[Path], typer.Argument(help="Mission folders with Level-2.")],
    out: NewFolder = None,
    previous: Annotated[
        Path | None,
        typer.Option(help="Platform calibration to compare with (default: the rig flown)."),
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
