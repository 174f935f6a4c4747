"""`syntopic triangulate --live`: the triangulation of a flight, replayed from its mission."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import typer
from rich.progress import Progress

from daemon.cli.exit_status import ExitStatus, exit_if_failed
from daemon.terminal.console import Console, light_table

if TYPE_CHECKING:
    from daemon.mission.layout import Mission
    from daemon.orientation.navigation_sigmas import NavigationSigmas


def triangulate_live(
    folder: Mission,
    sigmas: NavigationSigmas,
    trajectory: Path | None,
    *,
    points: Path | None = None,
    measured: Path | None = None,
    as_json: bool,
) -> None:
    """Replay the live triangulation of a mission and write its files."""
    from daemon.onboard.live_orthomosaic.mission_map import MissionMap
    from daemon.onboard.triangulation.live_record import summary_json, write_live
    from daemon.onboard.triangulation.mission_triangulation import MissionTriangulation
    from daemon.orientation.exterior_orientation import sealed_exposures
    from daemon.orientation.orientation_inputs import trajectory_of
    from processing.pipelines.live_triangulation import LiveSettings

    read = sealed_exposures(folder)
    source = (
        None if trajectory is None else trajectory_of(folder, read.results.values(), trajectory)
    )
    done = MissionTriangulation(folder, LiveSettings(), sigmas, source, points, measured)
    problems: list[str] = []
    growing = MissionMap(done, lambda _event: None, on_failure=problems.append)
    seconds: list[float] = []
    with folder.held(), Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("triangulating", total=len(read.results))
        for number in sorted(read.results):
            blocks = done.block_count
            one = done.add(read.results[number])
            if done.block_count != blocks:
                growing.block_adjusted()
            if one.orientation is not None:
                seconds.append(one.seconds)
            progress.advance(task)
        begun = time.perf_counter()
        done.land()
        write_live(done)
        growing.deliver()
        landing_s = time.perf_counter() - begun
    found = summary_json(done) | {
        "exposure_seconds": {
            "median": float(np.median(seconds)) if seconds else None,
            "99": float(np.percentile(seconds, 99)) if seconds else None,
        },
        "landing_seconds": landing_s,
        "failures": [failure.as_json() for failure in read.failures],
        "folder": str(done.folder),
        "orthomosaic": None
        if growing.live is None
        else growing.live.as_json() | {"folder": str(growing.folder), "problems": problems},
    }
    if as_json:
        typer.echo(json.dumps(found))
    else:
        _print(found)
    exit_if_failed(read.failures)
    if found["accuracy"] is None:
        raise typer.Exit(ExitStatus.PROBLEM)


def _print(found: dict[str, Any]) -> None:
    console = Console()
    accuracy = found["accuracy"]
    console.print(
        f"{found['exposures']} exposures of {len(found['lines'])} lines, "
        f"{found['adjusted']} in the last adjustment",
        highlight=False,
    )
    if accuracy is not None:
        console.print(
            f"Expected accuracy without control, median: plan {accuracy['plan_m']:.3f} m, height "
            f"{accuracy['height_m']:.3f} m ({accuracy['points']} tie points), sigma0 "
            f"{found['sigma0']:.3f}",
            highlight=False,
        )
    control = found["control"]
    if control is not None:
        shown = ["-" if value is None else f"{value:.3f} m" for value in control["rms_m"]]
        console.print(
            f"{control['points']} control and check points, not adjusted: RMS east {shown[0]}, "
            f"north {shown[1]}, height {shown[2]}",
            highlight=False,
        )
    if found["drifts"]:
        table = light_table("Against the calibration", ("quantity",), ("value", "sigma", "unit"))
        for one in found["drifts"]:
            known = one["value"] is not None
            value = f"{one['value']:.4g}" if known else "not determined"
            sigma = f"{one['sigma']:.3g}" if known else ""
            table.add_row(one["name"], value, sigma, one["unit"])
        console.print(table)
    for one in found["findings"]:
        console.print(f"{one['name']}: {one['sentence']}", highlight=False)
    orthomosaic = found["orthomosaic"]
    if orthomosaic is not None and orthomosaic["gsd_m"] is not None:
        console.print(
            f"Preliminary orthomosaic of {orthomosaic['images']} images, "
            f"{orthomosaic['gsd_m']:.2f} m: {orthomosaic['folder']}",
            soft_wrap=True,
            highlight=False,
        )
        for sentence in orthomosaic["problems"]:
            console.print(sentence, highlight=False)
    console.print(
        f"Results: {found['folder']}, report {Path(found['folder']) / 'report.html'}",
        soft_wrap=True,
    )
