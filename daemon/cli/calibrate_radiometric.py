"""`syntopic calibrate radiometric`: dark and flat series to the maps that correct raw frames."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from daemon.cli.options import AsJson, NewFolder, Series
from daemon.terminal.console import Console

HELP = """Calibrate heads radiometrically from dark and flat series.

Estimates bias, dark signal over temperature and exposure time, gain, its change with the aperture,
defect pixels, columns and clusters; photon transfer, PRNU, DSNU, dynamic range and linearity
after EMVA 1288. The new folder holds one folder of maps per aperture, as `radiometry` of
the configuration takes it, a report and the comparison with a previous calibration.

Examples: `syntopic calibrate radiometric SERIES`, `syntopic calibrate radiometric SERIES --aperture
6.3 --previous radiometric-2026-05-02 --out radiometric-2026-11-21`

A series to try: `python -m sim_hw.laboratory.sphere ultracam-x-mini --sensor SU00 --out sphere`
"""


def radiometric(
    series: Series,
    out: NewFolder = None,
    previous: Annotated[
        Path | None, typer.Option(help="Radiometric calibration to compare with.")
    ] = None,
    aperture: Annotated[
        list[float] | None,
        typer.Option(help="Further f-number for maps from the model; repeatable."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    from daemon.cli.calibration_output import publish_calibration
    from daemon.postflight.calibration.calibration_report import calibration_folder, read_previous
    from daemon.postflight.calibration.laboratory.laboratory_series import read_series
    from daemon.postflight.calibration.laboratory.radiometric import (
        RadiometricSeries,
        calibrate_sensor,
        checks_of,
        common_level,
        refuse_mixed_sets,
        sets_of,
    )
    from daemon.postflight.calibration.laboratory.radiometric_maps import files_of
    from daemon.postflight.calibration.laboratory.radiometric_report import radiometric_report

    given = read_series(series, RadiometricSeries)
    shots = given.file.images
    refuse_mixed_sets(shots)
    today = f"{datetime.now(UTC):%Y-%m-%d}"
    place = calibration_folder(out, f"{given.rig.name}-radiometric", today, next_to=series)
    before = (previous, read_previous(previous, kind="radiometric")) if previous else None
    names = [s.name for s in given.rig.sensors if any(x.sensor == s.name for x in shots)]
    heads = []
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("reading", total=len(sets_of(shots)))

        def show_progress(what: str) -> None:
            progress.update(task, description=what, advance=1)

        for name in names:
            own = [s for s in shots if s.sensor == name]
            head = calibrate_sensor(
                given.rig.sensor(name),
                own,
                temperature_sigma_c=given.file.temperature_sigma_c,
                monitor_sigma=given.file.monitor_sigma,
                progress=show_progress,
            )
            heads.append(replace(head, checks=checks_of(head, own)))
    measured = {s.f_number for s in shots if s.light == "flat" and s.use == "fit"}
    base = [h.aperture.base_f_number for h in heads[:1]]
    apertures = base + sorted((measured | set(aperture or [])) - set(base))
    pan = {s.name for c in given.rig.pan_cones for s in c.sensors}
    report = radiometric_report(
        given,
        heads,
        calibration_id=place.name,
        date=today,
        apertures=apertures,
        previous=before,
    )
    files = files_of(heads, common_level(heads, pan), apertures)
    publish_calibration(report, place, files=files, as_json=as_json)
