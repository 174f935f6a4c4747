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

HELP = """Calibrate a complete rig in a 3D calibration field.

Every CCD's shift, rotation, scale and perspective skew, every cone's radial and decentring
distortion and its rotation against the master cone, by one bundle adjustment. Principal distance
and point of the cones are fixed, and the first CCD of each cone is not rotated. The new folder
holds a dated rig file that holds at the recorded temperatures, the covariance, a report and the
comparison with a previous calibration.

Examples: `syntopic calibrate lab SERIES`, `syntopic calibrate lab SERIES --previous lab-2026-05-02`

A series to try: `python -m sim_hw.laboratory.calibration_field ultracam-l-mini --out field`
"""


def lab(
    series: Series,
    out: NewFolder = None,
    previous: Annotated[
        Path | None, typer.Option(help="Laboratory calibration to compare with.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    from daemon.cli.calibration_output import publish_calibration
    from daemon.postflight.calibration.calibration_report import calibration_folder, read_previous
    from daemon.postflight.calibration.laboratory.calibration_field import calibrate_rig
    from daemon.postflight.calibration.laboratory.field_measurement import (
        FieldSeries,
        field_exposures,
        field_of,
        measure_targets,
    )
    from daemon.postflight.calibration.laboratory.field_report import (
        covariance_bytes,
        covariance_of,
        estimated_parameters,
        field_report,
    )
    from daemon.postflight.calibration.laboratory.laboratory_series import read_series
    from daemon.postflight.calibration.rig_writer import rig_toml

    given = read_series(series, FieldSeries)
    exposures, field = field_exposures(given.file), field_of(given.file)
    today = f"{datetime.now(UTC):%Y-%m-%d}"
    place = calibration_folder(out, f"{given.rig.name}-lab", today, next_to=series)
    before = (previous, read_previous(previous, kind="lab")) if previous else None
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("measuring", total=None)

        def show_progress(what: str, done: int, total: int) -> None:
            progress.update(task, description=what, completed=done, total=total or None)

        observations = measure_targets(given.rig, exposures, field, progress=show_progress)
        found = calibrate_rig(
            given.rig,
            exposures,
            field,
            observations,
            offset_sigma_mm=given.file.offset_sigma_mm,
            skew_sigma_per_mm=given.file.skew_sigma_per_mm,
            progress=show_progress,
        )
    report = field_report(given, found, calibration_id=place.name, date=today, previous=before)
    # Cones without frames keep nominal lenses: a rig that began without calibration stays so.
    is_complete = all(camera.terms for camera in found.adjustment.network.cameras)
    dated = today if given.rig.is_calibrated or is_complete else ""
    rig = replace(found.rig, calibration_date=dated)
    remark = (
        f"{rig.name}, by `syntopic calibrate lab` on {today}, in place of calibration "
        f"{given.rig.calibration_id}.\nIt counts only where it is configured. Standard deviations "
        "and correlations: calibration.json and covariance.npz\nbeside it."
    )
    rows = estimated_parameters(found)
    publish_calibration(
        report,
        place,
        files={"covariance.npz": covariance_bytes(rows, covariance_of(found, rows))},
        rig_file=lambda made: rig_toml(replace(rig, calibration_id=made), remark=remark),
        as_json=as_json,
    )
