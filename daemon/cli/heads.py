"""`syntopic process` for rigs whose heads look apart: an image of every head, and the verdict."""

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
    interpolation: str,
    only: Sequence[int],
    as_json: bool,
) -> None:
    """Process the exposures and print what came of them."""
    from daemon.disk import store
    from daemon.disk.radiometry_folder import RadiometryFolder
    from daemon.products.heads import process_heads
    from processing.perspective import HeadPipeline
    from processing.radiometry.calibration import CalibrationError

    reports: list[dict[str, Any]] = []
    calibrations = None if radiometry is None else RadiometryFolder(radiometry, rig)
    try:
        pipeline = HeadPipeline(rig, calibrations, interpolation=interpolation)
        with Progress(console=Console(stderr=True), transient=True) as progress:
            numbers = only or folder.numbers()
            task = progress.add_task("processing", total=len(numbers))
            for number in numbers:
                started = time.monotonic()
                frames, exposure = store.load_level0(folder.level0(number), rig)
                report, product = process_heads(pipeline, folder, plan, exposure, frames)
                report["duration_s"] = round(time.monotonic() - started, 3)
                report["heads"] = list(product.heads)
                reports.append(report)
                progress.advance(task)
    except (CalibrationError, ValueError) as error:
        raise ConfigurationError([str(error)]) from error
    if as_json:
        typer.echo(json.dumps({"mission": str(folder.path), "exposures": reports}))
        return
    table = light_table(f"Level-2 of {folder.id}", ("exposure", "heads"), ("verdict", "s"))
    for report in reports:
        table.add_row(
            str(report["exposure"]),
            ", ".join(report["heads"]),
            report["verdict"],
            f"{report['duration_s']:.1f}",
        )
    Console().print(table)
    Console().print(f"Products are in [bold]{folder.level2_root}[/]")
