"""`syntopic process`: Level-0 to Level-2 again, after landing or from exposures of others."""

from __future__ import annotations

import json
import os
import time
import tomllib
from pathlib import Path
from typing import Annotated

import typer
from pydantic import ValidationError
from rich.console import Console
from rich.progress import Progress

from daemon.cli.level2_tables import print_reports
from daemon.configuration import ConfigurationError, PlanSection, ProcessingSection
from daemon.disk.mission import Mission

HELP = """Process the exposures of a mission folder again, Level-0 to Level-2.

The folder may be a flight's, imported, or written by hand as docs/formats.md tells. Level-0 stays
as it is; products are replaced. A rig without a virtual image gives one raster per
band, or, where its heads look apart, an image of each head in strict perspective.

Examples: `syntopic process MISSION`, `syntopic process MISSION --only 3 --method fixed`
"""


def process(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    only: Annotated[
        list[int] | None, typer.Option(help="An exposure's number; repeatable.")
    ] = None,
    method: Annotated[str, typer.Option(help="free or fixed.")] = "free",
    interpolation: Annotated[str, typer.Option(help="bilinear, cubic or lanczos.")] = "cubic",
    radiometry: Annotated[
        Path | None, typer.Option(help="Folder of radiometric calibrations.")
    ] = None,
    elevation: Annotated[
        Path | None, typer.Option(help="Height model, where that of the flight lies elsewhere.")
    ] = None,
    baselines: Annotated[
        bool, typer.Option(help="Also solve the fixed method, with and without TDM.")
    ] = False,
    threads: Annotated[int, typer.Option(help="Cores to use.")] = 2,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    os.environ.setdefault("NUMBA_NUM_THREADS", str(threads))
    from daemon.disk import store
    from daemon.orientation.exterior import mount_of
    from daemon.orientation.ground import ground_of
    from daemon.products.processor import processor_for
    from daemon.service.worker import overlaps_of, process_exposure
    from processing.radiometry.calibration import CalibrationError
    from processing.rig import load_rig

    if method not in ("free", "fixed") or interpolation not in ("bilinear", "cubic", "lanczos"):
        raise ConfigurationError(
            ["--method is free or fixed, --interpolation is bilinear, cubic or lanczos"]
        )
    folder = Mission.open(mission)
    rig = load_rig(folder.rig_path)
    plan, radiometry = as_flown(folder, radiometry, elevation)
    processing = ProcessingSection.model_validate(
        {
            "method": method,
            "interpolation": interpolation,
            "baselines": baselines,
            "threads": threads,
            "thresholds": flown_thresholds(folder),
        }
    )
    mount, _ = mount_of(folder)
    overlaps = overlaps_of(folder, rig)
    ground = ground_of(rig, mount, plan)
    reports = []
    try:
        processor = processor_for(rig, folder, processing, radiometry)
        with Progress(console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task("compiling kernels", total=None)
            processor.warm_up()
            numbers = only or folder.numbers()
            progress.update(task, description="processing", total=len(numbers))
            for number in numbers:
                started = time.monotonic()
                frames, exposure = store.load_level0(folder.level0(number), rig)
                report, _ = process_exposure(
                    processor,
                    folder,
                    mount,
                    plan,
                    exposure,
                    frames,
                    surroundings=overlaps.of(number),
                    ground=ground,
                )
                report["duration_s"] = round(time.monotonic() - started, 3)
                reports.append(report)
                progress.advance(task)
    except CalibrationError as error:
        raise ConfigurationError([str(error)]) from error
    if as_json:
        typer.echo(json.dumps({"mission": str(folder.path), "exposures": reports}))
        return
    console = Console()
    print_reports(console, f"Level-2 of {folder.id}", reports)
    console.print(f"Products are in [bold]{folder.level2_root}[/]")


def flown_thresholds(folder: Mission) -> dict[str, float]:
    """Thresholds of the configuration that was flown, so that it is judged as in the air."""
    if not folder.service_path.exists():
        return {}
    flown = tomllib.loads(folder.service_path.read_text(encoding="utf-8"))
    given = flown.get("processing", {}).get("thresholds", {})
    try:
        return ProcessingSection.model_validate({"thresholds": given}).thresholds
    except ValidationError as error:
        said = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise ConfigurationError(
            [f"{folder.service_path}: processing.thresholds: {said}"]
        ) from error


def as_flown(
    folder: Mission, radiometry: Path | None, elevation: Path | None = None
) -> tuple[PlanSection, Path | None]:
    """Plan and radiometry of the configuration that was flown, where the mission has one.

    Only these two are read: devices that were there in the air need not be here.
    """
    if not folder.service_path.exists():
        return PlanSection.model_validate({}), radiometry
    flown = tomllib.loads(folder.service_path.read_text(encoding="utf-8"))
    plan = PlanSection.model_validate(flown.get("plan", {}))
    if elevation is not None:
        plan = plan.model_copy(update={"elevation": elevation})
    if plan.elevation is not None and not plan.elevation.is_file():
        raise ConfigurationError(
            [
                f"{folder.service_path}: plan.elevation is {str(plan.elevation)!r}, and that file "
                f"is not here; give --elevation FILE"
            ]
        )
    told = flown.get("mission", {}).get("radiometry")
    if radiometry is None and told is not None:
        radiometry = Path(told)
        if not radiometry.is_dir():
            raise ConfigurationError(
                [
                    f"{folder.service_path}: mission.radiometry is {told!r}, and that folder is "
                    f"not here; give --radiometry FOLDER"
                ]
            )
    return plan, radiometry
