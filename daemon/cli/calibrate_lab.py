"""`syntopic calibrate lab`: frames of a 3D test field to a dated rig file."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from daemon.cli.options import AsJson, NewFolder, Series
from daemon.terminal.console import Console

HELP = """Calibration of a whole rig in a 3D test field.

Every CCD's shift, rotation, scale and perspective skew, every cone's radial and decentring
distortion and its rotation against the master cone, by one bundle adjustment. Principal distance
and point of the cones are kept, and the first CCD of each cone is not turned. The new folder holds
a dated rig file that holds at the recorded temperatures, the covariance, a report and the
comparison with a previous calibration.

Examples: `syntopic calibrate lab SERIES`, `syntopic calibrate lab SERIES --previous lab-2026-05-02`

A series to try: `python -m sim_hw.laboratory.test_field ultracam-l-mini --out field`
"""


def lab(
    series: Series,
    out: NewFolder = None,
    previous: Annotated[
        Path | None, typer.Option(help="A laboratory calibration to compare with.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    from daemon.cli.calibration_outcome import hand_over
    from daemon.postflight.calibration.laboratory.field import calibrate_rig
    from daemon.postflight.calibration.laboratory.field_measuring import (
        exposures_of,
        field_of,
        measured,
    )
    from daemon.postflight.calibration.laboratory.field_report import (
        covariance_bytes,
        covariance_of,
        estimated,
        field_report,
    )
    from daemon.postflight.calibration.laboratory.series import read_series
    from daemon.postflight.calibration.report import place_of, read_previous
    from daemon.postflight.calibration.rig_text import rig_toml

    given = read_series(series, kind="lab")
    exposures, field = exposures_of(given), field_of(given)
    offset_sigma = given.table.number("offset_sigma_mm", 0.2, positive=True)
    skew_sigma = given.table.number("skew_sigma_per_mm", 5e-6, positive=True)
    given.checked()
    today = f"{datetime.now(UTC):%Y-%m-%d}"
    place = place_of(out, f"{given.rig.name}-lab", today, beside=series)
    before = (previous, read_previous(previous, kind="lab")) if previous else None
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("measuring", total=None)

        def tell(what: str, done: int, total: int) -> None:
            progress.update(task, description=what, completed=done, total=total or None)

        looks = measured(given.rig, exposures, field, progress=tell)
        found = calibrate_rig(
            given.rig,
            exposures,
            field,
            looks,
            offset_sigma_mm=offset_sigma,
            skew_sigma_per_mm=skew_sigma,
            progress=tell,
        )
    report = field_report(given, found, calibration_id=place.name, date=today, previous=before)
    rig = replace(found.rig, calibration_date=today)
    remark = (
        f"{rig.name}, by `syntopic calibrate lab` on {today}, in place of calibration "
        f"{given.rig.calibration_id}.\nIt counts only where it is configured. Standard deviations "
        "and correlations: calibration.json and covariance.npz\nbeside it."
    )
    rows = estimated(found)
    hand_over(
        report,
        place,
        files={"covariance.npz": covariance_bytes(rows, covariance_of(found, rows))},
        rig_file=lambda made: rig_toml(replace(rig, calibration_id=made), remark=remark),
        as_json=as_json,
    )
