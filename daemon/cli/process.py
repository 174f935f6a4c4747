"""`syntopic process`: Level-0 to Level-2 again, after landing or from exposures of others."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from pydantic import ValidationError

from daemon.cli.batch_options import (
    DryRun,
    ExecutorOptions,
    Placement,
    shown_progress,
    takes_executor,
)
from daemon.cli.exit_status import exit_if_failed
from daemon.cli.level2_tables import print_reports
from daemon.cli.options import AsJson
from daemon.cli.transfer import folder_of
from daemon.configuration.model import ConfigurationError, PlanSection, ProcessingSection
from daemon.configuration.problems import nested_value
from daemon.mission.layout import Mission
from daemon.orientation.exterior_orientation import mount_of
from daemon.terminal.console import Console
from drivers.base.extras import require
from processing.image.kernels import DEFAULT_INTERPOLATION, INTERPOLATIONS
from processing.rig.problem_sentences import findings_of, sentences

if TYPE_CHECKING:
    from daemon.postflight.batch.capacity import ProcessAllocation
    from daemon.postflight.batch.level2_sources import AnyLevel2Work, Level2Source
    from daemon.postflight.batch.level2_work import Level2Survey, Level2Work

HELP = """Process the exposures of a mission folder again, Level-0 to Level-2.

The folder is from a flight, imported, or written by hand after docs/reference/formats.md. Level-0
is not changed; products are replaced. A rig without a virtual image gives one raster per band, or,
if its heads have diverging axes, one perspective image per head.

Products whose manifest has the key of the same inputs, calibration, settings, code and CPU family
are complete and are not computed again (--again computes them). A run may be stopped, started
again, and run twice at once.

Every frame is compared with the hash in its record, and record, file and rig with each other
(docs/reference/formats.md). An exposure that cannot be processed is listed at the end with its
cause; the others are done. No other command writes into the mission at the same time.

A mission that `syntopic transfer` copied to an object store is processed there: frames are read
into memory, and products are written below its folder `processed`.

