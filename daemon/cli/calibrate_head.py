"""`syntopic calibrate head`: collimator series to the ten parameters of a head."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from daemon.cli.options import AsJson, NewFolder
from daemon.terminal.console import Console

HELP = """Calibrate the geometry of single heads from collimator series.

Targets seen under known angles are found by least-squares matching of the images with one another;
the Australis ten parameters are adjusted with three unknowns for the orientation of each series,
and what they leave becomes a residual grid. The new folder holds a dated rig file, the grids, a
report and the comparison with a previous calibration.

Examples: `syntopic calibrate head SERIES`, `syntopic calibrate head SERIES --previous
head-2026-05-02 --k3`

A series to try: `python -m sim_hw.laboratory.collimator dmc --sensor P1 --out collimator`
"""


def head(
    series: Annotated[Path, typer.Argument(help="Folder with series.json, rig.toml and images.")],
    out: NewFolder = None,
    previous: Annotated[
        Path | None, typer.Option(help="Calibration of heads to compare with.")
    ] = None,
    k3: Annotated[bool, typer.Option("--k3", help="Estimation of K3.")] = False,
    as_json: AsJson = False,
) -> None:
    from daemon.cli.calibration_output import publish_calibration
    from daemon.postflight.calibration.calibration_report import calibration_folder, read_previous
    from daemon.postflight.calibration.laboratory.head_geometry import (
        FREE,
        CollimatorSeries,
        calibrate_head,
    )
    from daemon.postflight.calibration.laboratory.head_report import calibrated_rig, head_report
    from daemon.postflight.calibration.laboratory.laboratory_series import read_series
    from daemon.postflight.calibration.rig_writer import rig_toml
    from processing.geometry.residual_grid import grid_bytes

    given = read_series(series, CollimatorSeries)
    today = f"{datetime.now(UTC):%Y-%m-%d}"
    place = calibration_folder(out, f"{given.rig.name}-head", today, next_to=series)
    before = (previous, read_previous(previous, kind="head")) if previous else None
    heads = []
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("reading", total=None)

        def show_progress(what: str, done: int, total: int) -> None:
            progress.update(task, description=what, completed=done, total=total)

        for sensor in given.rig.sensors:
            own = [t for t in given.file.images if t.sensor == sensor.name]
            if own:
                found = calibrate_head(
                    given.rig.cone_of(sensor.name),
                    sensor,
                    own,
                    target_radius_rad=given.file.target_radius_rad,
                    angle_sigma_rad=given.file.angle_sigma_rad,
                    free=(*FREE, "k3") if k3 else FREE,
                    progress=show_progress,
                )
                heads.append(found)
    report = head_report(given, heads, calibration_id=place.name, date=today, previous=before)
    rig = calibrated_rig(given.rig, heads, calibration_id=place.name, date=today)
    remark = (
        f"{rig.name}, lenses of {', '.join(h.cone.name for h in heads)} by `syntopic calibrate "
        f"head` on {today},\nin place of calibration {given.rig.calibration_id}. It counts only "
        "where it is configured."
    )
    publish_calibration(
        report,
        place,
        files={f"residual-grid/{h.sensor.name}.npz": grid_bytes(h.grid) for h in heads},
        rig_file=lambda made: rig_toml(replace(rig, calibration_id=made), remark=remark),
        as_json=as_json,
    )
