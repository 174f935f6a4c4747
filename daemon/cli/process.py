"""`syntopic process`: Level-0 to Level-2 again, after landing or from exposures of others."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import ValidationError
from rich.progress import Progress

from daemon.cli.exit_status import exit_if_failed
from daemon.cli.level2_tables import print_reports
from daemon.cli.options import AsJson
from daemon.configuration.model import ConfigurationError, PlanSection, ProcessingSection
from daemon.configuration.problems import nested_value
from daemon.mission.layout import Mission
from daemon.orientation.exterior_orientation import mount_of
from daemon.terminal.console import Console
from processing.image.kernels import DEFAULT_INTERPOLATION, INTERPOLATIONS
from processing.rig.problem_sentences import findings_of, sentences

HELP = """Process the exposures of a mission folder again, Level-0 to Level-2.

The folder is from a flight, imported, or written by hand after docs/reference/formats.md. Level-0
is not changed; products are replaced. A rig without a virtual image gives one raster per band, or,
if its heads have diverging axes, one perspective image per head.

Every frame is compared with the hash in its record, and record, file and rig with each other
(docs/reference/formats.md). An exposure that cannot be processed is listed at the end with its
cause; the others are done. Only one command at a time writes into a mission.

Examples: `syntopic process MISSION`, `syntopic process MISSION --only 3 --method fixed`
"""


def process(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    only: Annotated[
        list[int] | None, typer.Option(help="Number of an exposure; repeatable.")
    ] = None,
    method: Annotated[str, typer.Option(help="Method: free or fixed.")] = "free",
    interpolation: Annotated[
        str, typer.Option(help=f"Interpolation kernel: {', '.join(INTERPOLATIONS)}.")
    ] = DEFAULT_INTERPOLATION,
    rig_file: Annotated[
        Path | None,
        typer.Option("--rig", help="Rig file (default: the one flown)."),
    ] = None,
    radiometry: Annotated[
        Path | None, typer.Option(help="Folder of radiometric calibrations.")
    ] = None,
    elevation: Annotated[
        Path | None, typer.Option(help="Height model (default: that of the flight).")
    ] = None,
    baselines: Annotated[
        bool, typer.Option(help="Comparison with the fixed method, with and without TDM.")
    ] = False,
    threads: Annotated[int, typer.Option(help="Number of threads.")] = 2,
    as_json: AsJson = False,
) -> None:
    os.environ.setdefault("NUMBA_NUM_THREADS", str(threads))
    from daemon.mission.canonical_json import sha256_hex
    from daemon.mission.exposure_batch import for_each_exposure
    from daemon.mission.store import store
    from daemon.mission.store.level2 import recover_level2
    from daemon.orientation.ground_model import ground_of
    from daemon.planning.overlaps import overlaps_of
    from daemon.products.exposure_products import FlightGeometry, process_exposure
    from daemon.products.processor import processor_for
    from processing.radiometry.calibration import CalibrationError
    from processing.rig import load_rig

    if method not in ("free", "fixed") or interpolation not in INTERPOLATIONS:
        raise ConfigurationError(
            [f"--method is free or fixed, --interpolation one of {', '.join(INTERPOLATIONS)}"]
        )
    folder = Mission.open(mission)
    rig = load_rig(rig_file or folder.rig_path)
    calibration_sha256 = "" if rig_file else sha256_hex(folder.rig_path.read_bytes())
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
    geometry = FlightGeometry(mount, plan, ground_of(rig, mount, plan))
    with folder.held(), Progress(console=Console(stderr=True), transient=True) as progress:
        recover_level2(folder)
        task = progress.add_task("compiling kernels", total=None)
        try:
            processor = processor_for(rig, folder, processing, radiometry)
        except ValueError as error:
            raise ConfigurationError([str(error)]) from error
        try:
            processor.warm_up()
        except CalibrationError as error:
            raise ConfigurationError([str(error)]) from error

        def process_one(number: int) -> dict[str, Any]:
            started = time.monotonic()
            frames, exposure = store.load_level0(
                folder.level0(number), rig, calibration_sha256=calibration_sha256
            )
            report = process_exposure(
                processor, folder, geometry, exposure, frames, overlaps.of(number)
            )
            return {**report, "duration_s": round(time.monotonic() - started, 3)}

        numbers = only or folder.numbers()
        progress.update(task, description="processing", total=len(numbers))
        done = for_each_exposure(
            numbers, process_one, lambda count: progress.update(task, completed=count)
        )
    reports = list(done.results.values())
    if as_json:
        failures = [failure.as_json() for failure in done.failures]
        content = {"mission": str(folder.path), "exposures": reports, "failures": failures}
        typer.echo(json.dumps(content))
    else:
        console = Console()
        if reports:
            print_reports(console, f"Level-2 of {folder.id}", reports)
        console.print(f"Products are in {folder.level2_root}")
    exit_if_failed(done.failures)


def flown_thresholds(folder: Mission) -> dict[str, float]:
    """Thresholds of the flown configuration, for the same verdicts as in flight."""
    given = nested_value(folder.flown_configuration(), "processing", "thresholds") or {}
    try:
        return ProcessingSection.model_validate({"thresholds": given}).thresholds
    except ValidationError as error:
        findings = [(("processing", *where), text) for where, text in findings_of(error)]
        raise ConfigurationError(sentences(findings, str(folder.service_path))) from error


def as_flown(
    folder: Mission, radiometry: Path | None, elevation: Path | None = None
) -> tuple[PlanSection, Path | None]:
    """Plan and radiometry of the configuration that was flown, where the mission has one.

    Only these two are read: the devices of the flight need not be present. They are looked
    for only where a mission may name them (`Mission.file_named`); the options name any place.

    Raises:
        ConfigurationError: the configuration cannot be used, or what it names is not there.
    """
    _, plan = mount_of(folder)
    if elevation is not None:
        plan = plan.model_copy(update={"elevation": elevation})
    elif plan.elevation is not None and not plan.elevation.is_file():
        raise _missing_file(folder, "plan.elevation", plan.elevation.name, "--elevation FILE")
    configured = nested_value(folder.flown_configuration(), "mission", "radiometry")
    if radiometry is None and configured is not None:
        radiometry = folder.file_named(str(configured))
        if not radiometry.is_dir():
            raise _missing_file(
                folder, "mission.radiometry", radiometry.name, "--radiometry FOLDER"
            )
    return plan, radiometry


def _missing_file(folder: Mission, key: str, name: str, option: str) -> ConfigurationError:
    return ConfigurationError(
        [
            f"{folder.service_path}: {key} names {name[:200]!r}, which is neither in the mission "
            f"folder nor, by an absolute path without links, on a local disk; give {option}"
        ]
    )