Examples: `syntopic process MISSION`, `syntopic process MISSION --only 3 --method fixed`,
`syntopic process MISSION --dry-run`, `syntopic process MISSION --processes 8 --json`,
`syntopic process MISSION --scheduler tcp://127.0.0.1:8786`,
`syntopic process s3://survey/2026/20261121T101500Z-ultracam-x-mini`
"""


@takes_executor
def process(
    mission: Annotated[str, typer.Argument(help="Mission folder, or its address in a store.")],
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
    again: Annotated[bool, typer.Option("--again", help="Compute complete products again.")] = (
        False
    ),
    *,
    where: ExecutorOptions,
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    from daemon.mission.transfer.object_store import is_store_url
    from daemon.planning.overlaps import overlaps_of
    from daemon.postflight.batch.capacity import further_exposure_nbytes, shared_maps_nbytes
    from daemon.postflight.batch.in_process import InProcessExecutor
    from daemon.postflight.batch.level2_sources import level2_source
    from daemon.postflight.batch.level2_work import Level2Work
    from daemon.postflight.batch.software_identity import software_identity

    if method not in ("free", "fixed") or interpolation not in INTERPOLATIONS:
        raise ConfigurationError(
            [f"--method is free or fixed, --interpolation one of {', '.join(INTERPOLATIONS)}"]
        )
    where.check()
    if is_store_url(mission):
        require("stores")
    with level2_source(mission if is_store_url(mission) else str(folder_of(mission))) as source:
        folder = source.mission
        plan, radiometry = as_flown(folder, radiometry, elevation)
        processing = ProcessingSection.model_validate(
            {
                "method": method,
                "interpolation": interpolation,
                "baselines": baselines,
                **flown_processing(folder),
            }
        )
        work = Level2Work(
            mission=folder.path.absolute(),
            rig_file=rig_file and rig_file.absolute(),
            processing=processing,
            plan=plan,
            radiometry=radiometry and radiometry.absolute(),
            identity=software_identity(),
            recomputes=again,
            folder_inode=folder.path.stat().st_ino,
        )
        with nullcontext() if dry_run else source.writing():
            present = folder.numbers()
            numbers = only or present
            if dry_run and (absent := sorted(set(numbers) - set(present))):
                raise ConfigurationError(
                    [f"--only {number}: {source.place} has no such exposure" for number in absent]
                )
            found = source.survey(source.placed(work), numbers, overlaps_of(folder, work.rig))
            placed = where.place(
                work.memory_nbytes,
                len(found.pending),
                further_nbytes=further_exposure_nbytes(work.rig),
                shared_nbytes=shared_maps_nbytes(work.rig),
            )
            if dry_run:
                on_cluster = where.scheduler is not None
                _print_dry_run(
                    source, found, None if on_cluster else placed.allocation, as_json=as_json
                )
                return
            if not (found.pending or found.complete):
                _refuse_unsuitable(folder, work)
            work = replace(work, shares_maps=not isinstance(placed.executor, InProcessExecutor))
            placed_work = replace(source.placed(work), threads=placed.threads)
            _run(source, placed_work, found, placed, as_json=as_json)


def _run(
    source: Level2Source,
    work: AnyLevel2Work,
    found: Level2Survey,
    placed: Placement,
    *,
    as_json: bool,
) -> None:
    """Compute what is pending and print the reports of all exposures."""
    from daemon.postflight.batch.batch_run import BatchOutcome, run_batch
    from processing.radiometry.calibration import CalibrationError

    outcome, console, executor = BatchOutcome(), Console(stderr=True), placed.executor
    complete = len(found.complete)
    if source.note:
        console.print(source.note, highlight=False)
    if found.pending:
        console.print(
            f"{len(found.pending)} exposures to compute, {complete} complete; "
            f"{executor.description}, {placed.threads} threads each ({placed.allocation.reason})",
            highlight=False,
        )
        with shown_progress("processing", complete + len(found.pending), complete) as show:
            try:
                outcome = run_batch(executor, work, found.pending, show)
            except (ValueError, CalibrationError) as error:
                raise ConfigurationError([str(error)]) from error
    reports = {**outcome.results, **source.reports(found.complete)}
    failures = [*outcome.failures, *source.replaced(found, outcome)]
    ordered = [reports[number] for number in sorted(reports)]
    if as_json:
        content = {
            "mission": source.place,
            "exposures": ordered,
            "failures": [failure.as_json() for failure in failures],
            "complete_before": complete,
            "executor": executor.description,
            "dashboard": getattr(executor, "dashboard", "") or None,
            "threads": placed.threads,
            "interrupted": outcome.is_interrupted,
            **outcome.counts.as_json(),
        }
        typer.echo(json.dumps(content))
    else:
        output = Console()
        if ordered:
            print_reports(output, f"Level-2 of {source.mission.id}", ordered)
        output.print(f"Products are in {source.products}")
    if outcome.is_interrupted:
        raise KeyboardInterrupt
    exit_if_failed(failures)


def _refuse_unsuitable(folder: Mission, work: Level2Work) -> None:
    """Refuse a rig or calibration that cannot be used, where no exposure would show it."""
    from daemon.products.processor import processor_for

    try:
        processor_for(work.rig, folder, work.processing, work.radiometry)
    except ValueError as error:
        raise ConfigurationError([str(error)]) from error


def _print_dry_run(
    source: Level2Source, found: Level2Survey, placed: ProcessAllocation | None, *, as_json: bool
) -> None:
    """Print what would be computed; `placed` is None on a cluster, which is not asked."""
    count = len(found.pending)
    expected_s = None
    if found.expected_s is not None and placed is not None:
        expected_s = round(found.expected_s * count / max(1, placed.processes), 1)
    if as_json:
        content = {
            "mission": source.place,
            "complete": sorted(found.complete),
            "pending": [task.number for task in found.pending],
            "read_nbytes": found.pending_nbytes,
            "processes": placed and placed.processes,
            "threads": placed and placed.threads,
            "expected_s": expected_s,
        }
        typer.echo(json.dumps(content))
        return
    console = Console(soft_wrap=True)
    time_text = "unknown: no exposure of this mission was processed before"
    where = "those of the cluster"
    if placed is not None:
        where = f"{placed.processes}, {placed.threads} threads each ({placed.reason})"
    elif found.expected_s is not None:
        time_text = f"{found.expected_s * count:.0f} s over the number of workers"
    if expected_s is not None:
        time_text = f"{expected_s:.0f} s, from the durations of earlier runs"
    console.print(
        f"{count} exposures to compute, {len(found.complete)} complete\n"
        f"To read: {found.pending_nbytes / 1e9:.3f} GB\n"
        f"Processes: {where}\n"
        f"Expected time: {time_text}",
        highlight=False,
    )


def flown_processing(folder: Mission) -> dict[str, Any]:
    """Thresholds and device of the flown configuration, for verdicts and pixels as in flight."""
    flown = folder.flown_configuration()
    values = {key: nested_value(flown, "processing", key) for key in ("thresholds", "device")}
    given = {key: value for key, value in values.items() if value}
    try:
        section = ProcessingSection.model_validate(given)
    except ValidationError as error:
        findings = [(("processing", *where), text) for where, text in findings_of(error)]
        raise ConfigurationError(sentences(findings, str(folder.service_path))) from error
    return {"thresholds": section.thresholds, "device": section.device}


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
