"""`syntopic process` for rigs without a virtual image: the bands, their residuals, the verdict."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.progress import Progress

from daemon.configuration import ConfigurationError, PlanSection
from daemon.disk.mission import Mission
from daemon.tables import light_table
from processing.rig import Rig


def process(
    folder: Mission,
    rig: Rig,
    plan: PlanSection,
    *,
    radiometry: Path | None,
    only: Sequence[int],
    as_json: bool,
) -> None:
    """Process the exposures and print what came of them."""
    from daemon.disk import store
    from daemon.products.bands import make_band_pipeline, process_bands
    from processing.radiometry.calibration import CalibrationError

    reports: list[dict[str, Any]] = []
    try:
        pipeline, radiance = make_band_pipeline(rig, folder, radiometry)
        with Progress(console=Console(stderr=True), transient=True) as progress:
            numbers = only or folder.numbers()
            task = progress.add_task("processing", total=len(numbers))
            for number in numbers:
                started = time.monotonic()
                frames, exposure = store.load_level0(folder.level0(number), rig)
                report, _ = process_bands(pipeline, radiance, folder, plan, exposure, frames)
                report["duration_s"] = round(time.monotonic() - started, 3)
                reports.append(report)
                progress.advance(task)
    except (CalibrationError, ValueError) as error:
        raise ConfigurationError([str(error)]) from error
    if as_json:
        typer.echo(json.dumps({"mission": str(folder.path), "exposures": reports}))
        return
    console = Console()
    table = light_table(
        f"Level-2 of {folder.id}",
        (),
        ("exposure", "band", "tie points", "shift px", "rms px", "rms x", "rms y", "verdict"),
    )
    for report in reports:
        first = True
        for band in report["bands"]:
            shift_px = report["figures"].get(f"{band['band']}_shift_px")
            table.add_row(
                str(report["exposure"]) if first else "",
                band["band"],
                f"{band['points']} of {band['sought']}",
                _px(shift_px, 1),
                _px(band["rms_px"], 3),
                _px(band["rms_x_px"], 3),
                _px(band["rms_y_px"], 3),
                report["verdict"] if first else "",
            )
            first = False
    console.print(table)
    for report in reports:
        for finding in report["findings"]:
            console.print(f"Exposure {report['exposure']}: {finding['sentence']}", markup=False)
    console.print(f"Products are in [bold]{folder.level2_root}[/]")


def _px(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
