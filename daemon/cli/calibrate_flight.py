"""`syntopic calibrate flight`: frames and positions of a flight to a dated rig file."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from daemon.cli.options import AsJson, NewFolder
from daemon.terminal.console import Console

HELP = """Calibrate lenses and relative orientation of heads from a flight.

For a rig that began with `syntopic init`: no attitude and no control are needed. Frames of Level-0
are matched, oriented, and adjusted together with the positions of the receiver: principal distance,
principal point and distortion of every head, and its orientation against the master, with standard
deviations. Heads are triggered at one instant and have one sensor each.

Fly textured ground with 60 % of overlap, lines both ways, and some of them 30 % higher: one height
over flat ground does not separate the principal distance from the height above ground. What the
flight leaves open is named, and the rig then stays uncalibrated.

The new folder holds a dated rig file, the covariance, a report with plots, and the comparison with
a previous calibration. The rig file takes effect only after it is configured.

Examples: `syntopic calibrate flight MISSION`, `syntopic calibrate flight LOW HIGH --exposures 80`
"""


def flight(
    missions: Annotated[list[Path], typer.Argument(help="Mission folders, flown with one rig.")],
    exposures: Annotated[
        int | None,
        typer.Option(help="Number of exposures (default: 120 frames of all heads).", min=6),
    ] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(
            help="Post-processed positions: SBET, CSV or RTKLIB's .pos (default: in-flight ones)."
        ),
    ] = None,
    previous: Annotated[
        Path | None, typer.Option(help="Calibration from a flight to compare with.")
    ] = None,
    out: NewFolder = None,
    as_json: AsJson = False,
) -> None:
    from daemon.cli.calibration_output import publish_calibration
    from daemon.postflight.calibration.calibration_report import calibration_folder, read_previous
    from daemon.postflight.calibration.flight.findings import findings_of
    from daemon.postflight.calibration.flight.frames import FlightFramesError, read_flight
    from daemon.postflight.calibration.flight.report import (
        KIND,
        calibrated_rig,
        flight_report,
        rig_file,
    )
    from daemon.postflight.calibration.head_parameters import covariance_bytes
    from processing.calibration.flight.adjustment import calibrate_flight
    from processing.calibration.flight.images import FlightCalibrationError

    before = None if previous is None else read_previous(previous, kind=KIND)
    today = f"{datetime.now(UTC):%Y-%m-%d}"
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("reading", total=None)

        def show_progress(what: str, done: int, total: int) -> None:
            progress.update(task, description=what, completed=done, total=total or None)

        frames = read_flight(
            missions,
            exposures_max=exposures,
            trajectory_file=trajectory,
            progress=show_progress,
        )
        place = calibration_folder(out, f"{frames.rig.name}-flight", today, next_to=missions[0])
        try:
            found = calibrate_flight(frames.rig, frames.images, progress=show_progress)
            findings = findings_of(found, frames)
            refusal = None
        except FlightCalibrationError as error:
            refusal = error
        if frames.plausible is not None and (refusal or findings.blocking):
            # Over ground that repeats itself; elsewhere turns and slopes may seem contradictions.
            frames = frames.without_contradicting(frames.plausible)
            try:
                found = calibrate_flight(frames.rig, frames.images, progress=show_progress)
                findings = findings_of(found, frames)
                refusal = None
            except FlightCalibrationError as error:
                refusal = error
        if refusal is not None:
            raise FlightFramesError(f"{frames.rig.name}: {refusal}") from refusal
    made = calibrated_rig(found, frames, findings, date=today)
    report = flight_report(
        found, frames, findings, calibration_id=place.name, date=today, previous=before
    )
    publish_calibration(
        report,
        place,
        files={"covariance.npz": covariance_bytes(found)},
        rig_file=lambda name: rig_file(
            replace(made, calibration_id=name),
            found,
            frames,
            date=today,
            blocking=findings.blocking,
        ),
        as_json=as_json,
    )
